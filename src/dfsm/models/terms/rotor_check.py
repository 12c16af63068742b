"""Whether recorded signals can be those of a rotor with this table."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import agree, factor
from dfsm.errors import DfsmError

if TYPE_CHECKING:
    from dfsm.models.terms.rotor_term import RotorTerm

# Shares of the samples beyond the table that are refused, and that are told.
_REFUSED, _TOLD = 0.9, 0.1
# A pitch that stays below so many degrees may be in rad.
_RADIANS = 1.6
# Below this share of the best tip speed ratio a rotor sheds power, which it does by pitching.
_SHEDDING = 0.75
_FEWEST = 50
# A pitch that moves less than this, in its unit, does not control anything even in rad.
_STILL = 0.05
# Samples whose power is computed at most.
_MOST = 2000


def check_signals(term: RotorTerm, signals: Array) -> list[str]:
    """What is doubtful about them, one sentence each.

    Parameters
    ----------
    term
        The rotor's.
    signals
        Samples in the units of their channels, shape ``(sample, signal)``.

    Raises
    ------
    DfsmError
        They cannot belong to this rotor and table.
    """
    wind, tips, pitch = map(np.asarray, _inflow(term, signals))
    return [
        *_check_ratio(term, wind, tips),
        *_check_pitch_range(term, pitch),
        *_check_degrees(term, signals, wind, tips, pitch),
    ]


def _check_ratio(term: RotorTerm, wind: Array, tips: Array) -> list[str]:
    about = term.about
    low, high = about.ratios
    speed = about.inputs[1]
    beyond = ~((wind > 0) & (tips >= low * wind) & (tips <= high * wind))
    share = float(beyond.mean())
    blowing = wind > 0
    median = float(np.median(tips[blowing] / wind[blowing])) if blowing.any() else np.nan
    told = (
        f"{term.channels[0].name}: {100 * share:.0f} % of the tip speed ratios lie beyond its "
        f"table ({low:g} to {high:g}), their median is {median:.3g}"
    )
    if share >= _REFUSED:
        size = {u: factor(u, about.speed_unit) or np.nan for u in ("rpm", "rad/s", "deg/s")}
        others = [u for u, f in size.items() if low <= median * f <= high]
        hint = f"; were '{speed}' in {others[0]}, it would lie within it" if others else ""
        raise DfsmError(
            f"{told}{hint}: check the unit of '{speed}', the radius {about.radius:g} m, the "
            f"gearbox ratio {about.gearbox_ratio:g} and that the table is this rotor's"
        )
    if share > _TOLD:
        return [f"{told}: what is computed there is continued smoothly, a larger table knows it"]
    return []


def _check_pitch_range(term: RotorTerm, pitch: Array) -> list[str]:
    first, last = term.about.angles
    slack = 0.01 * (last - first)
    share = float(((pitch < first - slack) | (pitch > last + slack)).mean())
    name, unit = term.about.inputs[2], term.about.pitch_unit
    told = (
        f"{term.channels[0].name}: '{name}' goes from {pitch.min():.4g} to {pitch.max():.4g} deg, "
        f"the pitch of its table from {first:g} to {last:g} deg"
    )
    if share >= _REFUSED or np.abs(pitch).max() > 360:
        raise DfsmError(
            f"{told}: check that '{name}' is in {unit} and is the blade pitch, or compute a "
            "larger table"
        )
    if share > _TOLD:
        return [
            f"{told}, which leaves {100 * share:.0f} % of the samples out: compute a larger one"
        ]
    return []


def _check_degrees(
    term: RotorTerm, signals: Array, wind: Array, tips: Array, pitch: Array
) -> list[str]:
    """Refuse a pitch in rad that calls itself deg.

    A rotor that turns slowly for its wind sheds power by pitching, which keeps its power steady;
    read as degrees, the same numbers hardly pitch it and its power follows the wind.
    """
    about = term.about
    largest = float(np.abs(pitch).max())
    if not agree(about.pitch_unit, "deg") or largest > _RADIANS:
        return []
    if np.rad2deg(largest) > max(abs(a) for a in about.angles):
        return []
    shedding = np.flatnonzero((wind > 0) & (tips < _SHEDDING * about.optimum * wind))
    if len(shedding) < _FEWEST:
        return []
    shedding = shedding[:: -(-len(shedding) // _MOST)]
    rows = signals[shedding]
    turned = rows.copy()
    turned[:, 2] = np.rad2deg(rows[:, 2])
    (told, spread), (mean, steady) = (_power(term, r, tips[shedding]) for r in (rows, turned))
    if np.ptp(pitch[shedding]) > _STILL and 0 < mean < told and steady < 0.5 * spread:
        name = about.inputs[2]
        raise DfsmError(
            f"{term.channels[0].name}: '{name}' says deg and stays within {largest:.3g}, but only "
            "as rad does it shed the power of strong wind: convert it, or correct its unit"
        )
    return []


def _power(term: RotorTerm, rows: Array, tips: Array) -> tuple[float, float]:
    """Mean and standard deviation of the rotor's power, in kW."""
    torque = np.asarray(_values(term, rows))[:, 1]
    power = torque * tips / term.about.radius
    return float(np.mean(power)), float(np.std(power))


@eqx.filter_jit
def _inflow(term: RotorTerm, signals: Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    return term.inflow(jnp.asarray(signals))


@eqx.filter_jit
def _values(term: RotorTerm, signals: Array) -> jax.Array:
    return jax.vmap(term.values)(jnp.asarray(signals))

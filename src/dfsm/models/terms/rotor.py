"""Thrust and aerodynamic torque of a rotor, from its table of coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.core.units import factor
from dfsm.data.readers.rotor_table import RotorTable, read_rotor_table
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.terms.form import Term
from dfsm.models.terms.inputs import input_columns
from dfsm.models.terms.rotor_check import check_signals
from dfsm.models.terms.rotor_surface import TOLERANCE, Grid, make_surface, surface_values

# kg/m³ of what rotors turn in.
_AIR, _WATER = (0.8, 1.6), (950.0, 1100.0)
# A tip speed below this, in m/s, counts as this: φ has no direction where nothing moves.
_CALM = 0.01
_SPEEDS = ("rpm", "rad/s", "deg/s")


@settings_class
class Rotor:
    """Quasi-steady thrust and torque of a rotor, as two known terms of the linear fit.

    Attributes
    ----------
    table
        File of its coefficients, see `read_rotor_table`, or the table itself.
    radius
        In m.
    wind
        Wind at the undisturbed rotor, in m/s.
    speed
        Speed of the rotor or the generator, in rpm, rad/s or deg/s.
    pitch
        Blade pitch, in deg or rad.
    density
        In kg/m³.
    hub_height, pitch_rate
        Height of the hub above the point about which the platform pitches, in m, and the channel
        of that motion in deg/s or rad/s, positive downwind: hub_height times it is taken off the
        wind.
    surge_rate
        Channel of the platform's velocity downwind in m/s, which is taken off the wind.
    gearbox_ratio
        Of `speed` to the speed of the rotor.
    corrections
        Further channels d_k in m/s, e.g. averages of the wind over rings of the disk less that
        over the disk: Σ a_k d_k is added to the wind, with weights that refinement learns. In
        derivatives they act through the rotor alone.
    inertia, generator_torque
        Of all that turns, about the rotor's axis, in kg m², and the channel of the torque that
        brakes it, in kN-m: with both the fit knows what the torques do to the speed.
    efficiency
        Of the gearbox: the part of the rotor's power that reaches the generator.
    name
        What the values are called: ``<name>.thrust`` in kN and ``<name>.torque`` in kN-m.
    """

    table: str | Path | RotorTable
    radius: float
    wind: str
    speed: str
    pitch: str
    density: float = 1.225
    hub_height: float | None = None
    pitch_rate: str | None = None
    surge_rate: str | None = None
    gearbox_ratio: float = 1.0
    corrections: tuple[str, ...] = ()
    inertia: float | None = None
    generator_torque: str | None = None
    efficiency: float = 1.0
    name: str = "rotor"
    kind: Literal["rotor"] = "rotor"

    def __post_init__(self) -> None:
        for key, expected in (
            ("radius", "a positive number of m"),
            ("hub_height", "a positive number of m"),
            ("gearbox_ratio", "a positive number"),
            ("inertia", "a positive number of kg m²"),
        ):
            value = getattr(self, key)
            positive = value is None or (bool(np.isfinite(value)) and value > 0)
            require(positive, f"rotor.{key}", value, expected)
        likely = any(low <= self.density <= high for low, high in (_AIR, _WATER))
        told = f"kg/m³ of air ({_AIR[0]} to {_AIR[1]}) or water ({_WATER[0]:g} to {_WATER[1]:g})"
        require(likely, "rotor.density", self.density, told)
        require(0 < self.efficiency <= 1, "rotor.efficiency", self.efficiency, "0 to 1, not 0")
        require(bool(self.name), "rotor.name", "empty", "a name for its values")
        if (self.hub_height is None) != (self.pitch_rate is None):
            here, lacking = ("hub_height", "pitch_rate")
            if self.hub_height is None:
                here, lacking = lacking, here
            raise DfsmError(
                f"rotor.{here} is {getattr(self, here)} without rotor.{lacking}: the platform's "
                "motion at the hub is their product, set both or neither"
            )
        if (self.inertia is None) != (self.generator_torque is None):
            here, lacking = "inertia", "generator_torque"
            if self.inertia is None:
                here, lacking = lacking, here
            raise DfsmError(
                f"rotor.{here} is {getattr(self, here)} without rotor.{lacking}: what a torque "
                "does to the speed takes both, set both or neither"
            )
        twice = [n for n in self.inputs if self.inputs.count(n) > 1]
        if twice:
            raise DfsmError(f"rotor: channel '{twice[0]}' is named twice: name it once")

    @property
    def inputs(self) -> tuple[str, ...]:
        """Channels that it takes."""
        motion = (n for n in (self.pitch_rate, self.surge_rate) if n is not None)
        return (self.wind, self.speed, self.pitch, *motion, *self.corrections)

    def term(
        self,
        channels: Mapping[str, Channel],
        columns: Mapping[str, int],
        spreads: Mapping[str, float] | None = None,
    ) -> RotorTerm:
        """The term of a model with these inputs.

        Parameters
        ----------
        channels, columns
            Channel and column in I of every input, by name.
        spreads
            Typical size of every input in its unit: a weight a_k counts as much as makes d_k as
            large as the wind; 1 where it is not known.

        Raises
        ------
        DfsmError
            A channel is no input or in a unit that says something else, or the table cannot be
            read.
        """
        what = f"rotor '{self.name}'"
        _, at = input_columns(what, self.inputs, channels, columns)
        for key in ("wind", "surge_rate", "corrections"):
            named = getattr(self, key)
            for name in named if isinstance(named, tuple) else (named,):
                if name is not None:
                    _same(what, key, channels[name], "m/s")
        speed = _factor(what, "speed", channels[self.speed], _SPEEDS) / self.gearbox_ratio
        pitch = _factor(what, "pitch", channels[self.pitch], ("rad", "deg"))
        arm = None
        if self.pitch_rate is not None and self.hub_height is not None:
            rate = _factor(what, "pitch_rate", channels[self.pitch_rate], _SPEEDS[1:])
            arm = self.hub_height * rate
        if self.generator_torque is not None:
            braking = input_columns(what, (self.generator_torque,), channels, columns)[0]
            _same(what, "generator_torque", braking[0], "kNm")
        table = self.table
        if not isinstance(table, RotorTable):
            table = read_rotor_table(table)
        weights, grid, error = make_surface(table)
        about = RotorConstants(
            inputs=self.inputs,
            radius=self.radius,
            density=self.density,
            speed_factor=speed,
            pitch_factor=float(np.rad2deg(pitch)),
            arm=arm,
            surges=self.surge_rate is not None,
            gearbox_ratio=self.gearbox_ratio,
            inertia=self.inertia,
            efficiency=self.efficiency,
            ratios=(float(table.tip_speed_ratio[0]), float(table.tip_speed_ratio[-1])),
            angles=(float(table.pitch[0]), float(table.pitch[-1])),
            optimum=table.optimum[0],
            speed_unit=channels[self.speed].unit,
            pitch_unit=channels[self.pitch].unit,
            error=error,
        )
        return RotorTerm(
            columns=at,
            channels=(Channel(f"{self.name}.thrust", "kN"), Channel(f"{self.name}.torque", "kN-m")),
            weights=jnp.asarray(weights),
            gains=jnp.zeros(len(self.corrections)),
            scale=jnp.asarray(self._scale(spreads or {})),
            grid=grid,
            about=about,
        )

    def _scale(self, spreads: Mapping[str, float]) -> Array:
        wind = spreads.get(self.wind, 1.0)
        sizes = [spreads.get(name, wind) for name in self.corrections]
        return np.array([wind / s if s > 0 and wind > 0 else 1.0 for s in sizes])


def _factor(what: str, key: str, channel: Channel, units: Sequence[str]) -> float:
    """What one unit of a channel is in rad or rad/s, of which `units` are the usual ones."""
    size = factor(channel.unit, next(u for u in units if u.startswith("rad")))
    if size is None:
        raise DfsmError(
            f"{what}: its {key} '{channel.name}' is in '{channel.unit}', expected "
            f"{' or '.join(units)}: name another channel or convert it"
        )
    return size


def _same(what: str, key: str, channel: Channel, unit: str) -> None:
    if factor(channel.unit, unit) != 1.0:
        raise DfsmError(
            f"{what}: its {key} '{channel.name}' is in '{channel.unit}', expected {unit}: name "
            "another channel or convert it"
        )


@dataclass(frozen=True)
class RotorConstants:
    """What does not change about a rotor's term.

    Attributes
    ----------
    inputs
        Names of the signals.
    radius, density, gearbox_ratio, inertia, efficiency
        See `Rotor`.
    speed_factor
        The rotor's speed in rad/s per unit of the signal.
    pitch_factor
        Blade pitch in deg per unit of the signal.
    arm
        What one unit of the pitch rate takes off the wind, in m/s; None without that signal.
    surges
        Whether there is a surge rate.
    ratios, angles
        First and last tip speed ratio and pitch in deg of the table.
    optimum
        Tip speed ratio of the largest power.
    speed_unit, pitch_unit
        Of the signals.
    error
        Of the splines against the table, see `make_surface`.
    """

    inputs: tuple[str, ...]
    radius: float
    density: float
    speed_factor: float
    pitch_factor: float
    arm: float | None
    surges: bool
    gearbox_ratio: float
    inertia: float | None
    efficiency: float
    ratios: tuple[float, float]
    angles: tuple[float, float]
    optimum: float
    speed_unit: str
    pitch_unit: str
    error: float


class RotorTerm(Term):
    """Thrust in kN and torque in kN m; C² in all signals, and finite everywhere.

    ``v = wind + Σ a_k d_k - hub_height pitch_rate - surge_rate`` is the wind at the rotor and
    ``λ = ω R / v`` its tip speed ratio; thrust is ``½ ρ π R² v² Ct(λ, β)``, torque
    ``½ ρ π R³ v² Cq(λ, β)``. See `rotor_surface` for how the table is continued beyond its ends.

    Attributes
    ----------
    weights
        Of the splines, shape ``(2, cell + 3, pitch cell + 3)``.
    gains
        a, shape ``(correction,)``.
    scale
        How large a change of each of them is large, shape ``(correction,)``.
    grid
        Where the splines lie.
    about
        Everything else.
    """

    kind = "rotor"
    weights: jax.Array
    gains: jax.Array
    scale: jax.Array
    grid: Grid = eqx.field(static=True)
    about: RotorConstants = eqx.field(static=True)

    # -- evaluation -----------------------------------------------------------------------------

    def values(self, signals: jax.Array) -> jax.Array:
        """Thrust in kN and torque in kN m at one sample, shape ``(signal,)`` to ``(2,)``."""
        wind, speed, pitch = self.inflow(signals)
        # No direction of the inflow is lost: only its angle is asked of the spline.
        tips = jnp.sqrt(speed**2 + _CALM**2)
        forces = surface_values(self.weights, self.grid, wind, tips, pitch)
        size = 0.5e-3 * self.about.density * np.pi * self.about.radius**2
        return forces * np.array([size, size * self.about.radius])

    def inflow(self, signals: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Wind at the rotor and speed of its tips in m/s, pitch in deg, each ``(...)``.

        Parameters
        ----------
        signals
            In the units of their channels, shape ``(..., signal)``.
        """
        about, wind, at = self.about, signals[..., 0], 3
        if about.arm is not None:
            wind = wind - about.arm * signals[..., at]
            at += 1
        if about.surges:
            wind = wind - signals[..., at]
            at += 1
        if at < len(self.columns):
            wind = wind + jnp.sum(self.gains * signals[..., at:], axis=-1)
        speed = about.radius * about.speed_factor * signals[..., 1]
        return wind, speed, about.pitch_factor * signals[..., 2]

    def beyond(self, inputs: jax.Array) -> jax.Array:
        """Which input vectors lie beyond the table, ``(..., input)`` to ``(...)``.

        Wind that does not blow, or blows from behind, is beyond every tip speed ratio.
        """
        signals = jnp.asarray(inputs)[..., np.array(self.columns, dtype=int)]
        wind, speed, pitch = self.inflow(signals)
        (low, high), (first, last) = self.about.ratios, self.about.angles
        within = (wind > 0) & (speed >= low * wind) & (speed <= high * wind)
        return ~(within & (pitch >= first) & (pitch <= last))

    # -- what the fit knows of it -----------------------------------------------------------------

    @property
    def acceleration_per_rotor_torque(self) -> float | None:
        """∂(speed)/∂t per kN m of ``<name>.torque``, in the unit of `speed` per second.

        None where the inertia is not known.
        """
        if self.about.inertia is None:
            return None
        return 1e3 / self.about.inertia / self.about.speed_factor

    @property
    def acceleration_per_generator_torque(self) -> float | None:
        """∂(speed)/∂t per kN m of generator torque, in the unit of `speed` per second; negative.

        None where the inertia is not known.
        """
        rotor = self.acceleration_per_rotor_torque
        return None if rotor is None else -rotor * self.about.gearbox_ratio / self.about.efficiency

    # -- data -----------------------------------------------------------------------------------

    def check(self, values: Mapping[str, Array]) -> list[str]:
        """What is doubtful about the signals of the training samples, one sentence each.

        Parameters
        ----------
        values
            Samples by channel name, shape ``(sample,)``.

        Raises
        ------
        DfsmError
            The tip speed ratios or the pitch of nearly all samples lie beyond the table, or the
            pitch is in another unit than its channel says.
        """
        signals = np.stack([np.asarray(values[n], dtype=np.float64) for n in self.about.inputs], 1)
        doubts = check_signals(self, signals)
        if self.about.error > TOLERANCE:
            doubts.append(
                f"the splines of {self.channels[0].name} differ from its table by up to "
                f"{100 * self.about.error:.2g} % of the largest coefficient: the table has kinks "
                "or very uneven steps"
            )
        return doubts

    # -- refinement -----------------------------------------------------------------------------

    @property
    def parameters(self) -> tuple[jax.Array, ...]:
        """The weights of the corrections, if there are any."""
        return (self.gains,) if self.gains.shape[0] else ()

    def moved(self, deviations: Sequence[jax.Array]) -> RotorTerm:
        """The term with other weights of the corrections."""
        if not self.gains.shape[0]:
            return self
        return replace(self, gains=self.gains + self.scale * deviations[0])

    # -- model folders --------------------------------------------------------------------------

    def structure(self) -> dict[str, Any]:
        """Grid and constants."""
        return {"grid": asdict(self.grid), "about": asdict(self.about)}

    def arrays(self) -> dict[str, jax.Array]:
        """Splines, weights of the corrections and their scale."""
        return {"weights": self.weights, "gains": self.gains, "scale": self.scale}

    @classmethod
    def restored(
        cls,
        columns: tuple[int, ...],
        channels: tuple[Channel, ...],
        arrays: Mapping[str, jax.Array],
        structure: Mapping[str, Any],
    ) -> RotorTerm:
        """The term of which `arrays` and `structure` came."""
        told = structure["about"]
        # JSON turns tuples into lists, which are no keys of compiled functions.
        about: dict[str, Any] = {
            f.name: tuple(told[f.name]) if isinstance(told[f.name], list) else told[f.name]
            for f in fields(RotorConstants)
        }
        return cls(
            columns=columns,
            channels=channels,
            weights=arrays["weights"],
            gains=arrays["gains"],
            scale=arrays["scale"],
            grid=Grid(**structure["grid"]),
            about=RotorConstants(**about),
        )

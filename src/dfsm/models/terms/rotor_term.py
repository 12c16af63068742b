"""Thrust and torque of a rotor at any wind, speed and blade pitch, from its table's splines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel
from dfsm.models.terms.form import Schedule, Term
from dfsm.models.terms.induction import (
    lag,
    make_induction,
    moving_wake,
    settled,
    wind_of_inflow,
)
from dfsm.models.terms.rotor_check import check_signals
from dfsm.models.terms.rotor_place import lead_time
from dfsm.models.terms.rotor_surface import TOLERANCE, Grid, surface_values
from dfsm.numerics.hats import hats

# A tip speed below this, in m/s, counts as this: φ has no direction where nothing moves.
_CALM = 0.01
# Blade pitch in deg over which the factors of the table change.
_TURN = 15.0


@dataclass(frozen=True)
class RotorConstants:
    """What does not change about a rotor's term.

    Attributes
    ----------
    inputs
        Names of the signals.
    radius, density, gearbox_ratio, inertia, efficiency, memory, uncertainty
        See `Rotor`.
    speed_factor
        The rotor's speed in rad/s per unit of the signal.
    pitch_factor
        Blade pitch in deg per unit of the signal.
    arm
        What one unit of the pitch rate takes off the wind, in m/s; None without that signal.
    surges
        Whether there is a surge rate.
    overhang, lean, drifts
        How far upwind the rotor stands in m, None where it is taken to stand where the wind is
    overhang, lean, drifts
        How far upwind the rotor stands in m, None where it is taken to stand where the wind is
        told; what one unit of platform pitch carries it downwind in m, None without that signal;
        and whether there is a surge.
    ratios, angles
        First and last tip speed ratio and pitch in deg of the table.
    optimum
        Tip speed ratio of the largest power.
    speed_unit, pitch_unit
        Of the signals.
    error
        Of the splines against the table, see `make_surface`.
    lags
        How many states the induced velocity has, whose rates come after the forces; see
        `induction`.
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
    memory: str
    uncertainty: float
    ratios: tuple[float, float]
    angles: tuple[float, float]
    optimum: float
    speed_unit: str
    pitch_unit: str
    error: float
    lags: int = 0
    overhang: float | None = None
    lean: float | None = None
    drifts: bool = False

    @property
    def motions(self) -> int:
        """How many signals tell how the rotor moves and where it stands."""
        here = [self.arm is not None, self.surges]
        return sum([*here, self.overhang is not None, self.lean is not None, self.drifts])


class RotorTerm(Term):
    """Thrust in kN and torque in kN m; C² in all signals, and finite everywhere.

    ``v = wind + τ wind_rate + Σ a_k d_k - hub_height pitch_rate - surge_rate`` is the wind at the
    rotor, which stands where it meets the wind told for τ later (see `rotor_place`), and
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
    late, grid_of_late
        What latent states add to the wind: by schedule point what a unit of each adds, and last
        what is added anyway, in m/s, shape ``(point, latent + 1)``; and the points.
    trim
        Coefficients of `factors`, shape ``(2, 6)``.
    induction, pace
        Splines of `make_induction`, empty where nothing lags, and what is learnt of its lags, see
        `lag`, shape ``(2,)`` with one state and ``(3,)`` with two.
    grid
        Where the splines lie.
    about
        Everything else.
    """

    kind = "rotor"
    weights: jax.Array
    gains: jax.Array
    scale: jax.Array
    late: jax.Array
    grid_of_late: jax.Array
    trim: jax.Array
    induction: jax.Array
    pace: jax.Array
    grid: Grid = eqx.field(static=True)
    about: RotorConstants = eqx.field(static=True)

    # -- evaluation -----------------------------------------------------------------------------

    def values(self, signals: jax.Array) -> jax.Array:
        """Thrust in kN and torque in kN m at one sample, shape ``(signal,)`` to ``(2,)``.

        With lags the rates of the induced velocity's states in m/s² come after them.
        """
        return self.of_effective(self.effective(signals))

    def effective(self, signals: jax.Array) -> jax.Array:
        """Wind, speed and pitch as `inflow` tells them, and the induced velocity's states."""
        first = self._induced
        induced = signals[first : first + self.about.lags]
        return jnp.concatenate([jnp.stack(self.inflow(signals)), induced])

    def of_effective(self, numbers: jax.Array) -> jax.Array:
        """As `values`."""
        return self.felt((numbers[0], numbers[1], numbers[2]), numbers[3:])

    def felt(self, inflow: tuple[jax.Array, jax.Array, jax.Array], induced: jax.Array) -> jax.Array:
        """The values at what `inflow` tells and the induced velocity's states, ``(lags,)``."""
        wind, speed, pitch = inflow
        # No direction of the inflow is lost: only its angle is asked of the spline.
        tips = jnp.sqrt(speed**2 + _CALM**2)
        if not self.about.lags:
            return self._forces(wind, tips, pitch)
        still, slope = settled(self.induction, self.grid, wind, tips, pitch)
        first = lag(self.about.radius, wind, tips, still, self.pace)
        missing, rates = moving_wake(still, first, induced, self.pace)
        seen = wind_of_inflow(wind, tips, missing, slope)
        return jnp.concatenate([self._forces(seen, tips, pitch), rates])

    def staged(self) -> Term:
        """See `Term.staged`."""
        from dfsm.models.terms.rotor_staged import staged_rotor

        return staged_rotor(self)

    def wake(self, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Settled induced velocity in m/s and the slow lag in s, ``(input,)`` to numbers."""
        wind, speed, pitch = self.inflow(inputs[np.array(self.columns, dtype=int)])
        tips = jnp.sqrt(speed**2 + _CALM**2)
        induced, _ = settled(self.induction, self.grid, wind, tips, pitch)
        return induced, lag(self.about.radius, wind, tips, induced, self.pace)

    def _forces(self, wind: jax.Array, tips: jax.Array, pitch: jax.Array) -> jax.Array:
        forces = self.surface(wind, tips, pitch) * self.factors(wind, tips, pitch)
        size = 0.5e-3 * self.about.density * np.pi * self.about.radius**2
        return forces * np.array([size, size * self.about.radius])

    def surface(self, wind: jax.Array, tips: jax.Array, pitch: jax.Array) -> jax.Array:
        """See `surface_values`."""
        return surface_values(self.weights, self.grid, wind, tips, pitch)

    def factors(self, wind: jax.Array, tips: jax.Array, pitch: jax.Array) -> jax.Array:
        """What thrust and torque of the table are multiplied by, ``(2,)``.

        Quadratic in coordinates between -1 and 1, so that they are bounded at every inflow.
        """
        if not self.about.uncertainty:
            return jnp.ones(2)
        x = jnp.tanh(pitch / _TURN)
        ahead = (self.grid.stretch * wind) ** 2
        y = (ahead - tips**2) / (ahead + tips**2)
        return 1 + self.trim @ jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y])

    @property
    def _induced(self) -> int:
        """Where the first state of the induced velocity stands among the signals."""
        return 3 + self.about.motions + self.gains.shape[0]

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
        if about.overhang is not None:
            rate, distance = signals[..., at], jnp.asarray(about.overhang)
            at += 1
            if about.lean is not None:
                distance = distance - about.lean * signals[..., at]
                at += 1
            if about.drifts:
                distance = distance - signals[..., at]
                at += 1
            wind = wind + lead_time(distance, signals[..., 0]) * rate
        if corrections := self.gains.shape[0]:
            wind = wind + signals[..., at : at + corrections] @ self.gains
            at += corrections
        at += self.about.lags
        if latents := self.late.shape[1] - 1:
            shares = hats(self.grid_of_late, signals[..., at + latents])
            added = signals[..., at : at + latents] @ self.late[:, :-1].T + self.late[:, -1]
            wind = wind + jnp.sum(shares * added, axis=-1)
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

    # -- latent states --------------------------------------------------------------------------

    @property
    def driven(self) -> int | None:
        """Column in I of the speed, where latent states reach it through the wind alone."""
        through_wind = self.about.inertia is not None and self.about.memory == "wind"
        return self.columns[1] if through_wind else None

    def with_latents(
        self, names: Sequence[str], first: int, gains: Array, schedule: Schedule
    ) -> RotorTerm:
        """The term of a model whose latent states change the wind that the rotor feels.

        What the air remembers, the wake that settles after the blades have pitched, reaches the
        rotor as another wind; so neither thrust nor torque exceed what the table has.

        Parameters
        ----------
        names
            Of the latent states.
        first
            Column in I of the first of them.
        gains
            What one unit of each adds to the wind at first, in m/s, shape ``(latent,)``.
        schedule
            Along which that may vary.
        """
        columns = (*self.columns, *range(first, first + len(names)), schedule.column or 0)
        late = np.tile(np.append(gains, 0.0), (len(schedule.grid), 1))
        return replace(
            self,
            columns=columns,
            late=from_host(late),
            grid_of_late=from_host(schedule.grid),
            about=replace(self.about, inputs=(*self.about.inputs, *names)),
        )

    @property
    def wake_columns(self) -> tuple[int, ...]:
        """Columns in I of the induced velocity's states."""
        return self.columns[self._induced : self._induced + self.about.lags]

    def lagging(self, names: Sequence[str], first: int) -> RotorTerm:
        """The term of a model in which the induced velocity lags.

        Parameters
        ----------
        names
            Of its states: W and Z of `induction`.
        first
            Where the first stands in I.
        """
        rates = tuple(Channel(f"{name}_rate", "m/s2") for name in names)
        about = replace(self.about, inputs=(*self.about.inputs, *names), lags=len(names))
        return replace(
            self,
            columns=(*self.columns, *range(first, first + len(names))),
            channels=(*self.channels, *rates),
            induction=jnp.asarray(make_induction(np.asarray(self.weights), self.grid)),
            pace=from_host(np.zeros(1 + len(names))),
            about=about,
        )

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
        """What it learns: weights of corrections and latent states, factors, the lags."""
        late = (self.late,) if self.late.shape[1] > 1 else ()
        trim = (self.trim,) if self.about.uncertainty else ()
        pace = (self.pace,) if self.about.lags else ()
        return (*((self.gains,) if self.gains.shape[0] else ()), *late, *trim, *pace)

    def moved(self, deviations: Sequence[jax.Array]) -> RotorTerm:
        """The term with other values of these."""
        gains, late, trim, rest = self.gains, self.late, self.trim, list(deviations)
        pace = self.pace
        if gains.shape[0]:
            gains = gains + self.scale * rest.pop(0)
        if late.shape[1] > 1:
            late = late + rest.pop(0)
        if self.about.uncertainty:
            trim = trim + self.about.uncertainty * rest.pop(0)
        if self.about.lags:
            pace = pace + rest.pop(0)
        return replace(self, gains=gains, late=late, trim=trim, pace=pace)

    # -- model folders --------------------------------------------------------------------------

    def structure(self) -> dict[str, Any]:
        """Grid and constants."""
        return {"grid": asdict(self.grid), "about": asdict(self.about)}

    def arrays(self) -> dict[str, jax.Array]:
        """Splines, weights of the corrections and their scale."""
        arrays = {"weights": self.weights, "gains": self.gains, "scale": self.scale}
        late = {"late": self.late, "grid_of_late": self.grid_of_late}
        induction = {"induction": self.induction, "pace": self.pace}
        return arrays | late | {"trim": self.trim} | (induction if self.about.lags else {})

    @classmethod
    def restored(
        cls,
        columns: tuple[int, ...],
        channels: tuple[Channel, ...],
        arrays: Mapping[str, jax.Array],
        structure: Mapping[str, Any],
    ) -> RotorTerm:
        """The term of which `arrays` and `structure` came."""
        # What models had none of that were made before there was any.
        place = {"overhang": None, "lean": None, "drifts": False}
        told = {"memory": "speed", "uncertainty": 0.0, "lags": 0, **place, **structure["about"]}
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
            # Models of 0.1 and before have none.
            late=arrays.get("late", from_host(np.zeros((1, 1)))),
            grid_of_late=arrays.get("grid_of_late", from_host(np.zeros(1))),
            trim=arrays.get("trim", from_host(np.zeros((2, 6)))),
            induction=arrays.get("induction", from_host(np.zeros((2, 0, 0)))),
            pace=arrays.get("pace", from_host(np.zeros(2))),
            grid=Grid(**structure["grid"]),
            about=RotorConstants(**about),
        )

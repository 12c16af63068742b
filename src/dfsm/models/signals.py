"""What the vectors of a model mean: names, units, roles, training region, blade harmonics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.settings import require, settings_class
from dfsm.core.units import factor
from dfsm.data.between import Between, Chosen, resolved
from dfsm.data.derivatives import DerivativeSettings, StateSpec
from dfsm.data.features import Feature, with_features
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind import CORRECTED_WIND, undisturbed_rotor_wind
from dfsm.data.wind_field import ring_channel
from dfsm.errors import DfsmError, near_matches
from dfsm.models.inputs import GROUPS, InputOrder

# More than any rotor has; harmonics are tried up to their number.
_BLADES = 100


@settings_class
class Azimuth:
    """Blade-passing harmonics of the rotor azimuth ψ = ∫ω dt as inputs of ĝ (Sec. 3.7).

    No state holds the blade-passing frequency, so a peak there in an output can only come from
    these or from the inputs. Most of it comes from the wind field that the blades turn in: see
    `models.passing`.

    Attributes
    ----------
    speed
        State that holds the rotor speed, in rpm, rad/s or deg/s.
    angle
        Channel with the recorded azimuth in deg: it gives the phase in training, and at the start
        of a simulation. None integrates the recorded speed from zero, which leaves the phase of
        every run to chance.
    blades
        Harmonics are cos(blades ψ) and sin(blades ψ).
    rings
        Radii in m of the rings over which runs hold harmonics of the wind field (``C2_r036``, …,
        see `data.wind_field`): outputs then follow what blades meet in it. None by default.
    orders
        With rings: which azimuthal harmonics n of the field are tried at which multiple k of the
        rotor's speed, ``{3: (2, 3, 4)}``. None tries n = k - 1, k, k + 1 at k = 1 to one more than
        the number of blades, no n beyond that; what explains nothing on runs left out is dropped,
        output by output.
    direction
        Which way ψ turns in the field's angle α: -1 where blade 1 is at α = -ψ, as in OpenFAST, 1
        where it is at α = ψ.
    """

    speed: str
    angle: str | None = None
    blades: int = 3
    rings: tuple[float, ...] = ()
    orders: Mapping[int, tuple[int, ...]] | None = field(default=None, hash=False)
    direction: Literal[-1, 1] = -1

    def __post_init__(self) -> None:
        require(self.blades >= 1, "azimuth.blades", self.blades, "at least 1")
        require(self.blades <= _BLADES, "azimuth.blades", self.blades, f"at most {_BLADES}")
        require(self.direction in (-1, 1), "azimuth.direction", self.direction, "-1 or 1")
        shown = [f"{r:g}" for r in self.rings]
        good = all(r > 0 for r in self.rings) and len({ring_channel("U", r) for r in self.rings})
        require(
            not self.rings or good == len(self.rings),
            "azimuth.rings", f"[{', '.join(shown)}]", "different radii in m above 0",
        )  # fmt: skip
        require(
            self.angle is not None or not self.rings,
            "azimuth.angle", "not set", "the recorded azimuth's channel beside azimuth.rings",
        )  # fmt: skip
        if self.orders is None:
            return
        require(bool(self.rings), "azimuth.orders", "set", "no value without azimuth.rings")
        for k, tried in self.orders.items():
            where = f"azimuth.orders.{k}"
            require(k >= 1, "azimuth.orders", f"set for {k}", "multiples of the speed from 1")
            different = len({*tried}) == len(tried) and all(n >= 0 for n in tried)
            require(different, where, list(tried), "different numbers from 0")

    @property
    def tried(self) -> dict[int, tuple[int, ...]]:
        """Harmonics n of the field by multiple k of the speed; empty without rings."""
        if not self.rings:
            return {}
        if self.orders is not None:
            return {k: tuple(n) for k, n in sorted(self.orders.items())}
        highest = self.blades + 1
        return {
            k: tuple(n for n in (k - 1, k, k + 1) if n <= highest) for k in range(1, highest + 1)
        }

    @property
    def field(self) -> tuple[str, ...]:
        """Names of the field's channels that ĝ takes: q_n = Cn - i Sn of every ring and n."""
        return tuple(
            ring_channel(part, r)
            for n in sorted({n for tried in self.tried.values() for n in tried})
            for r in self.rings
            for part in ((f"C{n}", f"S{n}") if n else ("U",))
        )


@dataclass(frozen=True)
class SignalTable:
    """The channels of a model in the order of its vectors, with units.

    Attributes
    ----------
    states, controls, disturbances, parameters, outputs
        One `Channel` per element of ξ, u, w, p and y.
    latents
        The last of the states: those that no channel holds, see `latents.py`.
    induced
        How many of these, the first, follow the other states, too: the induced velocities of
        rotors, see `wakes.py`.
    field
        Harmonics of the wind field, which drive ĝ alone; see `Azimuth`.
    between
        What controls and disturbances, in this order, do between samples, see `data.between`;
        empty for lines.
    startup
        Length in s of the record from which hidden states are told, see `simulation.hidden`; 0
        where latent states follow from the inputs alone, see `latents.py`.
    telling
        Names of outputs that tell hidden states beside the measured ones.
    step
        In s, of the integration that the model was fitted with; None for one fitted on derivatives.
    specs
        Which states are measured and which are their rates, see `StateSpec`.
    derivatives
        How derivatives were extracted; initial rates of a rollout are computed the same way.
    azimuth
        Blade-passing harmonics of the output function, if any.
    hub_height
        In m; where set, runs get the rotor wind corrected for the platform's motion as channel
        ``RtVAvgxhCorr``, see `undisturbed_rotor_wind`.
    features
        Disturbances that are computed from others, see `with_features`.
    """

    states: tuple[Channel, ...]
    controls: tuple[Channel, ...]
    disturbances: tuple[Channel, ...]
    parameters: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    specs: tuple[StateSpec, ...]
    derivatives: DerivativeSettings = field(hash=False)
    azimuth: Azimuth | None = None
    hub_height: float | None = None
    features: tuple[Feature, ...] = ()
    latents: tuple[Channel, ...] = ()
    field: tuple[Channel, ...] = ()
    between: tuple[Between, ...] = ()
    startup: float = 0.0
    telling: tuple[str, ...] = ()
    step: float | None = None
    induced: int = 0

    @property
    def inputs(self) -> tuple[Channel, ...]:
        """Channels of I = [u, w, ξ, p]."""
        return tuple(channel for group in GROUPS for channel in getattr(self, group))

    @property
    def order(self) -> InputOrder:
        """Where everything stands in I."""
        return InputOrder.of(self.names)

    @property
    def observed(self) -> tuple[Channel, ...]:
        """The states that a recorded run holds: all but the latent ones."""
        return self.states[: len(self.states) - len(self.latents)]

    @property
    def driving(self) -> tuple[str, ...]:
        """Names of controls and disturbances, the columns of B."""
        return self.order.driving

    def between_samples(self, chosen: Chosen = None) -> tuple[Between, ...]:
        """What each exogenous input does between samples; `chosen` goes before the model's own."""
        kinds = resolved(chosen, self.driving, self.between)
        # Parameters are constant: a line, whatever the others do.
        return (*kinds, *("linear" for _ in self.parameters))

    @property
    def state_columns(self) -> slice:
        """Where the states stand in I."""
        return self.order.columns("states")

    @property
    def observed_columns(self) -> slice:
        """Where the states that a recorded run holds stand in I."""
        return slice(self.state_columns.start, self.latent_columns.start)

    @property
    def latent_columns(self) -> slice:
        """Where the latent states stand in I."""
        last = self.state_columns.stop
        return slice(last - len(self.latents), last)

    @property
    def induced_columns(self) -> slice:
        """Where the induced velocities stand in I."""
        first = self.latent_columns.start
        return slice(first, first + self.induced)

    @property
    def pair_columns(self) -> slice:
        """Where `pairs` stand in I."""
        return slice(self.induced_columns.stop, self.latent_columns.stop)

    @property
    def pairs(self) -> tuple[Channel, ...]:
        """Latent states that follow from controls and disturbances alone, see `latents.py`."""
        return self.states[self.marched :]

    @property
    def marched(self) -> int:
        """How many states, the first, depend on each other: all but `pairs`."""
        return len(self.observed) + self.induced

    @property
    def exogenous(self) -> tuple[str, ...]:
        """Names of what drives a simulation: controls, disturbances, parameters."""
        return self.order.exogenous

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the channels that an initial state is taken from."""
        states = (n for s in self.specs for n in (s.name, s.rate) if n is not None)
        return (*states, *self.telling)

    @property
    def recorded(self) -> tuple[str, ...]:
        """Names of the channels that a run holds which the model can be compared with."""
        states = [n for s in self.specs for n in s.channels]
        return (*self.exogenous, *states, *self.names("outputs"), *self.names("field"))

    def names(self, group: str) -> tuple[str, ...]:
        """Names of one group, e.g. ``names("states")``."""
        return tuple(c.name for c in getattr(self, group))

    @property
    def azimuth_rate(self) -> tuple[int, float] | None:
        """State that turns the azimuth and the rad/s in one of its units."""
        if self.azimuth is None:
            return None
        names = self.names("states")
        if self.azimuth.speed not in names:
            raise DfsmError(
                f"azimuth.speed is '{self.azimuth.speed}', which is not a state; "
                + near_matches(self.azimuth.speed, names)
            )
        column = names.index(self.azimuth.speed)
        return column, radians_per_second(self.states[column])


def with_computed(
    run: Trajectory, hub_height: float | None, features: Iterable[Feature] = ()
) -> Trajectory:
    """Add the channels that are computed from others, the same in training and in use.

    Parameters
    ----------
    run
        The whole record.
    hub_height
        In m; where set, a run without the corrected rotor wind gets it.
    features
        See `with_features`.
    """
    if hub_height is not None and CORRECTED_WIND not in run:
        run = undisturbed_rotor_wind(run, hub_height)
    return with_features(run, features)


def require_constant(run: Trajectory, parameters: Iterable[str]) -> None:
    """Refuse a run in which a parameter varies by more than it is rounded.

    Raises
    ------
    DfsmError
        Names the run, the first such parameter and its range.
    """
    for name in parameters:
        values, channel = run[name], run.channel(name)
        low, high = float(values.min()), float(values.max())
        if high - low > (channel.step or 0.0) + 1e-9 * max(abs(low), abs(high)):
            unit = f" {channel.unit}" if channel.unit else ""
            raise DfsmError(
                f"{run.where}: parameter '{name}' goes from {low:g} to {high:g}{unit}, but "
                "parameters are constant within a run: give it as a disturbance or control"
            )


def require_field(run: Trajectory, azimuth: Azimuth | None) -> None:
    """Refuse a run without the harmonics of the wind field, or the azimuth, that outputs take.

    Raises
    ------
    DfsmError
        Names the run, what it lacks and what adds it.
    """
    if azimuth is None or not azimuth.rings:
        return
    missing = [name for name in azimuth.field if name not in run]
    rings = ",".join(f"{r:g}" for r in azimuth.rings)
    if missing:
        highest = max((n for tried in azimuth.tried.values() for n in tried), default=0)
        raise DfsmError(
            f"{run.where} lacks {missing[0]}{' and others' if missing[1:] else ''}, harmonics of "
            "the wind field that make its blade-passing loads: add them with dfsm wind "
            f"(--harmonics {max(1, highest)} --rings {rings}) from the field that drove the run, "
            "or use a model without azimuth.rings"
        )
    if azimuth.angle is not None and azimuth.angle not in run:
        raise DfsmError(
            f"{run.where} lacks azimuth.angle '{azimuth.angle}', without which nobody knows where "
            "in the wind field the blades are: " + near_matches(azimuth.angle, run.names)
        )


def radians_per_second(speed: Channel) -> float:
    """The rad/s in one unit of a speed channel.

    Raises
    ------
    DfsmError
        The unit is not one of a rotational speed.
    """
    radians = factor(speed.unit, "rad/s")
    if radians is None:
        raise DfsmError(
            f"azimuth.speed '{speed.name}' is in '{speed.unit}', expected one of rpm, rad/s, deg/s"
        )
    return radians


@dataclass(frozen=True, eq=False)
class Provenance:
    """Where a model comes from: settings, data, figures of the fit; all of it JSON values.

    It never enters compiled code. All instances compare equal, so that models which differ only
    in their history share a compilation.

    Attributes
    ----------
    record
        Keys ``settings``, ``data``, ``rows``, ``warnings``, ``versions``, ``seconds``, ….
    """

    record: Mapping[str, Any] = field(default_factory=dict)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Provenance)

    def __hash__(self) -> int:
        return hash(Provenance)


def blade_harmonics(azimuth: ArrayLike, blades: int) -> jax.Array:
    """Return cos(blades ψ) and sin(blades ψ), shape ``(..., 2)``, for ψ in rad."""
    angle = blades * jnp.asarray(azimuth)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)

"""State derivatives from recorded states, ξ(t) → ξ̇(t): Sec. 3.3 of the paper.

`differentiate` takes a run and a list of states and returns the run with smoothed states, rates
appended as states where asked for, and the derivative of every state at every sample. The default
is a smoothing spline that knows the file's quantisation (`smoothing.py`); the paper's cubic spline
is there too. It interpolates, so it differentiates rounding errors along with the signal.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dfsm.core.settings import settings_class
from dfsm.core.types import Array, IntArray
from dfsm.core.units import agree
from dfsm.data.signs import wrapping
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, near_matches
from dfsm.numerics.filters import Filter, filtered
from dfsm.numerics.pieces import Estimate, piecewise
from dfsm.numerics.smoothing import SmoothResult, cubic_spline, interpolate, smoothing_spline
from dfsm.numerics.time_mesh import same_instant

__all__ = [
    "DerivativeSettings",
    "Differentiated",
    "Filter",
    "SmoothResult",
    "StateSpec",
    "cubic_spline",
    "differentiate",
    "kinematic_rows",
    "lead_in",
    "smoothing_spline",
    "state_names",
    "state_units",
]

# Share of its range by which a state may differ in two samples at one instant.
_ONE_VALUE = 1e-3


# Samples before the first that is used, which smoothing may need; filter windows, and periods of a
# cutoff, after which filters have forgotten.
_MARGIN_SAMPLES, _WINDOWS, _PERIODS = 200, 2.0, 5.0


@settings_class
class StateSpec:
    """One recorded state, or with ``order=2`` a state and its rate.

    Attributes
    ----------
    name
        Channel that holds the state q.
    order
        1: q is a state, q̇ its derivative. 2: q and q̇ are states, with derivatives q̇ and q̈.
    rate, acceleration
        Channels that hold q̇ and q̈ as the simulator computed them; where named they are used
        instead of differentiating (`acceleration` only with ``order=2``). The units must be the
        state's unit per s and per s²; `fit` converts others of that dimension.

    Raises
    ------
    DfsmError
        An order other than 1 or 2, or an acceleration for a state of order 1.
    """

    name: str
    order: Literal[1, 2] = 1
    rate: str | None = None
    acceleration: str | None = None

    def __post_init__(self) -> None:
        if self.order not in (1, 2):
            raise DfsmError(f"state '{self.name}' has order {self.order!r}: give 1 or 2")
        if self.order == 1 and self.acceleration is not None:
            raise DfsmError(
                f"state '{self.name}' of order 1 has no use for the acceleration channel "
                f"'{self.acceleration}': set order to 2 or leave the channel out"
            )

    @property
    def channels(self) -> tuple[str, ...]:
        """Recorded channels that the state and its derivatives are taken from."""
        return tuple(n for n in (self.name, self.rate, self.acceleration) if n is not None)


@settings_class
class DerivativeSettings:
    """How states are differentiated.

    Attributes
    ----------
    method
        ``smoothing_spline``, the noise-aware default, or ``cubic_spline``, the paper's.
    filters
        State channel → `Filter`, for states that hold motions a model should not follow.
    """

    method: Literal["smoothing_spline", "cubic_spline"] = "smoothing_spline"
    filters: Mapping[str, Filter] = field(default_factory=dict)

    def __post_init__(self) -> None:
        methods = ("smoothing_spline", "cubic_spline")
        if self.method not in methods:
            raise DfsmError(
                f"there is no method '{self.method}' to differentiate with; "
                f"{near_matches(str(self.method), methods)}"
            )


@dataclass(frozen=True, eq=False)
class Differentiated:
    """A run with its states and their derivatives.

    Attributes
    ----------
    trajectory
        The run with smoothed states in place of the recorded ones, and the rates of states of
        order 2 appended as channels ``<name>_dot``.
    names
        States in the paper's order: all q, then the rates, ξ = [Θp, ωg, Θ̇p, ω̇g].
    derivatives
        ξ̇, shape ``(time, state)``, in `derivative_units`.
    derivative_names, derivative_units
        ``<name>_dot`` or ``<name>_ddot``, and the state's unit per s.
    noise_std
        Per state the standard deviation of the noise in the recorded channel, in its unit; None
        where it is not known (cubic spline, rates, recorded channels).
    """

    trajectory: Trajectory
    names: tuple[str, ...]
    derivatives: Array
    derivative_names: tuple[str, ...]
    derivative_units: tuple[str, ...]
    noise_std: tuple[float | None, ...]
    direct: NDArray[np.bool_]


def state_names(states: Sequence[StateSpec]) -> tuple[str, ...]:
    """Names of ξ in the paper's order: all q first, then the rates of states of order 2.

    Raises
    ------
    DfsmError
        No state, a state that occurs twice, or one that bears the name of another's rate.
    """
    names = (*(s.name for s in states), *(f"{s.name}_dot" for s in states if s.order == 2))
    if not names:
        raise DfsmError("no states were given: name at least one channel as a state")
    for i, name in enumerate(names):
        if name in names[:i]:
            raise DfsmError(f"state '{name}' was given twice: name each state once")
    return names


def state_units(states: Sequence[StateSpec], trajectory: Trajectory) -> tuple[str, ...]:
    """Units of ξ in the order of `state_names`; a state without a unit has a rate without one.

    Raises
    ------
    DfsmError
        A channel that the run does not have.
    """
    units = [trajectory.channel(s.name).unit for s in states]
    rates = [per_second(u) for s, u in zip(states, units, strict=True) if s.order == 2]
    return (*units, *rates)


def kinematic_rows(states: Sequence[StateSpec]) -> dict[int, int]:
    """Rows of ξ̇ that are states themselves: ``{index of q: index of q̇}``, nothing to fit."""
    second = [i for i, s in enumerate(states) if s.order == 2]
    return {i: len(states) + j for j, i in enumerate(second)}


def lead_in(run: Trajectory, start: float | None, settings: DerivativeSettings) -> Trajectory:
    """A run from `start` less what derivatives need before it: what lies earlier has no say.

    A bad sample at the beginning, and a transient that is left out, would otherwise decide with the
    rest how much is smoothed.

    Parameters
    ----------
    run
        The whole record.
    start
        First time in s at which derivatives are wanted; None for all.
    settings
        Filters remember for longer than splines.
    """
    if start is None or start <= run.time[0]:
        return run
    memory = [
        _WINDOWS * f.window if f.window is not None else _PERIODS / (f.cutoff or np.inf)
        for f in settings.filters.values()
    ]
    usual = run.duration / (len(run) - 1)
    return run.window(start - max([_MARGIN_SAMPLES * usual, *memory]), None)


def differentiate(
    trajectory: Trajectory,
    states: Sequence[StateSpec],
    settings: DerivativeSettings | None = None,
    breaks: IntArray | None = None,
) -> Differentiated:
    """Find the states and their derivatives of one run.

    A recorded rate or acceleration is used as it stands (filtered where the state is), except
    that a recorded rate which must itself be differentiated is smoothed like a state.
    With a filter the state is first freed of noise, then filtered, then differentiated, so that
    q̇ stays the derivative of q. Smooth more than is used and cut the time window afterwards (see
    `lead_in`): the second derivative is least certain in the first and last few samples.

    Parameters
    ----------
    trajectory
        The run; each state channel's quantisation step, if known, gives its noise level.
    states
        See `StateSpec`.
    settings
        See `DerivativeSettings`; None takes the defaults.
    breaks
        First sample after each jump of an input, see `jumps`: derivatives are taken between them,
        but for states with a filter, which leaves no kink. Samples at one instant are one.

    Returns
    -------
    Differentiated
        Derivatives of shape ``(time, state)``, and the run with the states in it.

    Raises
    ------
    DfsmError
        An unknown channel or filter, a channel with NaN, units that disagree, a name that is taken,
        too few samples, or a state that differs in two samples at one instant.
    """
    settings = settings or DerivativeSettings()
    names = state_names(states)
    _check_names(trajectory, states, settings)
    extracted = [_differentiate_state(trajectory, s, settings, breaks) for s in states]
    second = [i for i, s in enumerate(states) if s.order == 2]

    values = trajectory.values.copy()
    channels = list(trajectory.channels)
    for spec, state in zip(states, extracted, strict=True):
        column = trajectory.column(spec.name)
        values[:, column] = state.q
        channels[column] = replace(channels[column], step=None)
    smoothed = replace(trajectory, values=values, channels=tuple(channels))
    rates = [
        replace(trajectory.channel(s.name), name=f"{s.name}_dot", unit=unit, step=None)
        for s, unit in zip(
            (states[i] for i in second), state_units(states, trajectory)[len(states) :], strict=True
        )
    ]
    if second:
        smoothed = smoothed.with_channels(
            rates, np.stack([extracted[i].rate for i in second], axis=1)
        )
    derivatives = [*(f.rate for f in extracted), *(extracted[i].acceleration for i in second)]
    return Differentiated(
        trajectory=smoothed,
        names=names,
        derivatives=np.stack(derivatives, axis=1),
        derivative_names=(
            *(f"{s.name}_dot" for s in states),
            *(f"{states[i].name}_ddot" for i in second),
        ),
        derivative_units=tuple(per_second(u) for u in state_units(states, trajectory)),
        noise_std=(*(f.noise_std for f in extracted), *(None for _ in second)),
        direct=np.logical_and.reduce([f.direct for f in extracted]),
    )


# -- one state ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _State:
    q: Array
    rate: Array
    acceleration: Array
    noise_std: float | None
    direct: NDArray[np.bool_]


def _differentiate_state(
    run: Trajectory, spec: StateSpec, settings: DerivativeSettings, breaks: IntArray | None
) -> _State:
    run.select(spec.channels).require_finite()
    _refuse_wrap(run, spec.name)
    chosen = settings.filters.get(spec.name)
    state = _estimate(run, spec.name, chosen, settings, breaks)
    everywhere = np.ones(len(run), bool)
    if spec.rate is not None:
        _check_unit(run, spec, spec.rate, 1)
        if spec.order == 2 and spec.acceleration is None:
            rate = _estimate(run, spec.rate, chosen, settings, breaks)
            state = replace(state, rate=rate.q, acceleration=rate.rate, direct=rate.direct)
        else:
            recorded = filtered(run.time, run[spec.rate], chosen)
            told = everywhere if spec.order == 1 else state.direct
            state = replace(state, rate=recorded, direct=told)
    if spec.acceleration is not None:
        _check_unit(run, spec, spec.acceleration, 2)
        recorded = filtered(run.time, run[spec.acceleration], chosen)
        state = replace(state, acceleration=recorded, direct=everywhere)
    return state


def _refuse_wrap(run: Trajectory, name: str) -> None:
    unit = run.channel(name).unit
    if wrap := wrapping(run.time, run[name], unit):
        raise DfsmError(
            f"{run.where}: state '{name}' wraps at {wrap.period:.4g}{f' {unit}' if unit else ''} "
            f"({wrap.times} times, first at {wrap.first:g} s), so that its derivative jumps there: "
            "unwrap it (numpy.unwrap), or take its speed as the state"
        )


def require_moving(states: Sequence[StateSpec], values: Array) -> None:
    """Refuse states that are the same in all training samples.

    Parameters
    ----------
    states
        See `StateSpec`.
    values
        Samples of ξ over all runs, shape ``(sample, state)``, in the order of `state_names`.

    Raises
    ------
    DfsmError
        Names the first such state, or the state whose rate it is.
    """
    second = [s.name for s in states if s.order == 2]
    names = [*(f"state '{s.name}'" for s in states), *(f"rate of state '{n}'" for n in second)]
    for what, column in zip(names, values.T, strict=True):
        if np.ptp(column) <= 1e-12 * np.abs(column).max():
            raise DfsmError(
                f"{what} is constant in all training samples, so nothing can be learnt about its "
                "derivative: choose another state, another filter or add runs in which it moves"
            )


def _estimate(
    run: Trajectory,
    name: str,
    chosen: Filter | None,
    settings: DerivativeSettings,
    breaks: IntArray | None,
) -> _State:
    step = run.channel(name).step

    def estimate(time: Array, values: Array) -> Estimate:
        if settings.method == "cubic_spline":
            return *cubic_spline(time, filtered(time, values, chosen)), None
        smooth = smoothing_spline(time, values, step)
        if chosen is None:
            return smooth.values, smooth.first, smooth.second, smooth.noise_std
        filtered_values = filtered(time, smooth.values, chosen)
        return *interpolate(time, filtered_values), smooth.noise_std

    breaks = np.empty(0, dtype=int) if breaks is None or chosen is not None else breaks
    twice = same_instant(run.time)
    _require_one_value(run, name, twice)
    try:
        if len(breaks) or twice.any():
            return _State(*piecewise(run.time, run[name], breaks, estimate))
        return _State(*estimate(run.time, run[name]), np.ones(len(run), bool))
    except DfsmError as error:
        raise DfsmError(f"{run.where}: channel '{name}': {error}") from None


def _require_one_value(run: Trajectory, name: str, twice: NDArray[np.bool_]) -> None:
    """Two samples at one instant are before and after a jump of inputs, at which no state jumps."""
    if not twice.any():
        return
    values = run[name]
    apart = np.abs(np.diff(values)) * twice
    if apart.max() > _ONE_VALUE * np.ptp(values) + (run.channel(name).step or 0.0):
        row = int(np.argmax(apart))
        raise DfsmError(
            f"{run.where}: '{name}' goes from {values[row]:g} to {values[row + 1]:g} in no time, "
            f"at {run.time[row]:g} s, but a derivative leads to no jump of a state: cut the run "
            "there, or drop the repeated sample"
        )


# -- names and units ----------------------------------------------------------------------------


def _check_names(
    run: Trajectory, states: Sequence[StateSpec], settings: DerivativeSettings
) -> None:
    run.columns(n for spec in states for n in spec.channels)
    for spec in states:
        if spec.order == 2 and f"{spec.name}_dot" in run:
            raise DfsmError(
                f"{run.where}: there is a channel '{spec.name}_dot' already, the name that the "
                f"rate of '{spec.name}' gets: rename it, or give it as the state's rate under "
                "another name"
            )
    known = [s.name for s in states]
    for name in settings.filters:
        if name not in known:
            raise DfsmError(
                f"a filter was given for '{name}', which is no state; {near_matches(name, known)}"
            )


def _check_unit(run: Trajectory, spec: StateSpec, name: str, times: int) -> None:
    """Compare units; one that a file does not state cannot be compared and passes."""
    unit, its = run.channel(spec.name).unit, run.channel(name).unit
    wanted = unit
    for _ in range(times):
        wanted = per_second(wanted)
    if not agree(its, wanted):
        raise DfsmError(
            f"{run.where}: channel '{name}' in '{its}' is not the "
            f"{('first', 'second')[times - 1]} derivative of '{spec.name}' in '{unit}': a channel "
            f"in '{wanted}' is expected, name another or leave it out"
        )


def per_second(unit: str) -> str:
    """Append one ``/s``: deg → deg/s → deg/s^2; no unit stays no unit."""
    if not unit:
        return ""
    base, power = _time_power(unit)
    return f"{base}/s" if power == 0 else f"{base}/s^{power + 1}"


def _time_power(unit: str) -> tuple[str, int]:
    """Split 'deg/s^2', 'deg/s2', 'deg/s²', 'deg/s**2' or 'deg/s/s' into ('deg', 2)."""
    base, power = unit.strip().replace("²", "2").replace("³", "3"), 0
    while match := re.fullmatch(r"(.+?)\s*/\s*s(?:ec)?(?:\^|\*\*)?(\d?)", base):
        base, power = match[1], power + int(match[2] or 1)
    return base, power

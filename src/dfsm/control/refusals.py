"""What an optimal control problem refuses, each in one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from dfsm.control.levels import Level, is_number, level
from dfsm.control.names import GROUPS, Plant
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, near_matches


class Stated(Protocol):
    """What is read of an `OptimalControlProblem`, which asks for these checks itself."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @cached_property
    def plant(self) -> Plant: ...  # noqa: D102
    @property
    def horizon(self) -> tuple[float, float | tuple[float, float]]: ...  # noqa: D102
    @property
    def start(self) -> float: ...  # noqa: D102
    @property
    def last_time(self) -> float: ...  # noqa: D102
    @property
    def free_time(self) -> tuple[float, float] | None: ...  # noqa: D102
    @property
    def bounds(self) -> Mapping[str, Any]: ...  # noqa: D102
    @property
    def rates(self) -> Mapping[str, Any]: ...  # noqa: D102
    @property
    def constraints(self) -> Mapping[str, Any]: ...  # noqa: D102
    @property
    def parameters(self) -> Mapping[str, Any]: ...  # noqa: D102
    @property
    def free_parameters(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def disturbances(self) -> Any: ...  # noqa: D102
    @cached_property
    def scenarios(self) -> tuple[Trajectory | None, ...]: ...  # noqa: D102

    def limits(self, name: str, time: Array) -> tuple[Array, Array]: ...  # noqa: D102

    def end_limits(self, which: str, name: str) -> tuple[float, float]: ...  # noqa: D102


# Fields that hold entries by name.
_BY_NAME = ("bounds", "rates", "initial", "final", "constraints", "boundary", "parameters")


def check_forms(problem: Stated) -> None:
    """Refuse fields of another kind than what they are for."""
    name, runs = problem.name, problem.disturbances
    for place in _BY_NAME:
        value = getattr(problem, place)
        if not isinstance(value, Mapping):
            entry = "(function, low, high)" if place in ("constraints", "boundary") else "…"
            raise DfsmError(
                f"{name}: {place} are a {type(value).__name__}, expected a dict by name, "
                f"{{name: {entry}}}"
            )
    for place in ("cost", "final_cost"):
        value = getattr(problem, place)
        if not (value is None or callable(value)):
            raise DfsmError(
                f"{name}: {place} is a {type(value).__name__}, expected a function of named "
                "signals, or None"
            )
    several = isinstance(runs, Sequence) and not isinstance(runs, str)
    given: Sequence[Any] = runs if several else () if runs is None else (runs,)
    for run in given:
        if not isinstance(run, Trajectory):
            raise DfsmError(
                f"{name}: disturbances hold a {type(run).__name__}, expected a Trajectory or a "
                "list of them: read files with dfsm.read"
            )


def check_names(problem: Stated) -> None:
    """Refuse names that the model does not have, and parameters without a value."""
    plant, name = problem.plant, problem.name
    places = {
        "bounds": ("states", "controls", "outputs"),
        "rates": ("controls",),
        "initial": ("states",),
        "final": ("states",),
        "parameters": ("parameters",),
    }
    for place, groups in places.items():
        known = [n for g in groups for n in plant.names(g)]
        for asked in getattr(problem, place):
            if asked in known:
                continue
            owner = plant.owner(asked)
            if owner is not None:
                wanted = f"'{asked}' is one of the {GROUPS[owner]}, expected {' or '.join(groups)}"
                raise DfsmError(f"{name}: {place}: {wanted}")
            raise DfsmError(f"{name}: {place}: no channel '{asked}'; {near_matches(asked, known)}")
    for parameter in plant.names("parameters"):
        if parameter not in problem.parameters:
            raise DfsmError(
                f"{name}: parameter '{parameter}' has no value: give parameters={{'{parameter}': "
                "value}, or a pair (low, high) to optimize it"
            )
    for place in ("constraints", "boundary"):
        for key, entry in getattr(problem, place).items():
            if not (isinstance(entry, tuple) and len(entry) == 3 and callable(entry[0])):
                raise DfsmError(
                    f"{name}: {place} '{key}' is {entry!r}, expected (function, low, high)"
                )


def check_pairs(problem: Stated) -> None:
    """Refuse what is not of the form that its field asks for."""
    for place, number, limits in (
        ("bounds", False, _is_level),
        ("rates", False, _is_level),
        ("initial", True, _is_limit),
        ("final", True, _is_limit),
        ("parameters", True, is_number),
    ):
        for key, value in getattr(problem, place).items():
            pair = isinstance(value, tuple) and len(value) == 2 and all(map(limits, value))
            if not (pair or (number and is_number(value))):
                raise DfsmError(
                    f"{problem.name}: {place} of '{key}' are {value!r}, expected "
                    + ("a number or " if number else "")
                    + "a pair (low, high)"
                )
    horizon = problem.horizon
    last = horizon[1] if isinstance(horizon, tuple) and len(horizon) == 2 else None
    free = isinstance(last, tuple) and len(last) == 2 and all(map(is_number, last))
    if not (is_number(last) or free) or not is_number(horizon[0]):
        raise DfsmError(
            f"{problem.name}: the horizon is {horizon!r}, expected (first, last) or (first, "
            "(earliest last, latest last)) in s"
        )


def _is_limit(value: object) -> bool:
    return value is None or is_number(value)


def _is_level(value: object) -> bool:
    return _is_limit(value) or callable(value) or isinstance(value, Trajectory)


def check_horizon(problem: Stated) -> None:
    """Refuse a horizon that does not increase, and limits that move along one that is free."""
    name, start, free = problem.name, problem.start, problem.free_time
    low, high = free or (problem.last_time, problem.last_time)
    if not (np.isfinite([start, low, high]).all() and start < high and low <= high):
        raise DfsmError(
            f"{name}: the horizon is {problem.horizon}, expected (first, last) or (first, "
            "(earliest last, latest last)) in s, increasing"
        )
    if free is not None and low <= start:
        raise DfsmError(
            f"{name}: the free last time may be {low:g} s, which is not after the first, "
            f"{start:g} s: raise its lower limit"
        )
    moving = [n for n, pair in problem.bounds.items() if not all(map(_constant, pair))]
    moving += [n for n, pair in problem.rates.items() if not all(map(_constant, pair))]
    moving += [n for n, c in problem.constraints.items() if not all(map(_constant, c[1:]))]
    if free is not None and moving:
        raise DfsmError(
            f"{name}: the limits of '{moving[0]}' vary in time, which needs a fixed last time: "
            "write a path constraint that uses s.t"
        )


def _constant(limit: Level) -> bool:
    return limit is None or not (callable(limit) or isinstance(limit, Trajectory))


def check_disturbances(problem: Stated) -> None:
    """Refuse disturbances that are missing, too short or not finite."""
    names, name = problem.plant.names("disturbances"), problem.name
    runs = [r for r in problem.scenarios if r is not None]
    if names and not runs:
        raise DfsmError(f"{name}: the disturbances {', '.join(names)} are missing: give a run")
    for run in runs:
        chosen = run.select(names)
        start, stop = float(run.time[0]), float(run.time[-1])
        slack = 1e-9 * run.duration
        if start > problem.start + slack or stop < problem.last_time - slack:
            raise DfsmError(
                f"{name}: the disturbances of {run.where} last from {start:g} s to {stop:g} s, the "
                f"horizon from {problem.start:g} s to {problem.last_time:g} s: give a longer run "
                "or a shorter horizon"
            )
        chosen.require_finite()


def check_limits(problem: Stated) -> None:
    """Refuse bounds that cross, ends outside bounds, and bounds outside the training region."""
    time = np.linspace(problem.start, problem.last_time, 201)
    for place in ("bounds", "rates", "constraints", "boundary"):
        for key, entry in getattr(problem, place).items():
            # A limit may be infinite but not undefined.
            low = level(entry[-2], key, time, -np.inf)
            high = level(entry[-1], key, time, np.inf)
            crossed = ~(low <= high)
            if crossed.any():
                at = int(np.argmax(crossed))
                raise DfsmError(
                    f"{problem.name}: {place} of '{key}' go from {low[at]:g} to {high[at]:g} at "
                    f"{time[at]:g} s: the lower limit must not be above the upper one"
                )
    for which, at in (("initial", 0), ("final", -1)):
        for key in getattr(problem, which):
            low, high = problem.end_limits(which, key)
            below, above = (b[at] for b in problem.limits(key, time))
            slack = 1e-9 * max(1.0, abs(low), abs(high))
            if not (low <= high and max(low, below) <= min(high, above) + slack):
                raise DfsmError(
                    f"{problem.name}: the {which} '{key}' is to be in {_told(low, high)}, its "
                    f"bounds are {_told(below, above)}: no value meets both"
                )
    for key, value in problem.parameters.items():
        if is_number(value) and not np.isfinite(value):
            raise DfsmError(
                f"{problem.name}: parameter '{key}' is {value:g}, expected a finite number, or a "
                "pair (low, high) to optimize it"
            )
    for key in problem.free_parameters:
        value = problem.parameters[key]
        low, high = value if isinstance(value, tuple) else (value, value)
        if not (np.isfinite([low, high]).all() and low <= high):
            raise DfsmError(
                f"{problem.name}: parameter '{key}' is to be in {_told(low, high)}, expected two "
                "finite limits that do not cross"
            )
    _check_region(problem, time)


def _check_region(problem: Stated, time: Array) -> None:
    plant = problem.plant
    if plant.region is None:
        return
    trained = np.stack([plant.region.low, plant.region.high], axis=1)
    for key in problem.bounds:
        if key in plant.order.names:
            below, above = problem.limits(key, time)
            low, high = trained[plant.order.column(key)]
            if (below > high).any() or (above < low).any():
                at = int(np.argmax((below > high) | (above < low)))
                raise DfsmError(
                    f"{problem.name}: bounds of '{key}' are {_told(below[at], above[at])} at "
                    f"{time[at]:g} s, outside the model's training range {_told(low, high)}: "
                    "change the bounds, or train on runs that reach them"
                )


def _told(low: float, high: float) -> str:
    return f"{low:.5g}" if low == high else f"[{low:.5g}, {high:.5g}]"

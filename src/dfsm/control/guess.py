"""Where a solve starts: straight lines between the ends, a run, or another solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dfsm.control.problem import OptimalControlProblem
from dfsm.control.solution import Solution
from dfsm.core.types import Array
from dfsm.data.conversion import in_units_of
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError


@dataclass(frozen=True, eq=False)
class Start:
    """Values at the nodes of a mesh.

    Attributes
    ----------
    X, U
        States and controls, shape ``(scenario, node, n)``.
    p
        Free parameters, shape ``(parameter,)``.
    stop
        Last time in s.
    sizes
        What states and controls are divided by at least, where nothing else tells their sizes;
        None before any solve did.
    """

    X: Array
    U: Array
    p: Array
    stop: float
    sizes: tuple[Array, Array] | None = None


def start_of(
    problem: OptimalControlProblem, guess: Solution | Trajectory | None, tau: Array
) -> Start:
    """Evaluate a guess at normalised times.

    Parameters
    ----------
    problem
        To solve.
    guess
        None draws straight lines between the ends, or through what the training runs of a surrogate
        did, where the schedule is as in the mean over the horizon. A run gives the states and
        controls that it holds, stretched over the horizon (and the last time, if that is free);
        the others are straight lines. A solution gives all.
    tau
        Normalised times of the nodes, shape ``(node,)``.
    """
    stop = _stop(problem, guess)
    time = problem.start + tau * (stop - problem.start)
    X, U = _straight(problem, time, tau)
    count = len(problem.scenarios)
    X, U = np.repeat(X[None], count, axis=0), np.repeat(U[None], count, axis=0)
    p = np.array([_middle(problem.parameters[n]) for n in problem.free_parameters])
    if isinstance(guess, Solution):
        _take_solution(problem, guess, tau, X, U, p)
    elif isinstance(guess, Trajectory):
        _take_run(problem, guess, tau, X, U)
    elif guess is not None:
        raise DfsmError(
            f"guess is a {type(guess).__name__}, expected a Trajectory, a Solution or None"
        )
    return Start(X, U, p, stop)


def _take_solution(
    problem: OptimalControlProblem, guess: Solution, tau: Array, X: Array, U: Array, p: Array
) -> None:
    for name in (*problem.plant.names("states"), *problem.plant.names("controls")):
        guess.trajectories[0].column(name)
    for s in range(len(X)):
        # One scenario's solution starts all; more are taken in turn.
        k = s % len(guess.trajectories)
        X[s], U[s] = guess.at(tau, k)
    known = guess.parameters
    for i, name in enumerate(problem.free_parameters):
        p[i] = known.get(name, p[i])


def _take_run(
    problem: OptimalControlProblem, guess: Trajectory, tau: Array, X: Array, U: Array
) -> None:
    channels = [*problem.plant.channels["states"], *problem.plant.channels["controls"]]
    guess = in_units_of(guess, channels)
    time = guess.time[0] + tau * guess.duration
    taken = 0
    for group, values in (("states", X), ("controls", U)):
        for i, name in enumerate(problem.plant.names(group)):
            if name in guess:
                values[:, :, i] = np.interp(time, guess.time, guess[name])
                taken += 1
    if not taken:
        raise DfsmError(
            f"guess {guess.where} holds none of the states and controls "
            f"{', '.join((*problem.plant.names('states'), *problem.plant.names('controls')))}"
        )


def _stop(problem: OptimalControlProblem, guess: Solution | Trajectory | None) -> float:
    if problem.free_time is None:
        return problem.last_time
    low, high = problem.free_time
    if isinstance(guess, Solution):
        return float(np.clip(guess.trajectories[0].time[-1], low, high))
    if isinstance(guess, Trajectory):
        return float(np.clip(problem.start + guess.duration, low, high))
    # Limits often differ by orders of magnitude: take the geometric mean of the durations.
    return problem.start + float(np.sqrt((low - problem.start) * (high - problem.start)))


def _straight(problem: OptimalControlProblem, time: Array, tau: Array) -> tuple[Array, Array]:
    plant = problem.plant
    usual = _usual(problem, time)
    ends = time[[0, -1]]
    X = []
    for name in plant.names("states"):
        low, high = problem.limits(name, ends)
        values: list[float | None] = []
        for which, lo, hi in zip(("initial", "final"), low, high, strict=True):
            below, above = problem.end_limits(which, name)
            named = name in getattr(problem, which)
            pair = (max(lo, below), min(hi, above))
            values.append(_near(usual[name], *pair) if named else None)
        first, last = values
        # Where nobody knows what is usual, the middle of closed bounds is.
        near = _near if plant.region is None else _clipped
        rest = [near(usual[name], lo, hi) for lo, hi in zip(low, high, strict=True)]
        first = (rest[0] if last is None else last) if first is None else first
        last = first if last is None else last
        X.append(first + tau * (last - first))
    U = []
    for name in plant.names("controls"):
        low, high = problem.limits(name, time)
        closed = np.isfinite(low) & np.isfinite(high) & (plant.region is None)
        with np.errstate(invalid="ignore"):  # infinite limits, which are not used
            aim = np.where(closed, (low + high) / 2, usual[name])
        U.append(np.clip(aim, low, high))
    return _columns(X, len(tau)), _columns(U, len(tau))


def _usual(problem: OptimalControlProblem, time: Array) -> dict[str, float]:
    """States and controls of the training runs, where they are scheduled: in wind like this."""
    plant = problem.plant
    region, run = plant.region, problem.scenarios[0]
    if region is None:
        return dict.fromkeys((*plant.names("states"), *plant.names("controls")), 0.0)
    names, values = plant.order.names, np.asarray(region.mean)
    if run is not None and region.schedule is not None and names[region.schedule] in run:
        signal = np.interp(time, run.time, run[names[region.schedule]])
        (values,) = region.usual(np.array([np.mean(signal)]))
    return dict(zip(names, values.tolist(), strict=True))


def _columns(channels: list[Array], count: int) -> Array:
    return np.stack(channels, axis=1) if channels else np.empty((count, 0))


def _near(value: float, low: float, high: float) -> float:
    """The middle of a closed interval, else what is nearest to a value."""
    return _middle((low, high)) if np.isfinite(high - low) else _clipped(value, low, high)


def _clipped(value: float, low: float, high: float) -> float:
    return float(np.clip(value, low, high))


def _middle(level: float | tuple[float, float]) -> float:
    low, high = level if isinstance(level, tuple) else (level, level)
    return 0.5 * (float(low) + float(high))

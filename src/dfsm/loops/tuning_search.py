"""Objective and constraints of a tuning with their slopes, and the search for better values."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from dfsm.core.types import Array
from dfsm.loops.tuning_evaluate import Figured
from dfsm.loops.tuning_problem import TuningProblem
from dfsm.loops.tuning_result import Start, TuneStatus

# Largest excess over a limit, as a share of it, that still counts as met.
FEASIBLE = 1e-4
# What a point costs whose loops do not all come to their end, in units of the first objective.
_UNSTABLE = 10.0
# Answers of SciPy's SLSQP and L-BFGS-B that mean that the most iterations were used.
_LIMITS = {"SLSQP": (9,), "L-BFGS-B": (1,)}


class Figures(Protocol):
    """What gives figures at values of the parameters: closed loops on a model, corrected or not."""

    def __call__(self, theta: Array, slopes: bool = False) -> Figured:
        """Figures at a point, and their slopes if asked for."""
        ...


@dataclass(frozen=True)
class Judged:
    """A point as the optimizer sees it.

    Attributes
    ----------
    objective
        Σ weight · measure / scale.
    slope
        With the parameters, shape ``(parameter,)``.
    excess
        Over all limits, shape ``(limit,)``.
    excess_slope
        Shape ``(limit, parameter)``.
    """

    objective: float
    slope: Array
    excess: Array
    excess_slope: Array

    @property
    def violation(self) -> float:
        """Largest excess; 0 or less where all limits hold."""
        return float(self.excess.max()) if len(self.excess) else 0.0


@dataclass
class Search:
    """The problem as a function of parameters scaled to 0 … 1 between their bounds.

    Attributes
    ----------
    problem
        What is asked.
    figures
        Gives figures at values of the parameters.
    scales
        What the terms of the objective are divided by.
    best
        The best point so far that meets all limits, or else the one closest to that.
    """

    problem: TuningProblem
    figures: Figures
    scales: Array
    best: tuple[Array, Judged] | None = field(default=None)

    def over_runs(self, at: Figured) -> Array:
        """Figures of all measures over all runs, shape ``(measure,)``."""
        weights = self.problem.weights or [1.0] * at.figures.shape[1]
        pairs = zip(self.problem.measures, at.figures, strict=True)
        return np.array([m.over(row, weights)[0] for m, row in pairs])

    def judged(self, at: Figured) -> Judged:
        """Objective and constraints of figures, with slopes where these have them."""
        problem, n = self.problem, len(at.theta)
        weights = problem.weights or [1.0] * at.figures.shape[1]
        slopes = np.zeros((*at.figures.shape, n)) if at.slopes is None else at.slopes
        objective, slope = 0.0, np.zeros(n)
        for k, goal in enumerate(problem.objective):
            value, by_run = goal.over(at.figures[k], weights)
            share = goal.weight / self.scales[k]
            objective += share * value
            slope += share * (by_run @ slopes[k])
        excess, turned = list[float](), list[Array]()
        for k, limit in enumerate(problem.constraints, len(problem.objective)):
            size = limit.sign / (abs(limit.bound) or 1.0)
            if limit.extreme:
                # Of every run: the largest of several has no slope where they change places.
                excess += [float(limit.excess(v)) for v in at.figures[k]]
                turned += list(size * slopes[k])
                continue
            value, by_run = limit.over(at.figures[k], weights)
            excess.append(float(limit.excess(value)))
            turned.append(size * (by_run @ slopes[k]))
        bent = np.stack(turned) if turned else np.zeros((0, n))
        return Judged(objective, slope, np.array(excess), bent)

    def at(self, theta: Array, slopes: bool = False) -> Judged | None:
        """A point judged and remembered; None where a loop ended early."""
        found = self.figures(theta, slopes)
        if not found.stable:
            return None
        judged = self.judged(found)
        if self.best is None or _better(judged, self.best[1]):
            self.best = (theta, judged)
        return judged


def _better(new: Judged, old: Judged) -> bool:
    """Less violation while limits are not met, a smaller objective where they are."""
    if old.violation > FEASIBLE or new.violation > FEASIBLE:
        return max(new.violation, FEASIBLE) < max(old.violation, FEASIBLE)
    return new.objective < old.objective


def search_from(
    search: Search,
    first: Array,
    *,
    bounds: tuple[Array, Array],
    iterations: int,
    tolerance: float,
) -> Start:
    """Go downhill from a point within bounds.

    SLSQP with constraints, L-BFGS-B without, on exact slopes. Where a loop ends early the point
    costs more than any other and the line search turns back.

    Parameters
    ----------
    search
        The problem; it remembers the best point.
    first
        Values of the parameters.
    bounds
        Lowest and highest ones.
    iterations, tolerance
        When to stop.

    Returns
    -------
    Start
    """
    low, span = bounds[0], bounds[1] - bounds[0]
    theta0 = np.clip(first, *bounds)
    begun = search.at(theta0, slopes=True)
    if begun is None:
        ends = (tuple(theta0), tuple(theta0))
        return Start(*ends, None, TuneStatus.UNSTABLE, 0)
    before = replace_best(search, (theta0, begun))
    unit = abs(begun.objective) or 1.0
    n = len(begun.excess)

    def theta(x: Array) -> Array:
        return low + span * np.clip(x, 0.0, 1.0)

    def objective(x: Array) -> float:
        judged = search.at(theta(x))
        return _UNSTABLE if judged is None else judged.objective / unit

    def gradient(x: Array) -> Array:
        judged = search.at(theta(x), slopes=True)
        return np.zeros(len(x)) if judged is None else judged.slope * span / unit

    def room(x: Array) -> Array:
        judged = search.at(theta(x))
        return np.full(n, -1.0) if judged is None else -judged.excess

    def room_slope(x: Array) -> Array:
        judged = search.at(theta(x), slopes=True)
        return np.zeros((n, len(x))) if judged is None else -judged.excess_slope * span

    method = "SLSQP" if n else "L-BFGS-B"
    options: dict[str, Any] = {"maxiter": iterations, "ftol": tolerance}
    limits = [{"type": "ineq", "fun": room, "jac": room_slope}] if n else ()
    # SciPy's typing knows neither of both.
    done: OptimizeResult = minimize(  # pyright: ignore[reportCallIssue]
        objective,
        (theta0 - low) / span,
        jac=gradient,
        bounds=[(0.0, 1.0)] * len(low),
        method=method,
        constraints=limits,  # pyright: ignore[reportArgumentType]
        options=options,
    )
    assert search.best is not None
    last, judged = search.best
    status = TuneStatus.SOLVED if done.success else TuneStatus.STALLED
    if done.status in _LIMITS[method] and not done.success:
        status = TuneStatus.LIMIT
    if judged.violation > FEASIBLE:
        status = TuneStatus.INFEASIBLE
    if before is not None and _better(before[1], judged):
        search.best = before
    met = judged.objective if judged.violation <= FEASIBLE else None
    return Start(tuple(theta0), tuple(last), met, status, int(done.nit))


def replace_best(search: Search, point: tuple[Array, Judged] | None) -> tuple[Array, Judged] | None:
    """Let a search remember another point, and tell the one that it remembered."""
    before, search.best = search.best, point
    return before


def weighted(problem: TuningProblem, share: float) -> TuningProblem:
    """The same problem with a share of the weight on the first of two terms."""
    first, second = problem.objective
    return replace(
        problem,
        objective=(
            replace(first, weight=first.weight * share),
            replace(second, weight=second.weight * (1 - share)),
        ),
    )

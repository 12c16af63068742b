"""A problem solved on one mesh after the other, and what happened on them."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dfsm.control.between import require_followed, tell_of_held
from dfsm.control.diagnose import require_finite, worst_violation
from dfsm.control.guess import Start, start_of
from dfsm.control.mesh.grid import Grid
from dfsm.control.nlp.estimate import Estimate
from dfsm.control.nlp.ipopt import Outcome, SolverSettings, solve_nlp
from dfsm.control.nlp.knots import knots_of
from dfsm.control.nlp.program import Program
from dfsm.control.nlp.shot import Method, Shot
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.solution import Solution
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.models.dfsm import DFSM

# Outcomes of the solver that can be built on.
_GOOD = ("solved", "acceptable", "stalled")
# Outcomes after which nothing else is tried.
_NO_MORE = ("interrupted", "time")
# Objectives that vary by less than 1, by this factor, are scaled up, by no more than the second.
_CLEARLY, _MOST_SCALE = 3.0, 1e4
# Scaled violations up to which a start counts as close to a solution.
_NEAR = 1e-2
# Tolerance of what only starts the next solve.
_ROUGHLY = 1e-4
# So many meshes must together lower the largest error by this factor.
_PATIENCE, _LESS = 3, 0.7
# Endings that a mesh may owe to being too coarse; it is then cut so finely, up to so many starts,
# unless it has more than so many intervals.
_NOT_SO_FINE = ("infeasible", "failed")
_FINER, _STARTS, _MOST_COARSE = 3, 3, 300
# A size that comes from values on a coarser mesh is no smaller than this share of the size there: a
# state that stayed at rest is known to the tolerance only.
_LEAST_OF_BEFORE = 1e-3
# A size below this share of where a solve went, of 1 at most, was none.
_OUTGROWN = 1e-4
_OUT_OF_TIME = (
    "the time limit came before a finer mesh was solved: raise most_seconds, or loosen refine"
)


class Record:
    """What happened on every mesh.

    Attributes
    ----------
    shot, outcome, start
        The last mesh's program, how the solver ended on it, and the values at its nodes.
    error, coarse
        Its largest local error of the dynamics, and whether any error is above what was asked.
    estimate
        All errors on the last mesh.
    refines
        Whether errors between the nodes were to meet anything.
    why
        Why no finer mesh was tried although one was asked for, and what to do; else "".
    tolerance, objective_scale
        Of the solver, and of the objective that it saw.
    meshes, iterations, compile, solve
        As in `Solution`; times in s.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self.compile = self.solve = 0.0
        self.meshes: list[dict[str, Any]] = []
        self.iterations = 0
        self.coarse = self.refines = False
        self.why = ""
        self.objective_scale = 1.0

    def add(self, shot: Shot, outcome: Outcome, start: Start, estimate: Estimate) -> None:
        """Keep one mesh."""
        self.start, self.estimate = start, estimate
        self.error = estimate.errors["dynamics"]
        self.shot, self.outcome = shot, outcome
        self.objective_scale = shot.program.objective_scale
        self.solve += outcome.seconds
        self.iterations += outcome.iterations
        self.meshes.append(
            {
                "intervals": shot.grid.intervals,
                "objective": shot.program.cost(outcome.z),
                "error": self.error,
                "errors": estimate.errors,
                "iterations": outcome.iterations,
            }
        )

    def go_back(self, shot: Shot, outcome: Outcome, start: Start, estimate: Estimate) -> None:
        """Let an earlier mesh be the last one; what the later ones took still counts."""
        self.shot, self.outcome, self.start, self.estimate = shot, outcome, start, estimate
        self.error = estimate.errors["dynamics"]

    def after(self, other: Record | None) -> Record:
        """Itself, with the meshes of another counted before its own."""
        if other is not None:
            self.compile += other.compile
            self.solve += other.solve
            self.iterations += other.iterations
            self.meshes = [*other.meshes, *self.meshes]
        return self


def solve_meshes(
    problem: OptimalControlProblem,
    method: Method,
    guess: Solution | Trajectory | None,
    on_the_way: bool = False,
) -> Record:
    """Solve on one mesh after the other, each from the solution on the last.

    Parameters
    ----------
    problem, method
        What, and how.
    guess
        See `solve`.
    on_the_way
        What comes out only starts the next solve: one mesh, and not to the last digit.

    Returns
    -------
    Record
        What the last mesh came to, and what all took.
    """
    until = None if method.most_seconds is None else clock.perf_counter() + method.most_seconds
    tolerance = max(method.tolerance, _ROUGHLY) if on_the_way else method.tolerance
    settings = SolverSettings(tolerance, method.most_iterations, until=until)
    refine = None if on_the_way else method.refine
    record, grid = Record(tolerance), _first_grid(problem, method)
    record = _from_guess(record, problem, method, grid, guess, settings)
    if refine is None:
        return record
    record.refines = True
    for _ in range(_STARTS - 1):
        if record.outcome.ending not in _NOT_SO_FINE or grid.intervals > _MOST_COARSE:
            break
        grid = grid.finer(_FINER)
        record = _from_guess(record, problem, method, grid, guess, settings)
    return _refined(record, problem, method, refine, settings)


def _first_grid(problem: OptimalControlProblem, method: Method) -> Grid:
    """The first mesh, on which controls are held that are to be."""
    grid, model = method.grid(), problem.model
    own = model.signals.between if isinstance(model, DFSM) else ()
    require_followed(grid, problem.plant, problem.between, problem.free_time is not None)
    tell_of_held(problem.plant, own, problem.inputs)
    return grid.holding() if problem.holds_controls else grid


def _from_guess(
    record: Record,
    problem: OptimalControlProblem,
    method: Method,
    grid: Grid,
    guess: Solution | Trajectory | None,
    settings: SolverSettings,
) -> Record:
    """Solve on a mesh from what the user gave."""
    start = start_of(problem, guess, grid.tau)
    multipliers = None
    if isinstance(guess, Solution) and np.array_equal(guess.grid.edges, grid.edges):
        multipliers = guess.solver_state
    settings = replace(settings, warm=isinstance(guess, Solution))
    record = _on(record, method.shot(problem, grid, start), start, settings, multipliers)
    resized = _resized(record, start, not isinstance(guess, Solution))
    if resized is None:
        return record
    before = record.shot, record.outcome, record.start, record.estimate
    held = _holds(record) and record.outcome.iterations > 0
    record = _on(record, method.shot(problem, grid, resized), resized, settings)
    if held and not _holds(record) and record.outcome.ending != "unbounded":
        record.go_back(*before)
    return record


def _holds(record: Record) -> bool:
    """Whether the last outcome is a solution on its mesh."""
    outcome = record.outcome
    return outcome.ending in _GOOD and outcome.optimality.held(record.tolerance)


def _resized(record: Record, start: Start, fresh: bool) -> Start | None:
    """The start with larger sizes, where those that it gave turned out to be none; else None.

    A start may be tiny with nothing beside it that says so, as where a simulation came to rest. The
    solver then works with numbers that its tolerance does not fit: it fails, or finds at once that
    no step matters. Sizes grow to where it went, but not beyond the 1 that a start at 0 gets, and
    to that where a fresh start was left by no step.
    """
    outcome, layout = record.outcome, record.shot.layout
    if outcome.ending in _NO_MORE:
        return None
    before = layout.sizes(record.shot.program.scale)
    went = [np.nan_to_num(np.abs(v)).max(axis=(0, 1)) for v in (record.start.X, record.start.U)]
    if fresh and outcome.iterations == 0:
        went = [np.ones_like(v) for v in went]
    usual = [np.minimum(v, 1.0) for v in went]
    X, U = (np.where(b < _OUTGROWN * v, v, b) for b, v in zip(before, usual, strict=True))
    start = replace(start, sizes=(X, U))
    # Limits and training ranges go before what a start says.
    resized = replace(layout, start=start)
    after = resized.sizes(resized.scale(*resized.limits()))
    grew = any((a > b).any() for a, b in zip(after, before, strict=True))
    return start if grew else None


def _on(
    record: Record,
    shot: Shot,
    start: Start,
    settings: SolverSettings,
    multipliers: Array | None = None,
) -> Record:
    """Solve on one mesh, near the start where the settings say so and it is near a solution."""
    begin = clock.perf_counter()
    shot.program.objective_scale = record.objective_scale
    z = shot.scaled(start)
    _prepare(shot, z)
    warm = settings.warm and _is_near(shot, start)
    record.compile += clock.perf_counter() - begin
    outcome = _solve_scaled(
        shot.program, z, replace(settings, warm=warm), multipliers if warm else None
    )
    start = shot.unscaled(outcome.z)
    record.add(shot, outcome, start, shot.estimate(outcome, start))
    return record


def _refined(
    record: Record,
    problem: OptimalControlProblem,
    method: Method,
    refine: float,
    settings: SolverSettings,
) -> Record:
    """Cut intervals, and solve again, until all errors are below what was asked."""
    history, knots = [record.estimate.largest], None
    for round_ in range(method.most_refinements + 1):
        grid = record.shot.grid
        if record.outcome.ending not in _GOOD or history[-1][1] <= refine:
            break
        record.why = _hopeless(history, record.shot, method, settings.until)
        if record.why or round_ == method.most_refinements:
            break
        knots = knots_of(problem, record.shot.functions) if knots is None else knots
        finer = method.refined(grid, record.estimate.local(refine), refine, knots)
        start = replace(
            record.start,
            X=np.stack([grid.states(X, finer.tau) for X in record.start.X]),
            U=np.stack([grid.controls(U, finer.tau) for U in record.start.U]),
            sizes=_shares(record.shot),
        )
        before = (record.shot, record.outcome, record.start, record.estimate)
        shot = method.shot(problem, finer, start)
        record = _on(record, shot, start, replace(settings, warm=True))
        if record.outcome.ending == "time":
            # What was solved on the mesh before is worth more than what was begun.
            record.go_back(*before)
            record.why = _OUT_OF_TIME
            break
        history.append(record.estimate.largest)
    record.coarse = not record.estimate.largest[1] <= refine
    return record


def _shares(shot: Shot) -> tuple[Array, Array]:
    """What is the least of sizes on a finer mesh."""
    X, U = shot.layout.sizes(shot.program.scale)
    return _LEAST_OF_BEFORE * X, _LEAST_OF_BEFORE * U


def _hopeless(
    history: Sequence[tuple[str, float]], shot: Shot, method: Method, until: float | None
) -> str:
    """Why no finer mesh is worth trying, and what to do instead; "" while one is."""
    if until is not None and clock.perf_counter() > until:
        return _OUT_OF_TIME
    instead = f"{shot.otherwise}, or loosen refine"
    if shot.grid.intervals > method.most_intervals:
        return f"more than {method.most_intervals} intervals are not tried: {instead}"
    if len(history) > _PATIENCE and history[-1][1] > _LESS * history[-1 - _PATIENCE][1]:
        kind, error = history[-1]
        return (
            f"{_PATIENCE} finer meshes did not lower the largest error, {error:.2g} of the {kind}"
            f": {instead}"
        )
    return ""


def _is_near(shot: Shot, start: Start) -> bool:
    """Whether a start nearly meets all bounds and constraints.

    Staying close to one that does not costs several times the iterations of starting afresh from
    its states and controls.
    """
    program, z = shot.program, shot.scaled(start)
    moved = np.abs(shot.layout.pack(start) / program.scale - z).max(initial=0.0)
    return max(float(moved), worst_violation(program, z)) < _NEAR


def _prepare(shot: Shot, z: Array) -> None:
    """Refuse a start at which something is not finite, and compile all that the solver calls."""
    require_finite(shot.program, z, shot.row_times(), shot.output_names(), "the guess")
    shot.program.hessian(z, 1.0, np.zeros(shot.program.m))


def _solve_scaled(
    program: Program, z: Array, settings: SolverSettings, multipliers: Array | None
) -> Outcome:
    """Solve, and again if the objective turns out to vary so little that tolerances hide it.

    Its value does not matter: a constant may be part of it.
    """
    scale = program.objective_scale
    first = _solve_once(program, z, settings, multipliers)
    if settings.warm and first.ending not in (*_GOOD, *_NO_MORE):
        # What looked close was not: start afresh from the same point.
        first = _solve_once(program, z, replace(settings, warm=False), None)
    if first.ending == "failed" and program.linear_quadratic:
        first = _solve_once(program, z, replace(settings, warm=False, adaptive=False), None)
    if first.ending not in _GOOD:
        return first
    variation = program.variation(first.z)
    wanted = min(1 / max(variation, 1e-300), _MOST_SCALE)
    if variation == 0 or wanted < _CLEARLY * scale:
        return first
    program.objective_scale = wanted
    second = _solve_once(program, first.z, replace(settings, warm=True), first.multipliers)
    if second.ending != "solved":
        program.objective_scale = scale
        return replace(first, ending="interrupted") if second.ending == "interrupted" else first
    return replace(
        second,
        iterations=first.iterations + second.iterations,
        seconds=first.seconds + second.seconds,
    )


def _solve_once(
    program: Program, z: Array, settings: SolverSettings, multipliers: Array | None
) -> Outcome:
    """Solve; multipliers, in and out, are those of the objective without its scale."""
    scale = program.objective_scale
    if multipliers is not None:
        multipliers = None if len(multipliers) != program.m else scale * multipliers
    outcome = solve_nlp(program, z, settings, multipliers)
    return replace(
        outcome,
        multipliers=outcome.multipliers / scale,
        bound_multipliers=outcome.bound_multipliers / scale,
    )

"""A problem solved on one mesh after the other, and what happened on them."""

from __future__ import annotations

import time as clock
from dataclasses import replace
from typing import Any

import numpy as np

from dfsm.control.diagnose import require_finite, worst_violation
from dfsm.control.guess import Start, start_of
from dfsm.control.nlp.ipopt import Outcome, SolverSettings, solve_nlp
from dfsm.control.nlp.program import Program
from dfsm.control.nlp.shot import Method, Shot
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.solution import Solution
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory

# Outcomes of the solver that can be built on.
_GOOD = ("solved", "acceptable", "stalled")
# Objectives that vary by less than 1, by this factor, are scaled up, by no more than the second.
_CLEARLY, _MOST_SCALE = 3.0, 1e4
# Scaled violations up to which a start counts as close to a solution.
_NEAR = 1e-2
# Tolerance of what only starts the next solve.
_ROUGHLY = 1e-4
# Meshes are not refined beyond this many intervals.
_MOST_INTERVALS = 5000


class Record:
    """What happened on every mesh.

    Attributes
    ----------
    shot, outcome, start
        The last mesh's program, how the solver ended on it, and the values at its nodes.
    error, coarse
        Its largest local error, and whether that is above what was asked.
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
        self.coarse = False
        self.objective_scale = 1.0

    def add(self, shot: Shot, outcome: Outcome, start: Start, error: float) -> None:
        """Keep one mesh."""
        self.start = start
        self.shot, self.outcome, self.error = shot, outcome, error
        self.objective_scale = shot.program.objective_scale
        self.solve += outcome.seconds
        self.iterations += outcome.iterations
        self.meshes.append(
            {
                "intervals": shot.grid.intervals,
                "objective": shot.program.cost(outcome.z),
                "error": error,
                "iterations": outcome.iterations,
            }
        )

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
    grid = method.grid()
    start = start_of(problem, guess, grid.tau)
    near, multipliers = isinstance(guess, Solution), None
    if isinstance(guess, Solution) and np.array_equal(guess.grid.edges, grid.edges):
        multipliers = guess.solver_state
    tolerance = max(method.tolerance, _ROUGHLY) if on_the_way else method.tolerance
    record = Record(tolerance)
    refine, rounds = None if on_the_way else method.refine, method.most_refinements
    for round_ in range(rounds + 1):
        begin = clock.perf_counter()
        shot = method.shot(problem, grid, start)
        shot.program.objective_scale = record.objective_scale
        z = shot.scaled(start)
        _prepare(shot, z)
        warm = near and _is_near(shot, start)
        record.compile += clock.perf_counter() - begin
        settings = SolverSettings(tolerance, method.most_iterations, warm)
        outcome = _solve_scaled(shot.program, z, settings, multipliers if warm else None)
        start = shot.unscaled(outcome.z)
        errors = shot.errors(start)
        record.add(shot, outcome, start, float(errors.max()))
        if refine is None or errors.max() <= refine or grid.intervals > _MOST_INTERVALS:
            break
        if round_ == rounds or outcome.ending not in _GOOD:
            break
        old, grid = grid, grid.refined(errors, refine)
        start = replace(
            start,
            X=np.stack([old.states(X, grid.tau) for X in start.X]),
            U=np.stack([old.controls(U, grid.tau) for U in start.U]),
        )
        near, multipliers = True, None
    record.coarse = refine is not None and not record.error <= refine
    return record


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
    if settings.warm and first.ending not in (*_GOOD, "interrupted"):
        # What looked close was not: start afresh from the same point.
        first = _solve_once(program, z, replace(settings, warm=False), None)
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

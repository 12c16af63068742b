"""`solve`: from a problem to a solution, with mesh refinement, checks and a replay."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from dfsm.control.diagnose import conflict, require_finite, worst_violation
from dfsm.control.guess import Start, start_of
from dfsm.control.nlp import NlpOptions, Outcome, solve_nlp
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.program import Program
from dfsm.control.replay import replay
from dfsm.control.solution import Ending, Solution
from dfsm.control.transcription import DirectTranscription, Transcription, node_data
from dfsm.errors import DfsmError
from dfsm.trajectory import Role, Trajectory
from dfsm.types import Array

_ENDINGS = {
    "solved": Ending.SOLVED,
    "acceptable": Ending.ACCEPTABLE,
    "infeasible": Ending.INFEASIBLE,
    "limit": Ending.LIMIT,
    "interrupted": Ending.INTERRUPTED,
    "not finite": Ending.NOT_FINITE,
    "failed": Ending.FAILED,
}

# Objectives below this are scaled up, by no more than that.
_SMALL, _MOST_SCALE = 0.3, 1e4
# Meshes are not refined beyond this many intervals.
_MOST_INTERVALS = 5000


def solve(
    problem: OptimalControlProblem,
    method: DirectTranscription | None = None,
    guess: Solution | Trajectory | None = None,
    simulate: bool = True,
) -> Solution:
    """Solve an optimal control problem.

    Parameters
    ----------
    problem
        What to minimise, subject to what.
    method
        How; default `DirectTranscription` with its defaults.
    guess
        None starts from straight lines between the ends. A run gives the states and controls that
        it holds; a solution, of any mesh or method, gives all and is stayed close to.
    simulate
        Integrate the model with the optimal controls and report how far the states deviate.

    Returns
    -------
    Solution
        Also of a solve that did not succeed: look at its `ending`, or print its `summary()`.

    Raises
    ------
    DfsmError
        A function that names an unknown signal, is not finite at the start, or cannot be followed
        by JAX; bounds or settings that contradict each other.
    """
    method = method or DirectTranscription()
    grid = method.grid()
    start = start_of(problem, guess, grid.tau)
    warm = isinstance(guess, Solution)
    multipliers = None
    if isinstance(guess, Solution) and np.array_equal(guess.grid.edges, grid.edges):
        multipliers = guess.solver_state
    record = _Record()
    for round_ in range(method.most_refinements + 1):
        begin = clock.perf_counter()
        shot = Transcription(problem, grid, start, method.stay_inside)
        program = shot.program
        z = shot.scaled(start)
        times = np.tile(shot.layout.time, shot.layout.scenarios)
        require_finite(program, shot.functions, z, times, "the guess")
        program.hessian(z, 1.0, np.zeros(program.m))
        record.compile += clock.perf_counter() - begin
        options = NlpOptions(method.tolerance, method.most_iterations, warm)
        if multipliers is not None and multipliers.shape != (program.m,):
            multipliers = None
        outcome = _solve_scaled(program, z, options, multipliers)
        start = shot.unscaled(outcome.z)
        errors = shot.errors(start)
        record.add(shot, outcome, float(errors.max()))
        done = method.refine is None or errors.max() <= method.refine
        too_many = shot.grid.intervals > _MOST_INTERVALS
        if done or too_many or outcome.ending not in ("solved", "acceptable"):
            break
        if round_ < method.most_refinements:
            grid = grid.refined(errors, method.refine)
            start = Start(
                np.stack([shot.grid.states(X, grid.tau) for X in start.X]),
                np.stack([shot.grid.controls(U, grid.tau) for U in start.U]),
                start.p,
                start.stop,
            )
            warm, multipliers = True, None
    record.coarse = method.refine is not None and record.error > method.refine
    return _solution(problem, record, start, simulate)


def _solve_scaled(
    program: Program, z: Array, options: NlpOptions, multipliers: Array | None
) -> Outcome:
    """Solve, and again if the objective turns out to be so small that tolerances hide it."""
    outcome = solve_nlp(program, z, options, multipliers)
    value = abs(program.cost(outcome.z))
    if not (outcome.ending in ("solved", "acceptable") and 0 < value < _SMALL):
        return outcome
    program.objective_scale = min(1 / value, _MOST_SCALE)
    again = replace(options, warm=True)
    second = solve_nlp(program, outcome.z, again, outcome.multipliers * program.objective_scale)
    if second.ending != "solved":
        program.objective_scale = 1.0
        return outcome
    return replace(
        second,
        multipliers=second.multipliers / program.objective_scale,
        bound_multipliers=second.bound_multipliers / program.objective_scale,
        iterations=outcome.iterations + second.iterations,
        seconds=outcome.seconds + second.seconds,
    )


class _Record:
    """What happened on every mesh."""

    def __init__(self) -> None:
        self.compile = self.solve = 0.0
        self.meshes: list[dict[str, Any]] = []
        self.iterations = 0
        self.coarse = False

    def add(self, shot: Transcription, outcome: Outcome, error: float) -> None:
        """Keep one mesh."""
        self.shot, self.outcome, self.error = shot, outcome, error
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


def _solution(
    problem: OptimalControlProblem, record: _Record, start: Start, simulate: bool
) -> Solution:
    shot, outcome = record.shot, record.outcome
    program, z = shot.program, outcome.z
    ending = _ENDINGS[outcome.ending]
    if ending is Ending.SOLVED and record.coarse:
        ending = Ending.COARSE
    final_cost = float(program.blocks[1].c @ program.outputs(z)[1].ravel())
    objective = program.cost(z)
    trajectories = trajectories_of(problem, shot.tau, start)
    replays = ()
    if simulate and ending.solved:
        count = range(len(problem.scenarios))
        replays = tuple(replay(problem, shot.grid, start, k) for k in count)
    return Solution(
        name=problem.name,
        ending=ending,
        reason="" if ending.solved else _reason(shot, outcome),
        objective=objective,
        final_cost=final_cost,
        integral_cost=objective - final_cost,
        trajectories=trajectories,
        costates=shot.costates(outcome.multipliers / program.row_scale),
        multipliers=_multipliers(program, outcome),
        parameters=parameters_of(problem, start),
        grid=shot.grid,
        error=record.error,
        meshes=tuple(record.meshes),
        iterations=record.iterations,
        seconds={"compile": record.compile, "solve": record.solve},
        linear_quadratic=program.linear_quadratic,
        violation=worst_violation(program, z),
        outside=_outside(problem, trajectories),
        replays=replays,
        solver_state=outcome.multipliers,
    )


def _reason(shot: Transcription, outcome: Outcome) -> str:
    program, z = shot.program, outcome.z
    if outcome.ending == "not finite":
        try:
            times = np.tile(shot.layout.time, shot.layout.scenarios)
            require_finite(program, shot.functions, z, times, "the last iterate")
        except DfsmError as error:
            return str(error).split(": give a guess")[0]
    return conflict(program, z)


def _multipliers(program: Program, outcome: Outcome) -> dict[str, Array]:
    """Of bounds, path and boundary constraints by name; the dynamics' are costates."""
    found = {}
    for rows in program.variables:
        found[rows.name] = outcome.bound_multipliers[rows.index] / program.scale[rows.index]
    for rows in program.rows:
        if not rows.name.startswith("dynamics of "):
            values = outcome.multipliers[rows.index] / program.row_scale[rows.index]
            found[rows.name] = np.append(found.get(rows.name, np.empty(0)), values)
    return found


def parameters_of(problem: OptimalControlProblem, start: Start) -> dict[str, float]:
    """All plant parameters by name, the free ones as they were found."""
    found = dict(zip(problem.free_parameters, map(float, start.p), strict=True))
    names = problem.plant.names("parameters")
    return {n: found.get(n, problem.parameters[n]) for n in names}  # pyright: ignore


def trajectories_of(
    problem: OptimalControlProblem, tau: Array, start: Start
) -> tuple[Trajectory, ...]:
    """States, controls, disturbances, parameters and outputs of every scenario at the nodes."""
    plant = problem.plant
    time = problem.start + tau * (start.stop - problem.start)
    p = np.array(list(parameters_of(problem, start).values()))
    count = len(problem.scenarios)
    w = node_data(problem, tau, time)["w"].reshape(count, len(tau), len(plant.names("disturbances")))
    roles: dict[str, Role] = {
        "states": "state",
        "controls": "control",
        "disturbances": "disturbance",
        "parameters": "parameter",
        "outputs": "output",
    }
    channels = [replace(c, role=role) for g, role in roles.items() for c in plant.channels[g]]
    found = []
    output = jax.vmap(plant.output, (0, 0, 0, None))
    for s in range(count):
        y = np.asarray(output(start.X[s], start.U[s], w[s], p))
        fixed = np.broadcast_to(p, (len(tau), len(p)))
        values = np.concatenate([start.X[s], start.U[s], w[s], fixed, y], axis=1)
        name = problem.name if count == 1 else f"{problem.name}, scenario {s + 1}"
        found.append(Trajectory(time, values, tuple(channels), name=name))
    return tuple(found)


def _outside(problem: OptimalControlProblem, runs: Sequence[Trajectory]) -> float | None:
    """Share of the horizon with any input outside the training range."""
    plant = problem.plant
    if plant.region is None:
        return None
    groups = ("controls", "disturbances", "states", "parameters")
    names = [n for g in groups for n in plant.names(g)]
    shares = []
    for run in runs:
        outside = np.asarray(plant.region.outside(run.select(names).values), dtype=float)
        # Each sample stands for half of the steps beside it.
        shares.append(np.trapezoid(outside, run.time) / run.duration)
    return float(np.mean(shares))

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
from dfsm.control.names import Signals
from dfsm.control.nlp.ipopt import Outcome, SolverSettings, solve_nlp
from dfsm.control.nlp.program import Program
from dfsm.control.nlp.shooting import MultipleShooting, Shooting, SingleShooting
from dfsm.control.nlp.transcription import DirectTranscription, Transcription, node_data
from dfsm.control.problem import OptimalControlProblem, level
from dfsm.control.replay import replay
from dfsm.control.solution import HELD, RATE, Ending, Solution
from dfsm.core.types import Array
from dfsm.data.trajectory import Role, Trajectory
from dfsm.errors import DfsmError

Shot = Transcription | Shooting
Method = DirectTranscription | MultipleShooting | SingleShooting

_ENDINGS = {
    "solved": Ending.SOLVED,
    "acceptable": Ending.ACCEPTABLE,
    "stalled": Ending.STALLED,
    "infeasible": Ending.INFEASIBLE,
    "limit": Ending.LIMIT,
    "interrupted": Ending.INTERRUPTED,
    "not finite": Ending.NOT_FINITE,
    "failed": Ending.FAILED,
}

# Endings before the tolerance is met: they count only as far as the measured conditions hold.
_EARLY = (Ending.ACCEPTABLE, Ending.STALLED)
# Outcomes of the solver that can be built on.
_GOOD = ("solved", "acceptable", "stalled")
# Objectives that vary by less than 1, by this factor, are scaled up, by no more than the second.
_CLEARLY, _MOST_SCALE = 3.0, 1e4
# Scaled violations up to which a start counts as close to a solution.
_NEAR = 1e-2
# By which factor the bound on the distance from the training data is tightened at most.
_TIGHTER = 4.0
# Tolerance of what is solved on the way there.
_ROUGHLY = 1e-4
# Meshes are not refined beyond this many intervals.
_MOST_INTERVALS = 5000


def solve(
    problem: OptimalControlProblem,
    method: Method | None = None,
    guess: Solution | Trajectory | None = None,
    simulate: bool = True,
) -> Solution:
    """Solve an optimal control problem.

    Parameters
    ----------
    problem
        What to minimise, subject to what.
    method
        `DirectTranscription`, `MultipleShooting` or `SingleShooting`; None is the first with its
        defaults.
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
    region = problem.plant.region
    if not method.stay_inside or region is None or not region.whitening.size:
        return _solution(problem, _solve_meshes(problem, method, guess), simulate)
    if isinstance(guess, Solution):
        return _solution(*_inside(problem, method, guess), simulate)
    # The distance bends the feasible set: from the optimum without it the solver needs tens of
    # iterations, from a guess hundreds.
    first = _solve_meshes(problem, _on_the_way(method), guess)
    free = _solution(problem, first, simulate=False)
    if not free.solved:
        return _solution(problem, first, simulate)
    inside, record = _inside(problem, method, free)
    return _solution(inside, record.after(first), simulate)


def _inside(
    problem: OptimalControlProblem, method: Method, guess: Solution
) -> tuple[OptimalControlProblem, _Record]:
    """Solve with a bound on the distance from the training data, tightened step by step.

    From far outside, the last bound at once costs hundreds of iterations or is never met.
    """
    farthest, done = max(_farthest(problem, guess), 1.0), None
    steps = max(1, int(np.ceil(np.log(farthest) / np.log(_TIGHTER))))
    for step in range(1, steps):
        looser = _within(problem, farthest ** (1 - step / steps))
        done = _solve_meshes(looser, _on_the_way(method), guess).after(done)
        if done.outcome.ending == "interrupted":
            return looser, done
        guess = _solution(looser, done, simulate=False)
    inside = _within(problem, 1.0)
    return inside, _solve_meshes(inside, method, guess).after(done)


def _on_the_way(method: Method) -> Method:
    """The method for what only starts the next solve: on one mesh, and not to the last digit."""
    method = replace(method, tolerance=max(method.tolerance, _ROUGHLY))
    return replace(method, refine=None) if isinstance(method, DirectTranscription) else method


def _within(problem: OptimalControlProblem, limit: float) -> OptimalControlProblem:
    kept = {"distance from the training data": (_distance, None, limit)}
    return replace(problem, constraints={**problem.constraints, **kept})


def _farthest(problem: OptimalControlProblem, found: Solution) -> float:
    """Largest distance of a solution's nodes, see `Region.distance_chosen`."""
    region = problem.plant.region
    values = [_inputs(problem, run) for run in found.trajectories]
    return max(float(region.distance_chosen(v).max()) for v in values) if region else 0.0


def _distance(signals: Signals) -> Any:
    return signals.distance


def _solve_meshes(
    problem: OptimalControlProblem, method: Method, guess: Solution | Trajectory | None
) -> _Record:
    """Solve on one mesh after the other, each from the solution on the last."""
    grid = method.grid()
    start = start_of(problem, guess, grid.tau)
    near, multipliers = isinstance(guess, Solution), None
    if isinstance(guess, Solution) and np.array_equal(guess.grid.edges, grid.edges):
        multipliers = guess.solver_state
    record = _Record(method.tolerance)
    # What direct transcription has and shooting has not.
    refine = method.refine if isinstance(method, DirectTranscription) else None
    rounds = method.most_refinements if isinstance(method, DirectTranscription) else 0
    for round_ in range(rounds + 1):
        begin = clock.perf_counter()
        if isinstance(method, DirectTranscription):
            shot = Transcription(problem, grid, start, method.stay_inside)
        else:
            shot = Shooting(problem, method, start)
        shot.program.objective_scale = record.objective_scale
        z = shot.scaled(start)
        _prepare(shot, z)
        warm = near and _is_near(shot, start)
        record.compile += clock.perf_counter() - begin
        settings = SolverSettings(method.tolerance, method.most_iterations, warm)
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
    require_finite(shot.program, z, node_times(shot), output_names(shot), "the guess")
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
    variation = program.variation(first.z)
    wanted = min(1 / max(variation, 1e-300), _MOST_SCALE)
    if first.ending not in _GOOD or variation == 0 or wanted < _CLEARLY * scale:
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
    """Solve; multipliers, given and found, are those of the objective without its scale."""
    scale = program.objective_scale
    if multipliers is not None:
        multipliers = None if len(multipliers) != program.m else scale * multipliers
    found = solve_nlp(program, z, settings, multipliers)
    return replace(
        found,
        multipliers=found.multipliers / scale,
        bound_multipliers=found.bound_multipliers / scale,
    )


class _Record:
    """What happened on every mesh."""

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

    def after(self, other: _Record | None) -> _Record:
        """Itself, with the meshes of another counted before its own."""
        if other is not None:
            self.compile += other.compile
            self.solve += other.solve
            self.iterations += other.iterations
            self.meshes = [*other.meshes, *self.meshes]
        return self


def _solution(problem: OptimalControlProblem, record: _Record, simulate: bool) -> Solution:
    shot, outcome, start = record.shot, record.outcome, record.start
    program, z = shot.program, outcome.z
    ending = _ending(record)
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
        reason=_reason(shot, outcome, ending),
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
        bounds=_bounds(shot, trajectories[0].time),
        solver_state=outcome.multipliers,
        optimality=outcome.optimality,
    )


def _ending(record: _Record) -> Ending:
    """What the solver says, as far as the measured optimality conditions bear it out."""
    ending, measured = _ENDINGS[record.outcome.ending], record.outcome.optimality
    if ending is Ending.SOLVED and record.coarse:
        return Ending.COARSE
    if ending in _EARLY and not measured.held(record.tolerance):
        return Ending.INACCURATE
    return ending


def _reason(shot: Shot, outcome: Outcome, ending: Ending) -> str:
    program, z, measured = shot.program, outcome.z, outcome.optimality
    if ending in _EARLY:
        return f"the optimality conditions hold to {measured.worst:.2g}"
    if ending is Ending.INACCURATE:
        why = "steps became too small" if outcome.ending == "stalled" else "the solver ended early"
        text = f"{why} where the optimality conditions hold to {measured.worst:.2g} only"
        return f"{text}, {conflict(program, z)}" if measured.violation > HELD else text
    if ending.solved:
        return ""
    if outcome.ending == "not finite":
        try:
            require_finite(program, z, node_times(shot), output_names(shot), "the last iterate")
        except DfsmError as error:
            return str(error).split(": give a guess")[0]
    return conflict(program, z)


def node_times(shot: Shot) -> Array:
    """Time in s of every row of the first block: of nodes, or of the starts of segments."""
    layout = shot.layout
    time = layout.time if isinstance(shot, Transcription) else layout.time[layout.state_nodes[:-1]]
    return np.tile(time, layout.scenarios)


def output_names(shot: Shot) -> tuple[list[str], list[str]]:
    """What the outputs of the two blocks are called."""
    functions = shot.functions
    path, boundary = functions.path_sizes, functions.boundary_sizes
    states = functions.plant.names("states")
    node = ["the cost", *(f"the derivative of '{n}'" for n in states)]
    paths = [f"'{n}'" for n, count in path.items() for _ in range(count)]
    if isinstance(shot, Shooting):
        pieces = shot.method.pieces
        node = ["the cost", *(f"the simulated '{n}'" for n in states * pieces)]
        paths *= pieces + 1
    ends = [f"'{n}'" for n, count in boundary.items() for _ in range(count)]
    return [*node, *paths], ["the final cost", *ends]


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


def _bounds(shot: Shot, time: Array) -> dict[str, Array]:
    """Bounds that held, those of the training range included where it was not to be left."""
    plant, found = shot.problem.plant, {}
    for group in ("states", "controls", "outputs"):
        limits = shot.problem.limits if group == "outputs" else shot.layout.channel_limits
        for name in plant.names(group):
            pair = np.stack(limits(name, time))
            if np.isfinite(pair).any():
                found[name] = pair
    for name, (low, high) in shot.problem.rates.items():
        pair = level(low, name, time, -np.inf), level(high, name, time, np.inf)
        found[f"{RATE}{name}"] = np.stack(pair)
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
    w = node_data(problem, tau, time)["w"].reshape(
        count, len(tau), len(plant.names("disturbances"))
    )
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
    region = problem.plant.region
    if region is None:
        return None
    shares = []
    for run in runs:
        outside = np.asarray(region.outside(_inputs(problem, run)), dtype=float)
        # Each sample stands for half of the steps beside it.
        shares.append(np.trapezoid(outside, run.time) / run.duration)
    return float(np.mean(shares))


def _inputs(problem: OptimalControlProblem, run: Trajectory) -> Array:
    """All that the plant's functions see, ``(time, input)``."""
    groups = ("controls", "disturbances", "states", "parameters")
    return run.select([n for g in groups for n in problem.plant.names(g)]).values

"""From the solver's last point to a `Solution`: names, units, and what the ending is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from dfsm.control.chatter import chattering
from dfsm.control.diagnose import conflict, require_finite, runaway, worst_violation
from dfsm.control.guess import Start
from dfsm.control.levels import level
from dfsm.control.meshes import Record
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.nodes import node_data
from dfsm.control.nlp.program import Program
from dfsm.control.nlp.shot import Shot
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.replay import replay
from dfsm.control.solution import HELD, RATE, Ending, Solution
from dfsm.core.types import Array
from dfsm.data.trajectory import Role, Trajectory
from dfsm.errors import DfsmError
from dfsm.models.departures import departures, told
from dfsm.models.inputs import GROUPS

_ENDINGS = {
    "solved": Ending.SOLVED,
    "acceptable": Ending.ACCEPTABLE,
    "stalled": Ending.STALLED,
    "infeasible": Ending.INFEASIBLE,
    "limit": Ending.LIMIT,
    "time": Ending.TIME,
    "unbounded": Ending.UNBOUNDED,
    "runaway": Ending.FAILED,
    "interrupted": Ending.INTERRUPTED,
    "not finite": Ending.NOT_FINITE,
    "failed": Ending.FAILED,
}

# Endings before the tolerance is met: they count only as far as the measured conditions hold.
_EARLY = (Ending.ACCEPTABLE, Ending.STALLED)
# Endings at which the conditions hold at the nodes: the replay shows what that is worth.
_UNTRUE = (Ending.COARSE, Ending.CHATTERING)


def solution_of(problem: OptimalControlProblem, record: Record, simulate: bool) -> Solution:
    """Put together what the last mesh came to.

    Parameters
    ----------
    problem
        What was solved.
    record
        From `solve_meshes`.
    simulate
        Integrate the model with the optimal controls, if there are any.
    """
    shot, outcome, start = record.shot, record.outcome, record.start
    program, z = shot.program, outcome.z
    chatter = chattering(shot, outcome, start)
    ending = _ending(record, chatter)
    final_cost = float(program.blocks[1].c @ program.outputs(z)[1].ravel())
    objective = program.cost(z)
    trajectories = _trajectories(problem, shot.grid.tau, start)
    outside, leaving = _leaving(problem, trajectories)
    replays = ()
    if simulate and (ending.solved or ending in _UNTRUE):
        count = range(len(problem.scenarios))
        replays = tuple(replay(problem, shot.grid, start, k) for k in count)
    return Solution(
        name=problem.name,
        ending=ending,
        reason=_reason(record, ending, chatter),
        objective=objective,
        final_cost=final_cost,
        integral_cost=objective - final_cost,
        trajectories=trajectories,
        costates=shot.costates(outcome.multipliers / program.row_scale),
        multipliers=_multipliers(program, outcome),
        parameters=_parameters(problem, start),
        grid=shot.grid,
        error=record.error,
        meshes=tuple(record.meshes),
        iterations=record.iterations,
        seconds={"compile": record.compile, "solve": record.solve},
        linear_quadratic=program.linear_quadratic,
        violation=worst_violation(program, z),
        outside=outside,
        departures=leaving,
        replays=replays,
        bounds=_bounds(shot, trajectories[0].time),
        solver_state=outcome.multipliers,
        optimality=outcome.optimality,
        errors=record.estimate.errors,
    )


def _ending(record: Record, chatter: str) -> Ending:
    """What the solver says, as far as the measured optimality conditions bear it out."""
    ending, measured = _ENDINGS[record.outcome.ending], record.outcome.optimality
    if ending in _EARLY and not measured.held(record.tolerance):
        return Ending.INACCURATE
    if ending.solved and chatter and record.refines:
        return Ending.CHATTERING
    return Ending.COARSE if ending.solved and record.coarse else ending


def _reason(record: Record, ending: Ending, chatter: str) -> str:
    shot, outcome = record.shot, record.outcome
    program, z, measured = shot.program, outcome.z, outcome.optimality
    if ending is Ending.CHATTERING:
        return chatter
    if ending is Ending.SOLVED and chatter:
        # On a mesh that is to stay as it is, errors between the nodes are told and no more.
        return f"{chatter}, which the cost cannot tell from its mean: scheme radau follows the arc"
    if ending is Ending.COARSE:
        return _coarse(record)
    if ending is Ending.UNBOUNDED:
        text = runaway(program, z)
        # Where nodes share their slopes, what a control does at one node another one undoes, and a
        # cost that is linear in it has no least value on the mesh.
        names = shot.problem.plant.names("controls")
        if shot.grid.kind == "radau" or not any(text.startswith(f"{n} runs away") for n in names):
            return text
        return f"{text}, which may be so on this mesh only: use scheme radau first"
    if outcome.ending == "runaway":
        return f"{runaway(program, z)}, and the objective does not fall with it"
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
            require_finite(program, z, shot.row_times(), shot.output_names(), "the last iterate")
        except DfsmError as error:
            return str(error).split(": give a guess")[0]
    return conflict(program, z)


def _coarse(record: Record) -> str:
    """Which error is too large, where, and why it was not lowered."""
    kind, error = record.estimate.largest
    local = getattr(record.estimate, kind)
    k = int(np.argmax(local))
    grid, start = record.shot.grid, record.start
    middle = (grid.edges[k] + grid.edges[k + 1]) / 2
    time = record.shot.problem.start + middle * (start.stop - record.shot.problem.start)
    text = f"the error of the {kind} is {error:.2g}, most of it near {time:.4g} s"
    if kind == "constraints" and record.estimate.exceeded:
        text = f"between the nodes {record.estimate.exceeded}"
    return f"{text}; {record.why}" if record.why else text


def _multipliers(program: Program, outcome: Outcome) -> dict[str, Array]:
    """Of bounds, path and boundary constraints by name; the dynamics' are costates."""
    values = {}
    for rows in program.variables:
        values[rows.name] = outcome.bound_multipliers[rows.index] / program.scale[rows.index]
    for rows in program.rows:
        if not rows.name.startswith("dynamics of "):
            more = outcome.multipliers[rows.index] / program.row_scale[rows.index]
            values[rows.name] = np.append(values.get(rows.name, np.empty(0)), more)
    return values


def _bounds(shot: Shot, time: Array) -> dict[str, Array]:
    """Bounds that held, those of the training range included where it was not to be left."""
    plant, bounds = shot.problem.plant, {}
    for group in ("states", "controls", "outputs"):
        limits = shot.problem.limits if group == "outputs" else shot.layout.channel_limits
        for name in plant.names(group):
            pair = np.stack(limits(name, time))
            if np.isfinite(pair).any():
                bounds[name] = pair
    for name, (low, high) in shot.problem.rates.items():
        pair = level(low, name, time, -np.inf), level(high, name, time, np.inf)
        bounds[f"{RATE}{name}"] = np.stack(pair)
    return bounds


def _parameters(problem: OptimalControlProblem, start: Start) -> dict[str, float]:
    """All plant parameters by name, the free ones as they were chosen."""
    chosen = dict(zip(problem.free_parameters, map(float, start.p), strict=True))
    names = problem.plant.names("parameters")
    return {n: chosen.get(n, problem.parameters[n]) for n in names}  # pyright: ignore


def _trajectories(
    problem: OptimalControlProblem, tau: Array, start: Start
) -> tuple[Trajectory, ...]:
    """States, controls, disturbances, parameters and outputs of every scenario at the nodes."""
    plant = problem.plant
    time = problem.start + tau * (start.stop - problem.start)
    p = np.array(list(_parameters(problem, start).values()))
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
    runs = []
    output = jax.vmap(plant.output, (0, 0, 0, None))
    for s in range(count):
        y = np.asarray(output(start.X[s], start.U[s], w[s], p))
        fixed = np.broadcast_to(p, (len(tau), len(p)))
        values = np.concatenate([start.X[s], start.U[s], w[s], fixed, y], axis=1)
        name = problem.name if count == 1 else f"{problem.name}, scenario {s + 1}"
        runs.append(Trajectory(time, values, tuple(channels), name=name))
    return tuple(runs)


def _leaving(
    problem: OptimalControlProblem, runs: Sequence[Trajectory]
) -> tuple[float | None, tuple[str, ...]]:
    """Share of the horizon with any input outside the training range, and where it is so.

    In words per scenario that leaves it; None and nothing without a training range.
    """
    plant, shares, sentences = problem.plant, [], []
    if plant.region is None:
        return None, ()
    channels = [c for group in GROUPS for c in plant.channels[group]]
    for run in runs:
        inputs, weights = inputs_of(problem, run), _weights(run)
        outside = np.asarray(plant.region.outside(inputs))
        shares.append(weights @ outside)
        found = departures(plant.region, channels, run.time, inputs, outside, weights)
        if found:
            sentences.append(f"{run.name}: {told(found)}" if runs[1:] else told(found))
    return float(np.mean(shares)), tuple(sentences)


def _weights(run: Trajectory) -> Array:
    """Share of the horizon that every node stands for: half of the steps beside it."""
    steps = np.diff(run.time)
    return (np.r_[steps, 0] + np.r_[0, steps]) / (2 * run.duration)


def inputs_of(problem: OptimalControlProblem, run: Trajectory) -> Array:
    """All that the plant's functions see, ``(time, input)``."""
    return run.select(problem.plant.order.names).values

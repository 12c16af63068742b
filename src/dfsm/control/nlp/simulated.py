"""What shooting does not show: errors within the pieces of its controls, estimated as elsewhere.

Every piece is simulated again from its node, under the same linear controls, in much shorter steps:

- dynamics: how far the piece's own steps end from there, relative to each state's size;
- cost: by how much their ∫ L dt differs, summed over the pieces, relative to ∫ |L| + |M|;
- constraints: how far limits are exceeded along the short steps, as in `estimate`.

How far the objective is from the optimum is not estimated: controls that are linear between their
nodes miss what curves, which shows in none of these.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.nlp.dense import Dense
from dfsm.control.nlp.estimate import (
    Estimate,
    finite,
    limited_of,
    objective_size,
    state_sizes,
    worst_of,
)
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.nodes import node_data
from dfsm.control.nlp.segment import segment
from dfsm.control.nlp.terms import Functions, Term
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.types import Array

if TYPE_CHECKING:
    from dfsm.control.nlp.shooting import Shooting

# About this many short steps over the horizon, and so many per piece at least and at most: powers
# of two, so that few lengths are compiled.
_DENSE, _FEWEST, _MOST = 2000, 8, 128


def segment_term(functions: Functions, pieces: int, steps: int) -> Term:
    """Term of a segment of some pieces and steps in each, compiled once per problem."""
    key = (pieces, steps)
    if key not in functions.segments:
        functions.segments[key] = Term(partial(segment, functions, *key))
    return functions.segments[key]


def segment_data(problem: OptimalControlProblem, tau: Array, stop: float) -> dict[str, Any]:
    """Times and disturbances at the ends and middles of all steps of segments.

    Parameters
    ----------
    problem
        What is solved.
    tau
        Normalised times, shape ``(segment, end or middle)``.
    stop
        The last time in s.
    """
    count = len(problem.scenarios)
    time = problem.start + tau.ravel() * (stop - problem.start)
    w = node_data(problem, tau.ravel(), time)["w"]
    return {
        "tau": np.tile(tau, (count, 1)),
        "w": w.reshape(count * len(tau), tau.shape[1], w.shape[-1]),
        "scenario": np.repeat(np.arange(count), len(tau)),
    }


def estimate_simulated(shot: Shooting, outcome: Outcome, start: Start) -> Estimate:
    """Estimate what the nodes do not show.

    Parameters
    ----------
    shot
        A problem in segments.
    outcome, start
        Where the solver ended, and the same as values at the nodes.
    """
    steps, parts = shot.method.steps, _parts(shot.grid.intervals)
    with np.errstate(all="ignore"):  # a function may not be defined between the nodes
        own_cost, own_end, _ = _simulated(shot, start, 1, steps)
        # At least twice the steps of the piece itself.
        cost, end, inner = _simulated(shot, start, parts, -(-2 * steps // parts))
        missing = np.abs(finite(end - own_end)) / state_sizes(shot, start)
        dynamics = missing.max(axis=(0, 2), initial=0.0)
        dense = _dense(shot, start, np.concatenate([inner, end[:, :, None]], axis=2))
        whole = objective_size(shot, outcome.z, dense)
        gaps = np.abs(shot.problem.scenario_weights @ finite(cost - own_cost)) / whole
        constraints, exceeded = worst_of(dense, list(limited_of(shot, outcome, dense)))
    return Estimate(dynamics, gaps, constraints, np.nan, exceeded)


def _parts(pieces: int) -> int:
    """Into how many parts every piece is cut."""
    wanted = 2 ** int(np.ceil(np.log2(_DENSE / pieces))) if pieces < _DENSE else 1
    return int(np.clip(wanted, _FEWEST, _MOST))


def _simulated(shot: Shooting, start: Start, parts: int, steps: int) -> tuple[Array, Array, Array]:
    """All pieces, each from its node, in some parts and steps in each.

    Returns
    -------
    tuple of ndarray
        ∫ T L dτ ``(scenario, piece)``, states at the end ``(scenario, piece, state)``, and at the
        beginnings of the parts ``(scenario, piece, part, state)``.
    """
    grid, nx = shot.grid, shot.functions.nx
    count, pieces = shot.layout.scenarios, grid.intervals
    within = np.arange(2 * parts * steps + 1) / (2 * parts * steps)
    tau = grid.edges[:-1, None] + grid.lengths[:, None] * within
    U = _controls(start.U, within[:: 2 * steps])
    shared = [*start.p, *([start.stop] if shot.layout.free_time else [])]
    local = np.concatenate(
        [
            start.X[:, :-1],
            U.reshape(count, pieces, -1),
            np.broadcast_to(shared, (count, pieces, len(shared))),
        ],
        axis=2,
    )
    data = segment_data(shot.problem, tau, start.stop)
    term = segment_term(shot.functions, parts, steps)
    values = term.values(local.reshape(count * pieces, -1), data, shot.common)
    values = values.reshape(count, pieces, -1)
    inner = values[..., 1 + nx : 1 + nx * parts].reshape(count, pieces, parts - 1, nx)
    begin = np.concatenate([start.X[:, :-1, None], inner], axis=2)
    return values[..., 0], values[..., 1 : 1 + nx], begin


def _controls(U: Array, within: Array) -> Array:
    """Controls inside every piece, ``(scenario, piece, point, control)``."""
    part = within[:, None]
    return (1 - part) * U[:, :-1, None] + part * U[:, 1:, None]


def _dense(shot: Shooting, start: Start, X: Array) -> Dense:
    """Everything along simulated states at equal distances in every piece."""
    grid, (count, pieces, points, nx) = shot.grid, X.shape
    within = np.linspace(0, 1, points)
    tau = grid.edges[:-1, None] + grid.lengths[:, None] * within
    U = _controls(start.U, within)
    values = shot.at(
        X.reshape(count, -1, nx), U.reshape(count, pieces * points, -1), start, tau.ravel()
    ).reshape(count, pieces, points, -1)
    time = shot.problem.start + tau * (start.stop - shot.problem.start)
    weights = np.full(points, 1 / (points - 1))
    weights[[0, -1]] /= 2
    return Dense(grid, tau, time, X, values[..., 1 : 1 + nx], U, values, weights)

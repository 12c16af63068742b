"""The node's term anywhere along the horizon: what it is given, and what it gives."""

from __future__ import annotations

from typing import Any

import numpy as np

from dfsm.control.between import disturbances_at
from dfsm.control.guess import Start
from dfsm.control.nlp.terms import Functions, common_of
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.types import Array


def node_data(problem: OptimalControlProblem, tau: Array, time: Array) -> dict[str, Any]:
    """Time and disturbances of every node of every scenario."""
    names = problem.plant.names("disturbances")
    count, kinds = len(problem.scenarios), problem.between[len(problem.plant.names("controls")) :]
    w = np.zeros((count, len(tau), len(names)))
    for s, run in enumerate(problem.scenarios):
        if run is not None:
            w[s] = disturbances_at(run, names, kinds, time, problem.last_time - problem.start)
    return {
        "tau": np.tile(tau, count),
        "scenario": np.repeat(np.arange(count), len(tau)),
        "w": w.reshape(count * len(tau), len(names)),
    }


def local_rows(
    problem: OptimalControlProblem, X: Array, U: Array, start: Start, tau: Array
) -> tuple[Array, dict[str, Any]]:
    """Local vectors and data of the nodes' term, row by row; see `values_along`."""
    time = problem.start + tau * (start.stop - problem.start)
    shared = [*start.p, *([start.stop] if problem.free_time is not None else [])]
    rows = (*X.shape[:2], len(shared))
    local = np.concatenate([X, U, np.broadcast_to(shared, rows)], axis=2)
    return local.reshape(-1, local.shape[2]), node_data(problem, tau, time)


def values_along(
    problem: OptimalControlProblem,
    functions: Functions,
    X: Array,
    U: Array,
    start: Start,
    tau: Array,
) -> Array:
    """Outputs of the nodes' term anywhere: [T L, T ẋ, path constraints].

    Parameters
    ----------
    problem, functions
        What is solved.
    X, U
        States and controls at the same times, shape ``(scenario, time, n)``.
    start
        Holds the free parameters and the last time.
    tau
        Normalised times, shape ``(time,)``.

    Returns
    -------
    ndarray
        Shape ``(scenario, time, output)``.
    """
    local, data = local_rows(problem, X, U, start, tau)
    values = functions.node.values(local, data, common_of(problem))
    return values.reshape(*X.shape[:2], -1)

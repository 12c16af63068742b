"""Controls that jump to and fro from node to node, where the cost cannot tell them from their mean.

On a singular arc the Hamiltonian is linear in a control. A scheme whose nodes share their slopes
(trapezoidal, Hermite–Simpson) then leaves its values at neighbouring nodes undetermined but for
their mean, and the solver may return any (Betts 2010, Sec. 4.14).
"""

from __future__ import annotations

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.shot import Shot
from dfsm.core.types import Array, IntArray

# Reversals in a row that are no course of a control, and the share of its size that they must have.
_ROW, _SHARE = 10, 1e-2
# What smoothing may change of the objective and of the dynamics, over what it varies by.
_UNSEEN = 1e-3


def chattering(shot: Shot, outcome: Outcome, start: Start) -> str:
    """Name a control that chatters, how often and when; "" where none does.

    A control counts where it turns at every node for a while, by more than 1 % of its size, and
    where these turns cost nothing: half their curvature in the Lagrangian is below a thousandth of
    what the objective varies by.
    """
    nodes, program = shot.layout.control_nodes, shot.program
    curvature: Array | None = None
    for i, name in enumerate(shot.problem.plant.names("controls")):
        for s, U in enumerate(start.U):
            u = U[nodes, i]
            at = _turning(u, _SHARE * max(np.ptp(u), 1e-300))
            if not at.size:
                continue
            if curvature is None:
                curvature = _curvature(shot, outcome)
            columns = shot.layout.columns[1][s, nodes, i][at]
            away = (u[at] - (u[at - 1] + u[at + 1]) / 2) / 2
            price = 0.5 * float(curvature[columns] @ (away / program.scale[columns]) ** 2)
            if abs(price) <= _UNSEEN * max(program.variation(outcome.z), 1e-300):
                time = shot.problem.start + shot.layout.tau[nodes] * (
                    start.stop - shot.problem.start
                )
                return (
                    f"{name} turns {len(at)} times in {len(u) - 1} steps, from {time[at[0]]:.4g} s "
                    f"to {time[at[-1]]:.4g} s"
                )
    return ""


def _turning(u: Array, least: float) -> IntArray:
    """Nodes at which a control turns, of all rows of turns that are long enough."""
    steps = np.diff(u)
    turns = (steps[1:] * steps[:-1] < 0) & (
        np.minimum(np.abs(steps[1:]), np.abs(steps[:-1])) > least
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[0], turns.astype(int), [0]])))
    rows = [np.arange(a, b) for a, b in edges.reshape(-1, 2) if b - a >= _ROW]
    return np.concatenate([np.empty(0, dtype=int), *rows]) + 1


def _curvature(shot: Shot, outcome: Outcome) -> Array:
    """Diagonal of the Hessian of the Lagrangian in scaled variables, objective unscaled."""
    program = shot.program
    values = program.hessian(outcome.z, 1 / program.objective_scale, outcome.multipliers)
    rows, starts = program.hessian_pattern
    columns = np.repeat(np.arange(program.n), np.diff(starts))
    diagonal = np.zeros(program.n)
    on = rows == columns
    diagonal[columns[on]] = values[on]
    return diagonal

"""Everything along a mesh's polynomials, evaluated on a dense grid between the nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.mesh.grid import Grid
from dfsm.core.types import Array, IntArray

if TYPE_CHECKING:
    from dfsm.control.nlp.transcription import Transcription

# Scaled distance to a limit up to which a control is at it: at the tolerance the solver's barrier
# keeps one that is hardly held away by about this much.
_AT_LIMIT = 1e-3


@dataclass(frozen=True, eq=False)
class Dense:
    """Everything along the polynomials between the nodes.

    Attributes
    ----------
    grid
        The mesh.
    tau, time
        Normalised times and times in s, shape ``(interval, point)``.
    X, slope, U
        States, their slopes with τ and controls, shape ``(scenario, interval, point, n)``.
    values
        Outputs of the nodes' term, [T L, T ẋ, path constraints].
    weights
        Of a quadrature over the unit interval at the points, shape ``(point,)``.
    """

    grid: Grid
    tau: Array
    time: Array
    X: Array
    slope: Array
    U: Array
    values: Array
    weights: Array

    @property
    def cost(self) -> Array:
        """T L, ``(scenario, interval, point)``."""
        return self.values[..., 0]

    @property
    def slopes(self) -> Array:
        """T f, ``(scenario, interval, point, state)``."""
        return self.values[..., 1 : 1 + self.X.shape[-1]]

    @property
    def path(self) -> Array:
        """Path constraints and bounded outputs, ``(scenario, interval, point, value)``."""
        return self.values[..., 1 + self.X.shape[-1] :]

    def integral(self, values: Array) -> Array:
        """Over every interval in τ, from ``(…, interval, point)``."""
        return (values @ self.weights) * self.grid.lengths


def dense_of(shot: Transcription, z: Array, start: Start) -> Dense:
    """Evaluate a point between its nodes.

    Parameters
    ----------
    shot
        A problem on a mesh.
    z, start
        Scaled variables, and the same as values at the nodes.
    """
    grid, nx, count = shot.grid, shot.functions.nx, shot.layout.scenarios
    nodes = shot.program.outputs(z)[0].reshape(count, len(grid.tau), -1)
    F = nodes[..., 1 : 1 + nx]
    seen = [grid.at_checked(*a) for a in zip(start.X, F, start.U, strict=True)]
    tau = seen[0][0]
    X, dX, U = (np.stack([s[k] for s in seen]) for k in (1, 2, 3))
    values = shot.at(
        X.reshape(count, tau.size, nx), U.reshape(count, tau.size, U.shape[-1]), start, tau.ravel()
    )
    time = shot.problem.start + tau * (start.stop - shot.problem.start)
    shape = (*X.shape[:3], values.shape[-1])
    return Dense(grid, tau, time, X, dX, U, values.reshape(shape), grid.checked[1])


def costates_at(shot: Transcription, multipliers: Array) -> Array:
    """∂J/∂ξ of the solved states at the dense grid, ``(scenario, interval, point, state)``.

    Radau's are the polynomials through the collocation points of an interval; the others' are
    straight lines from middle to middle.

    Parameters
    ----------
    shot
        A problem on a mesh.
    multipliers
        Of its constraints, in physical units.
    """
    grid = shot.grid
    theta, _ = grid.checked
    tau, values = shot.costate_values(multipliers)
    if grid.kind == "radau":
        own = values.reshape(len(values), grid.intervals, -1, values.shape[-1])
        return grid.scheme.control_basis(theta)[:, 1:] @ own
    at = grid.edges[:-1, None] + grid.lengths[:, None] * theta
    if len(tau) == 1:
        return np.broadcast_to(values[:, :, None], (len(values), *at.shape, values.shape[-1]))
    k = np.clip(np.searchsorted(tau, at) - 1, 0, len(tau) - 2)
    part = ((at - tau[k]) / (tau[k + 1] - tau[k]))[..., None]
    return (1 - part) * values[:, k] + part * values[:, k + 1]


def switching(shot: Transcription, z: Array) -> IntArray:
    """Intervals inside which a control meets or leaves its limits."""
    program, grid = shot.program, shot.grid
    free = program.lower < program.upper
    held = free & (np.minimum(z - program.lower, program.upper - z) < _AT_LIMIT)
    own = grid.local if grid.scheme.starts else grid.local[:, 1:]
    nodes = held[shot.layout.columns[1]][:, own]
    return np.flatnonzero((nodes != nodes[:, :, :1]).any(axis=(0, 2, 3)))

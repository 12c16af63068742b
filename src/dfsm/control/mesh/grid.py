"""Meshes of a scheme over the horizon, interpolation on them, and local errors.

A mesh is its edges in normalised time τ, from 0 at the start of the horizon to 1 at its
end; nodes are the scheme's points in every interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from dfsm.control.mesh.schemes import Kind, Scheme, lagrange, scheme_of
from dfsm.core.types import Array, IntArray
from dfsm.errors import DfsmError

# Between the nodes the equations are checked at this many Gauss points per panel, and at about this
# many over the horizon: a coarse mesh must not miss what happens inside its intervals.
_CHECKED, _DENSE = 6, 2000
# An interval is cut into at most this many pieces at once.
_CUTS = 4
# Cut for a little less error than asked, or most intervals would need one more round.
_MARGIN = 0.5
# Up to this many knots inside an interval become edges at once; those within this share of its
# length from an edge wait until it is shorter.
_KNOTS, _BESIDE = 8, 0.02


class Matrix(NamedTuple):
    """A sparse matrix by its elements."""

    row: IntArray
    column: IntArray
    value: Array
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Grid:
    """A scheme on a mesh.

    Attributes
    ----------
    kind, degree
        See `scheme_of`.
    edges
        Ends of the intervals in normalised time, from 0 to 1, shape ``(interval + 1,)``.
    held
        Edges at which held controls change, from 0 to 1; None where controls are polynomials.
    """

    kind: Kind
    degree: int
    edges: Array
    held: Array | None = None

    @property
    def scheme(self) -> Scheme:
        """The scheme on one interval."""
        return scheme_of(self.kind, self.degree)

    @property
    def intervals(self) -> int:
        """Number of intervals."""
        return len(self.edges) - 1

    @property
    def lengths(self) -> Array:
        """Lengths of the intervals in normalised time."""
        return np.diff(self.edges)

    @cached_property
    def local(self) -> IntArray:
        """Nodes of every interval, shape ``(interval, point)``; neighbours share one."""
        step = len(self.scheme.points) - 1
        return step * np.arange(self.intervals)[:, None] + np.arange(step + 1)

    @cached_property
    def tau(self) -> Array:
        """Normalised times of the nodes, shape ``(node,)``."""
        inner = self.edges[:-1, None] + self.lengths[:, None] * self.scheme.points[:-1]
        return np.append(inner.ravel(), self.edges[-1])

    @cached_property
    def weights(self) -> Array:
        """Quadrature weights of the nodes, with a sum of 1."""
        total = np.zeros(len(self.tau))
        np.add.at(total, self.local, self.lengths[:, None] * self.scheme.weights)
        return total

    @cached_property
    def defects(self) -> tuple[Matrix, Matrix]:
        """D and A of all intervals, ``(interval × defect, node)``, A times their lengths."""
        scheme, shape = self.scheme, (self.intervals * len(self.scheme.D), len(self.tau))
        rows = np.arange(shape[0]).reshape(self.intervals, -1, 1)
        columns = np.broadcast_to(self.local[:, None, :], (*rows.shape[:2], self.local.shape[1]))
        rows = np.broadcast_to(rows, columns.shape)

        def spread(M: Array, factor: Array) -> Matrix:
            values = factor[:, None, None] * M
            keep = values != 0
            return Matrix(rows[keep], columns[keep], values[keep], shape)

        return spread(scheme.D, np.ones(self.intervals)), spread(scheme.A, self.lengths)

    @cached_property
    def control_node(self) -> IntArray:
        """Node whose control holds at every node, shape ``(node,)``."""
        nodes = np.arange(len(self.tau))
        if self.held is not None:
            # The last node before it changes. Edges stay what they are when intervals are cut.
            ends = np.searchsorted(self.tau, self.held[1:])
            return ends[np.searchsorted(ends, nodes)]
        if not self.scheme.starts:
            nodes[0] = 1
        return nodes

    @cached_property
    def own(self) -> IntArray:
        """Nodes with equations of their own, at which constraints hold, shape ``(own node,)``."""
        return np.arange(0 if self.scheme.starts else 1, len(self.tau))

    def holding(self) -> Grid:
        """The same mesh, with controls that are held over its intervals."""
        return replace(self, held=self.edges)

    # -- between the nodes ----------------------------------------------------------------------

    def find(self, tau: Array) -> tuple[IntArray, Array]:
        """Interval of every normalised time, and where in it, from 0 to 1."""
        k = np.clip(np.searchsorted(self.edges, tau, side="right") - 1, 0, self.intervals - 1)
        return k, (tau - self.edges[k]) / self.lengths[k]

    def controls(self, U: Array, tau: Array) -> Array:
        """Controls at normalised times by the scheme's polynomials.

        Parameters
        ----------
        U
            At the nodes, shape ``(node, control)``.
        tau
            Shape ``(time,)``.
        """
        k, theta = self.find(tau)
        return np.einsum("tn,tnc->tc", self.scheme.control_basis(theta), U[self.local[k]])

    def states(self, X: Array, tau: Array) -> Array:
        """States at normalised times by the polynomial through the nodes of each interval."""
        k, theta = self.find(tau)
        return np.einsum("tn,tnc->tc", lagrange(self.scheme.points, theta), X[self.local[k]])

    @cached_property
    def checked(self) -> tuple[Array, Array]:
        """Points θ at which equations are checked in each interval, and quadrature weights.

        Gauss points on equal panels, more of them where intervals are few.
        """
        nodes, weights = np.polynomial.legendre.leggauss(_CHECKED)
        panels = max(1, round(_DENSE / (_CHECKED * self.intervals)))
        theta = (np.arange(panels)[:, None] + (nodes + 1) / 2) / panels
        return theta.ravel(), np.tile(weights / 2 / panels, panels)

    def at_checked(self, X: Array, F: Array, U: Array) -> tuple[Array, Array, Array, Array]:
        """States, their slopes with τ, and controls between the nodes.

        Parameters
        ----------
        X, F, U
            States, slopes with τ and controls at the nodes, shape ``(node, n)``.

        Returns
        -------
        tuple of ndarray
            τ ``(interval, point)``; states, slopes and controls ``(interval, point, n)``.
        """
        theta, _ = self.checked
        h = self.lengths[:, None, None]
        P, Q = self.scheme.state_basis(theta)
        dP, dQ = self.scheme.state_basis(theta, slope=True)
        xs, fs = X[self.local], F[self.local]
        states = P @ xs + h * (Q @ fs)
        slopes = (dP @ xs) / h + dQ @ fs
        return (
            self.edges[:-1, None] + self.lengths[:, None] * theta,
            states,
            slopes,
            self.scheme.control_basis(theta) @ U[self.local],
        )

    def refined(self, errors: Array, tolerance: float, knots: Array | None = None) -> Grid:
        """Cut the intervals whose error is above the tolerance.

        Parameters
        ----------
        errors
            Relative error of every interval.
        tolerance
            Of the same.
        knots
            Normalised times, increasing, at which something has a kink: cuts are made there first.
        """
        order = self.scheme.order + 1
        with np.errstate(divide="ignore"):
            wanted = (np.maximum(errors, 1e-300) / (_MARGIN * tolerance)) ** (1 / order)
        pieces = np.where(errors > tolerance, np.clip(np.ceil(wanted), 2, _CUTS), 1).astype(int)
        knots = np.empty(0) if knots is None else knots
        parts = [
            np.append(left, _cuts(left, right, n, knots)) if n > 1 else [left]
            for left, right, n in zip(self.edges[:-1], self.edges[1:], pieces, strict=True)
        ]
        return replace(self, edges=np.append(np.concatenate(parts), self.edges[-1]))

    def finer(self, pieces: int) -> Grid:
        """Cut every interval into equal pieces."""
        inside = np.arange(pieces) / pieces
        edges = (self.edges[:-1, None] + self.lengths[:, None] * inside).ravel()
        return replace(self, edges=np.append(edges, self.edges[-1]))


def _cuts(left: float, right: float, pieces: int, knots: Array) -> Array:
    """Where to cut an interval: at its knots, at those nearest to equal pieces, or equally."""
    equal = left + (right - left) * np.arange(1, pieces) / pieces
    margin = _BESIDE * (right - left)
    first, last = np.searchsorted(knots, (left + margin, right - margin))
    inside = knots[first:last]
    if len(inside) <= _KNOTS:
        return inside if len(inside) else equal
    return np.unique(inside[np.abs(inside - equal[:, None]).argmin(axis=1)])


def grid_of(kind: Kind, degree: int, mesh: int | Sequence[float]) -> Grid:
    """Make a grid of a number of equal intervals, or of edges.

    Parameters
    ----------
    kind, degree
        See `scheme_of`.
    mesh
        Number of intervals, or edges as fractions of the horizon, from 0 to 1.

    Raises
    ------
    DfsmError
        Edges that do not increase from 0 to 1, or fewer than one interval.
    """
    if isinstance(mesh, int | np.integer):
        if mesh < 1:
            raise DfsmError(f"mesh is {mesh}, expected at least 1 interval")
        return Grid(kind, degree, np.linspace(0, 1, int(mesh) + 1))
    edges = np.array(mesh, dtype=np.float64)
    ends = edges.ndim == 1 and len(edges) > 1 and edges[0] == 0 and edges[-1] == 1
    if not ends or not (np.diff(edges) > 0).all():
        raise DfsmError(
            f"mesh is {list(mesh)[:6]}, expected a number of intervals, or edges that increase "
            "from 0 (start of the horizon) to 1 (its end)"
        )
    return Grid(kind, degree, edges)

"""A nonlinear program whose nonlinearity sits in many small blocks, assembled by sparse matrices.

    f = Σ c r        g = G₀ z + Σ G r        r = terms at local vectors z[columns]

Everything that depends on a scheme is in G₀, G and c; everything nonlinear is in the terms. The
Jacobian and the Hessian of the Lagrangian are then sparse matrices times the terms' small dense
derivatives, with a structure that is worked out once. Variables and rows are scaled inside; what
goes in and comes out of `Program.physical` is in the model's units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from dfsm.control.nlp.terms import Term
from dfsm.core.types import Array, IntArray


@dataclass(frozen=True, eq=False)
class Block:
    """A term, where it takes its local vectors from, and where its outputs go.

    Attributes
    ----------
    term
        The function.
    columns
        Variables of every local vector, shape ``(row, local)``.
    data, common
        Arguments of the term.
    G
        From all outputs, flattened row by row, to the constraints, ``(constraint, row × output)``.
    c
        From the same to the objective, shape ``(row × output,)``.
    """

    term: Term
    columns: IntArray
    data: Any
    common: Any
    G: sparse.csr_matrix
    c: Array


@dataclass(frozen=True, eq=False)
class Rows:
    """Constraints or variables that a message can name.

    Attributes
    ----------
    name
        What a user calls them.
    index
        Where they stand, shape ``(count,)``.
    times
        Time of each in s, shape ``(count,)``, NaN where there is none.
    per
        What a value is divided by to be in the unit that the name stands for, shape ``(count,)``;
        None for 1.
    """

    name: str
    index: IntArray
    times: Array
    per: Array | None = None


class Program:
    """A sparse nonlinear program in scaled variables, evaluated by compiled terms.

    Parameters
    ----------
    blocks
        The terms.
    G0
        Linear part of the constraints, ``(constraint, variable)``, in physical units.
    limits
        Lower and upper limits of variables and constraints: four arrays, in physical units.
    scale, row_scale
        Sizes of variables and constraints; the solver sees numbers divided by them.
    rows, variables
        Names for messages.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        G0: sparse.csr_matrix,
        limits: tuple[Array, Array, Array, Array],
        scale: Array,
        row_scale: Array,
        rows: Sequence[Rows],
        variables: Sequence[Rows],
    ) -> None:
        self.blocks, self.rows, self.variables = tuple(blocks), tuple(rows), tuple(variables)
        self.scale, self.row_scale = scale, row_scale
        z_low, z_high, g_low, g_high = limits
        self.lower, self.upper = z_low / scale, z_high / scale
        self.g_lower, self.g_upper = g_low / row_scale, g_high / row_scale
        self.G0 = sparse.csr_matrix(sparse.diags(1 / row_scale) @ G0 @ sparse.diags(scale))
        self.n, self.m = len(scale), len(row_scale)
        self.linear_quadratic = False
        # The solver sees the objective times this.
        self.objective_scale = 1.0
        self._active, self._affine = zip(*map(self._split, self.blocks), strict=True)
        self._slopes_affine: list[Array] = []
        self._jacobian_structure()
        self._hessian_structure()
        self._at: dict[str, tuple[bytes, Any]] = {}

    def physical(self, z: Array) -> Array:
        """Variables in the model's units."""
        return z * self.scale

    def scaled(self, values: Array) -> Array:
        """The solver's variables from values in the model's units, moved within their bounds."""
        return np.clip(values / self.scale, self.lower, self.upper)

    # -- structure ------------------------------------------------------------------------------

    def _split(self, b: Block) -> tuple[IntArray, IntArray]:
        """Elements of a block's local vector that move: those it is not affine in, and others.

        With the others its Jacobian is constant and its Hessian zero; what cannot move needs none.
        """
        moves = (self.lower < self.upper)[b.columns].any(axis=0)
        curved = b.term.curved(self.scale[b.columns], b.data, b.common)
        return np.flatnonzero(moves & curved), np.flatnonzero(moves & ~curved)

    def _jacobian_structure(self) -> None:
        base = self.G0.tocoo()
        rows, columns, parts = [base.row], [base.col], []
        self._gradients = []
        for b, *elements in zip(self.blocks, self._active, self._affine, strict=True):
            at = b.columns[:, np.concatenate(elements)]
            count, local = at.shape
            outputs = len(b.c) // count
            G = b.G.tocoo()
            row = np.repeat(G.row, local)
            column = at[G.col // outputs].ravel()
            source = (G.col[:, None] * local + np.arange(local)).ravel()
            value = np.repeat(G.data / self.row_scale[G.row], local) * self.scale[column]
            rows.append(row)
            columns.append(column)
            parts.append((source, value, count * outputs * local))
            used = np.flatnonzero(b.c)
            to = at[used // outputs].ravel()
            source = (used[:, None] * local + np.arange(local)).ravel()
            value = np.repeat(b.c[used], local) * self.scale[to]
            shape = (self.n, count * outputs * local)
            self._gradients.append(sparse.csr_matrix((value, (to, source)), shape=shape))
        self.jacobian_pattern, places = _pattern(rows, columns, self.m, self.n)
        size = len(self.jacobian_pattern[0])
        self._jacobian_fixed = np.bincount(places[0], base.data, minlength=size)
        self._jacobians = [
            sparse.csr_matrix((value, (place, source)), shape=(size, width))
            for place, (source, value, width) in zip(places[1:], parts, strict=True)
        ]

    def _hessian_structure(self) -> None:
        rows, columns, parts = [], [], []
        for b, active, affine in zip(self.blocks, self._active, self._affine, strict=True):
            at = b.columns[:, np.concatenate([active, affine])]
            (count, local), width = at.shape, len(active)
            i, j = np.triu_indices(local)
            first, second = at[:, i], at[:, j]
            # Zeros have their places, too: on some problems without a solution the solver only
            # finds that there is none with blocks that are full.
            computed = np.broadcast_to(j < width, first.shape)
            source = np.arange(count)[:, None] * width**2 + i * width + j
            # An entry off the diagonal of a block may lie on that of the whole.
            twice = np.where((first == second) & (i != j), 2.0, 1.0)
            value = twice * self.scale[first] * self.scale[second]
            rows.append(np.minimum(first, second).ravel())
            columns.append(np.maximum(first, second).ravel())
            parts.append((computed.ravel(), source[computed], value[computed], count * width**2))
        self.hessian_pattern, places = _pattern(rows, columns, self.n, self.n)
        size = len(self.hessian_pattern[0])
        self._hessians = [
            sparse.csr_matrix((value, (place[computed], source)), shape=(size, width))
            for place, (computed, source, value, width) in zip(places, parts, strict=True)
        ]

    # -- evaluation -----------------------------------------------------------------------------

    def outputs(self, z: Array) -> list[Array]:
        """Outputs of every block ``(row, output)``."""

        def compute() -> list[Array]:
            x = self.physical(z)
            return [b.term.values(x[b.columns], b.data, b.common) for b in self.blocks]

        return self._once("outputs", z, compute)

    def cost(self, z: Array) -> float:
        """Return f in physical units."""
        values = zip(self.blocks, self.outputs(z), strict=True)
        return float(sum(b.c @ r.ravel() for b, r in values))

    def objective(self, z: Array) -> float:
        """Return f, scaled."""
        return self.objective_scale * self.cost(z)

    def constraints(self, z: Array) -> Array:
        """Return g, scaled, shape ``(constraint,)``."""
        values = zip(self.blocks, self.outputs(z), strict=True)
        total = np.zeros(self.m)
        for b, r in values:
            total += b.G @ r.ravel()
        return self.G0 @ z + total / self.row_scale

    def gradient(self, z: Array) -> Array:
        """Return ∂f/∂z, scaled, shape ``(variable,)``; 0 for what cannot move."""
        return self.objective_scale * self._gradient(z)

    def variation(self, z: Array) -> float:
        """How much f in physical units depends on the variables that can move, to first order.

        ½ Σ |zᵢ ∂f/∂zᵢ|: the value of a quadratic cost, whatever constant is added to it.
        """
        moves = self.lower < self.upper
        return 0.5 * float(np.abs(z * self._gradient(z))[moves].sum())

    def _gradient(self, z: Array) -> Array:
        parts = zip(self._gradients, self.slopes(z), strict=True)
        return sum((M @ J.ravel() for M, J in parts), np.zeros(self.n))

    def jacobian(self, z: Array) -> Array:
        """Values of ∂g/∂z in the order of `jacobian_pattern`, for what can move."""
        parts = zip(self._jacobians, self.slopes(z), strict=True)
        return sum((M @ J.ravel() for M, J in parts), self._jacobian_fixed)

    def hessian(self, z: Array, sigma: float, multipliers: Array) -> Array:
        """Upper triangle of ∂²(σ f + λᵀ g)/∂z² in the order of `hessian_pattern`."""
        x, weights = self.physical(z), multipliers / self.row_scale
        sigma = sigma * self.objective_scale
        total = np.zeros(len(self.hessian_pattern[0]))
        for b, active, M in zip(self.blocks, self._active, self._hessians, strict=True):
            if not active.size:
                continue
            local = x[b.columns]
            w = (sigma * b.c + b.G.T @ weights).reshape(len(local), -1)
            total += M @ b.term.hessian(local, b.data, b.common, w, active).ravel()
        return total

    def slopes(self, z: Array) -> list[Array]:
        """Jacobians of every block with all of its elements that move, ``(row, output, moving)``.

        Those in which it is not affine come first.
        """

        def compute() -> list[Array]:
            x = self.physical(z)
            if not self._slopes_affine:
                self._slopes_affine = self._slopes_of(self._affine, x)
            both = zip(self._slopes_of(self._active, x), self._slopes_affine, strict=True)
            return [np.concatenate(parts, axis=2) for parts in both]

        return self._once("slopes", z, compute)

    def _slopes_of(self, elements: Sequence[IntArray], x: Array) -> list[Array]:
        """Jacobians of every block with some elements, ``(row, output, element)``."""
        slopes = []
        for b, of in zip(self.blocks, elements, strict=True):
            rows = len(b.columns)
            slopes.append(
                b.term.jacobian(x[b.columns], b.data, b.common, of)
                if of.size
                else np.zeros((rows, len(b.c) // rows, 0))
            )
        return slopes

    def _once(self, what: str, z: Array, compute: Any) -> Any:
        """Compute at a new point, remember at the last one: the solver asks for f and g apart."""
        key = z.tobytes()
        if what not in self._at or self._at[what][0] != key:
            self._at[what] = (key, compute())
        return self._at[what][1]


def _pattern(
    rows: Sequence[IntArray], columns: Sequence[IntArray], height: int, width: int
) -> tuple[tuple[IntArray, IntArray], list[IntArray]]:
    """Compressed columns of all entries: row indices and column starts, and each entry's place."""
    keys = [c.astype(np.int64) * height + r for r, c in zip(rows, columns, strict=True)]
    unique, inverse = np.unique(np.concatenate(keys), return_inverse=True)
    starts = np.searchsorted(unique, np.arange(width + 1, dtype=np.int64) * height)
    ends = np.cumsum([len(k) for k in keys])[:-1]
    return (unique % max(height, 1), starts), np.split(inverse, ends)

"""Linear systems from records of inputs and outputs, without a start to iterate from.

Past-output MOESP: the row space of future outputs, less what future inputs explain, seen through
past inputs and outputs, is spanned by an extended observability matrix (Verhaegen 1994,
"Identification of the deterministic part of MIMO state space models", Automatica 30(1)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import logm, svd

from dfsm.core.types import Array

# What does not decay in a step, or flips sign, is taken for noise.
_SLOWEST = 0.9995
# Largest size of an eigenvalue of the rate, per step: RK4 diverges from 2.8 on.
_FASTEST = 2.2


@dataclass(frozen=True)
class Observability:
    """What outputs tell of the states.

    Attributes
    ----------
    matrix
        Columns by importance, ``(block row · output, order)``.
    importance
        Singular values, ``(order,)``; those of states that there are stand out.
    outputs
        Number of outputs.
    """

    matrix: Array
    importance: Array
    outputs: int

    def system(self, order: int) -> tuple[Array, Array]:
        """A of one step, of modes that decay, no faster than RK4 can follow, and C."""
        G, p = self.matrix[:, :order], self.outputs
        A = np.linalg.lstsq(G[:-p], G[p:], rcond=None)[0]
        found: Any = np.linalg.eig(A)
        values, vectors = found[0].astype(np.complex128), found[1]
        size = np.abs(values)
        values = np.where(size > _SLOWEST, values / np.maximum(size, _SLOWEST) * _SLOWEST, values)
        real = np.abs(values.imag) < 1e-9
        values = np.where(real & (values.real < np.exp(-_FASTEST)), np.exp(-_FASTEST), values)
        rates = np.log(values)
        values = np.exp(rates * np.minimum(1.0, _FASTEST / np.maximum(np.abs(rates), 1e-12)))
        A = (vectors @ np.diag(values) @ np.linalg.pinv(vectors)).real
        return A, G[:p]


def observability(records: Sequence[tuple[Array, Array]], order: int) -> Observability:
    """Find an extended observability matrix.

    Parameters
    ----------
    records
        Inputs ``(time, input)`` and outputs ``(time, output)`` of runs on one equidistant mesh.
    order
        Largest number of states that is of interest.

    Returns
    -------
    Observability
        Of as many states, or of fewer where the records are too short.
    """
    inputs, outputs = (part.shape[1] for part in records[0])
    depth = max(2 * order + 2, 8)
    longest = max(len(u) for u, _ in records)
    # As many columns as rows at least.
    depth = max(2, min(depth, longest // (4 * (inputs + outputs))))
    stacked = [_stacked(u, y, depth) for u, y in records if len(u) > 2 * depth]
    M = np.concatenate(stacked) if stacked else np.zeros((1, 2 * depth * (inputs + outputs)))
    triangle: Any = np.linalg.qr(M, mode="r")
    R = triangle.T
    future, past = depth * inputs, depth * (inputs + outputs)
    U, s, _ = svd(R[future + past :, future : future + past], full_matrices=False)
    n = min(order, len(s), (depth - 1) * outputs)
    return Observability(U[:, :n] * np.sqrt(s[:n]), s, outputs)


def _stacked(u: Array, y: Array, depth: int) -> Array:
    """Rows of future inputs, past inputs, past outputs and future outputs."""
    columns = len(u) - 2 * depth + 1

    def hankel(values: Array, first: int) -> Array:
        return np.concatenate(
            [values[first + k : first + k + columns] for k in range(depth)], axis=1
        )

    return np.concatenate([hankel(u, depth), hankel(u, 0), hankel(y, 0), hankel(y, depth)], axis=1)


def outputs_first(A: Array, C: Array) -> Array:
    """The same system in states of which the first are the outputs: its A.

    Parameters
    ----------
    A
        ``(state, state)``.
    C
        ``(output, state)``, of full rank, with no more outputs than states.
    """
    rows, reach = list(C), C
    size = np.linalg.norm(C, axis=1).mean()
    while len(rows) < len(A):
        reach = reach @ A
        for row in reach:
            T = np.array(rows)
            rest = row - T.T @ np.linalg.lstsq(T.T, row, rcond=None)[0]
            norm = np.linalg.norm(rest)
            if norm > 1e-8 * np.linalg.norm(row) and len(rows) < len(A):
                rows.append(rest / norm * size)
        if not reach.any() or np.linalg.norm(reach) < 1e-12 * size:
            break
    spare = svd(np.array(rows))[2]
    T = np.array([*rows, *spare[len(rows) :]])
    return T @ A @ np.linalg.inv(T)


def rate_of(A: Array, step: float) -> Array:
    """The A of ẋ = A x whose step is that of x⁺ = A x, eigenvalues off the negative axis."""
    logarithm: Any = logm(A)
    return np.real(logarithm) / step

"""Collocation schemes on one interval, each as a few small matrices.

A scheme has points θ₀ = 0 < … < θₘ = 1 on the unit interval, and with states X and slopes
F = f(X, U) at them its defects are D X − h A F = 0 for an interval of length h. Costs are
integrated with the weights b. Trapezoidal, Hermite–Simpson (separated) and Legendre–Gauss–Radau
collocation differ in nothing else (Betts 2010, Ch. 4; Garg et al. 2011).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import scipy

from dfsm.core.types import Array
from dfsm.errors import DfsmError

Kind = Literal["trapezoidal", "hermite_simpson", "radau"]


@dataclass(frozen=True, eq=False)
class Scheme:
    """A collocation scheme on the unit interval.

    Attributes
    ----------
    points
        θ of the local points, 0 and 1 included, shape ``(point,)``.
    D, A
        Defects D X − h A F, shapes ``(defect, point)``.
    weights
        Quadrature b, shape ``(point,)``.
    order
        Of the states at the interval's ends, for smooth problems.
    starts
        Whether the first point of an interval carries a control of its own. Radau's does not: the
        control there is that of the interval before, or for the first interval an extrapolation.
    from_slopes
        Whether states between the points are integrals of the interpolated slopes; if not, they
        are the polynomial through the states.
    """

    points: Array
    D: Array
    A: Array
    weights: Array
    order: int
    starts: bool
    from_slopes: bool

    def control_basis(self, theta: Array) -> Array:
        """Matrix from controls at the points to controls at θ, shape ``(theta, point)``."""
        own = self.points if self.starts else self.points[1:]
        basis = lagrange(own, theta)
        return basis if self.starts else np.pad(basis, ((0, 0), (1, 0)))

    def state_basis(self, theta: Array, slope: bool = False) -> tuple[Array, Array]:
        """Matrices P and Q with x(θ) = P X + h Q F, each of shape ``(theta, point)``.

        Parameters
        ----------
        theta
            Shape ``(theta,)``.
        slope
            Of h ẋ(θ) instead.
        """
        n = len(self.points)
        if not self.from_slopes:
            P = lagrange(self.points, theta, derivative=slope)
            return P, np.zeros_like(P)
        P = np.zeros((len(theta), n))
        if slope:
            return P, lagrange(self.points, theta)
        P[:, 0] = 1.0
        # Exact: Gauss points integrate the interpolating polynomial from 0 to each θ.
        nodes, weights = np.polynomial.legendre.leggauss(n)
        inner = 0.5 * theta[:, None] * (nodes + 1)
        values = lagrange(self.points, inner.ravel()).reshape(*inner.shape, n)
        return P, 0.5 * theta[:, None] * np.einsum("g,tgn->tn", weights, values)


def lagrange(points: Array, theta: Array, derivative: bool = False) -> Array:
    """Lagrange polynomials through `points` at θ, or their derivatives, ``(theta, point)``."""
    n = len(points)
    basis = np.ones((len(theta), n))
    slope = np.zeros((len(theta), n))
    for j in range(n):
        for k in range(n):
            if k != j:
                gap = points[j] - points[k]
                slope[:, j] = slope[:, j] * (theta - points[k]) / gap + basis[:, j] / gap
                basis[:, j] *= (theta - points[k]) / gap
    return slope if derivative else basis


@lru_cache(maxsize=32)
def scheme_of(kind: Kind, degree: int = 3) -> Scheme:
    """Build a scheme.

    Parameters
    ----------
    kind
        ``"trapezoidal"``, ``"hermite_simpson"`` or ``"radau"``.
    degree
        Of Radau's state polynomial, which is also its number of collocation points.
    """
    if kind == "trapezoidal":
        half = np.array([0.5, 0.5])
        D = np.array([[-1.0, 1.0]])
        return Scheme(np.array([0.0, 1.0]), D, half[None], half, 2, True, True)
    if kind == "hermite_simpson":
        D = np.array([[-0.5, 1.0, -0.5], [-1.0, 0.0, 1.0]])
        A = np.array([[1 / 8, 0.0, -1 / 8], [1 / 6, 4 / 6, 1 / 6]])
        points = np.array([0.0, 0.5, 1.0])
        return Scheme(points, D, A, np.array([1, 4, 1]) / 6, 4, True, True)
    if kind != "radau":
        raise DfsmError(f"scheme is {kind}, expected trapezoidal, hermite_simpson or radau")
    # Right end included (Radau IIA): zeros of (1 − x) P^(1,0)_{n−1}(x), with an exact quadrature.
    zeros = scipy.special.roots_jacobi(degree - 1, 1.0, 0.0)[0] if degree > 1 else np.empty(0)
    inner = (zeros + 1) / 2
    collocated = np.append(inner, 1.0)
    points = np.append(0.0, collocated)
    D = lagrange(points, collocated, derivative=True)
    A = np.eye(degree, degree + 1, k=1)
    nodes, gauss = np.polynomial.legendre.leggauss(degree)
    weights = 0.5 * gauss @ lagrange(collocated, (nodes + 1) / 2)
    return Scheme(points, D, A, np.append(0.0, weights), 2 * degree - 1, False, False)

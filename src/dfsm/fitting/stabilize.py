"""Linear fits whose eigenvalues stay left of a margin, with an account of what that cost.

Least squares on derivatives underestimates damping wherever a force is missing from the inputs: for
a stationary signal E[ẍ ẋ] = 0, so what no input explains must not look damped. A slightly unstable
fit of a well-damped system is the usual result, and its rollouts drift off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.errors import DfsmError
from dfsm.fitting.linear import LinearFit
from dfsm.models.stability import eigen, growth_between

_STEPS = 200
_ROUNDS = 20
# How far beyond the margin eigenvalues are aimed at first, relative to it, and by how much further
# in every step: where eigenvalues meet, a step throws some of them back, the less the further left
# they are. Those within so many aims of the margin are held left of it.
_AIM, _FURTHER, _NEAR = 1e-3, 1.03, 100
# A row is never taken to be better known than this, relative to its standard deviation squared.
_LEAST_VARIANCE = 1e-12


def state_matrix(
    coefficients: Array, columns: slice, known: Mapping[int, int], slopes: Array | None = None
) -> Array:
    """A from the coefficients of the fitted rows and the kinematic rows.

    Parameters
    ----------
    coefficients
        Fitted rows of L, shape ``(fitted, input)``.
    columns
        Input columns that are states.
    known
        Kinematic rows, see `kinematic_rows`.
    slopes
        Of the terms, the last of the inputs, in the states, ``(term, state)``; None without.
    """
    n = columns.stop - columns.start
    slopes = np.zeros((0, n)) if slopes is None else slopes
    A = np.zeros((n, n))
    for row, rate in known.items():
        A[row, rate] = 1.0
    terms = coefficients[:, coefficients.shape[1] - len(slopes) :]
    A[[i for i in range(n) if i not in known]] = coefficients[:, columns] + terms @ slopes
    return A


def stabilise(
    fit: LinearFit,
    columns: slice,
    known: Mapping[int, int],
    margin: float,
    affine: bool,
    slopes: Array | None = None,
) -> tuple[LinearFit, list[float]]:
    """Move eigenvalues right of ``-margin`` onto it, and refit everything else.

    Stable is meant with the schedule frozen, at every value of it. Where the schedule moves as fast
    as the states do, that neither implies that states come together along its path nor is it
    implied by that; `fit` looks at recorded paths, too.

    The fitted rows of A change in the way that costs the least fit quality; kinematic rows stay.
    Coefficients of all inputs that are not states are then fitted again with A held. Where two
    stable points leave an unstable mixture between them, both are moved further.

    Parameters
    ----------
    fit
        Fit of the rows that are not kinematic.
    columns
        Input columns that are states.
    known
        Kinematic rows.
    margin
        Largest real part allowed is ``-margin``, in 1/s.
    affine
        Whether the fit has an offset.
    slopes
        Of known terms, the last of the inputs, in the states, ``(point, term, state)``; their
        coefficients stay.

    Returns
    -------
    tuple
        The stable fit, and the schedule points at which eigenvalues were moved.

    Raises
    ------
    DfsmError
        A margin that is not positive, a mode that cannot be moved, or a state that does not vary,
        so that nothing tells what a change of its coefficients costs.
    """
    if not margin > 0:
        raise DfsmError(f"linear.margin is {margin:g}, expected a positive number of 1/s, or null")
    margins = np.full(len(fit.equations), margin)
    if slopes is None:
        slopes = np.zeros((len(fit.equations), 0, columns.stop - columns.start))
    for _ in range(_ROUNDS):
        stable, moved = _stable_points(fit, columns, known, margins, affine, slopes)
        L = np.asarray(stable.model.coefficients)
        A = [state_matrix(L_k, columns, known, s) for L_k, s in zip(L, slopes, strict=True)]
        excess = np.array([growth_between(a, b) + margin for a, b in pairwise(A)])
        if (excess <= 0).all():
            return stable, moved
        for k in np.flatnonzero(excess > 0):
            margins[k : k + 2] += 1.5 * excess[k]
    raise DfsmError(
        "no linear fit is stable between the schedule points too: use fewer linear.points, "
        "or a smaller linear.margin"
    )


def _stable_points(
    fit: LinearFit,
    columns: slice,
    known: Mapping[int, int],
    margins: Array,
    affine: bool,
    slopes: Array,
) -> tuple[LinearFit, list[float]]:
    """Every schedule point left of a margin of its own, and the points that had to be moved."""
    n = columns.stop - columns.start
    rows = [i for i in range(n) if i not in known]
    states = range(columns.start, columns.stop)
    inputs = fit.model.coefficients.shape[2]
    terms = range(inputs - slopes.shape[1], inputs)
    held = [*states, *dict.fromkeys([*(c for c in fit.constant if c not in states), *terms])]
    free = np.ones((len(rows), n), dtype=bool)
    for row, column in fit.model.known:
        if column in states:
            free[row, column - columns.start] = False
    coefficients = np.array(fit.model.coefficients)
    offsets = np.array(fit.model.offsets)
    variance = np.zeros((len(offsets), offsets.shape[1]))
    moved = []
    for k, (equations, margin) in enumerate(zip(fit.equations, margins, strict=True)):
        A = state_matrix(coefficients[k], columns, known, slopes[k])
        fixed = coefficients[k][:, held]
        variance[k] = equations.complete(held, fixed, affine)[2]
        if np.linalg.eigvals(A).real.max() <= -margin:
            continue
        if equations.still[columns].any():
            raise DfsmError(
                "linear.margin needs runs in which all states vary, but one never does, so that "
                "nothing tells what a change of its coefficients costs: leave out that state or "
                "the margin, or add runs"
            )
        moved.append(float(fit.model.grid[k]))
        metric = equations.partial_covariance(columns, affine)
        least = _LEAST_VARIANCE * equations.std[equations.n_inputs :] ** 2
        known_to = np.maximum(variance[k], np.maximum(least, np.finfo(float).tiny))
        fixed[:, :n] += _change(A, rows, metric, known_to, margin, free)
        coefficients[k], offsets[k], variance[k] = equations.complete(held, fixed, affine)
    share = fit.samples / fit.samples.sum()
    model = replace(fit.model, coefficients=from_host(coefficients), offsets=from_host(offsets))
    return replace(fit, model=model, residual_rms=np.sqrt(share @ variance)), moved


def _change(
    A: Array, rows: list[int], metric: Array, variance: Array, margin: float, free: Array
) -> Array:
    """Cheapest change of the fitted rows of A that moves all eigenvalues left of ``-margin``.

    The cost of a change D is what it adds to the residuals, each relative to its variance:
    ``Σ_r D_r S D_rᵀ / σ_r²``, S being the covariance of the states
    that the other inputs do not explain.
    Entries that are not `free`, by fitted row and state, stay.
    Each step solves for the cheapest D that moves the eigenvalues there to first order,
    dλ = wᴴ dA v with the left and right eigenvectors w and v.
    """
    total = np.zeros((len(rows), len(A)))
    inverses = np.stack([_inverse(metric, own) for own in free])
    aim = _AIM * margin
    for _ in range(_STEPS):
        current = A.copy()
        current[rows] += total
        eigenvalues, left, right = eigen(current)
        if (eigenvalues.real <= -margin).all():
            return total
        # One of each conjugate pair.
        active = (eigenvalues.real > -margin - _NEAR * aim) & (eigenvalues.imag >= 0)
        wanted = -(eigenvalues.real[active] + margin + aim)
        M = [
            np.real(w[rows].conj()[:, None] * v)
            for w, v in zip(left[active], right[active], strict=True)
        ]
        cheap = [np.einsum("r,ri,rij->rj", variance, m, inverses) for m in M]
        gram = np.array([[np.sum(a * b) for b in cheap] for a in M])
        weights = np.linalg.lstsq(gram, wanted, rcond=None)[0]
        step = sum(w * c for w, c in zip(weights, cheap, strict=True))
        # Eigenvalues are nonlinear in A: no step may be a large part of the matrix.
        size, most = np.linalg.norm(step), 0.2 * (np.linalg.norm(A[rows]) + margin)
        total = total + (step if size <= most else step * most / size)
        aim *= _FURTHER
    raise DfsmError(
        "no stable linear fit was found near the least-squares one: make linear.margin smaller, "
        "leave it out, or look at the eigenvalues and choose other states or linear.known"
    )


def _inverse(metric: Array, free: NDArray[np.bool_]) -> Array:
    """Inverse of the block of some states, zero elsewhere."""
    inverse = np.zeros_like(metric)
    block = metric[np.ix_(free, free)]
    scale = np.sqrt(np.diag(block))
    size = np.outer(scale, scale)
    inverse[np.ix_(free, free)] = np.linalg.inv(block / size) / size
    return inverse

"""Least squares from sums: one pass over the samples, memory independent of their number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array

# Rows per block of the accumulation: a block of tens of columns stays in the cache.
BLOCK = 8192
# Standard deviation relative to the mean at and below which an input does not vary.
_STILL = 1e-12


class NormalEquations:
    """Sums that a least-squares fit of targets on inputs needs, collected block by block.

    Sums are taken about a fixed shift close to the mean, because the difference of two large
    uncentred sums would lose the digits that the fit lives on.

    Parameters
    ----------
    shift
        Reference point for ``[inputs, targets]``, shape ``(input + target,)``; use the mean of
        any block of data, or zeros for a fit without offset.
    n_inputs
        How many of the columns are inputs.
    """

    def __init__(self, shift: Array, n_inputs: int) -> None:
        self.shift = np.asarray(shift, dtype=np.float64)
        self.n_inputs = n_inputs
        self.count = 0
        self.weight = 0.0
        self.independent = 0.0
        self.sums = np.zeros(len(self.shift))
        self.products = np.zeros((len(self.shift), len(self.shift)))

    def add(
        self,
        inputs: Array,
        targets: Array,
        correlation: float = 1.0,
        weights: Array | None = None,
    ) -> None:
        """Add samples.

        Parameters
        ----------
        inputs, targets
            Shapes ``(sample, input)`` and ``(sample, target)``.
        correlation
            How many samples count as one, see `correlation_length`.
        weights
            What each sample counts, ``(sample,)``, 1 on average over all; None for 1.
        """
        # Channels as rows: contiguous, so that the product runs at the speed of the memory.
        block = np.empty((len(self.shift), BLOCK))
        m = self.n_inputs
        for start in range(0, len(inputs), BLOCK):
            stop = min(start + BLOCK, len(inputs))
            z = block[:, : stop - start]
            np.subtract(inputs[start:stop].T, self.shift[:m, None], out=z[:m])
            np.subtract(targets[start:stop].T, self.shift[m:, None], out=z[m:])
            if weights is None:
                self.products += z @ z.T
                self.sums += z.sum(axis=1)
            else:
                weighted = z * weights[start:stop]
                self.products += weighted @ z.T
                self.sums += weighted.sum(axis=1)
        weight = len(inputs) if weights is None else float(weights.sum())
        self.count += len(inputs)
        self.weight += weight
        self.independent += weight / correlation

    def moments(self, centred: bool) -> tuple[Array, Array]:
        """Return the mean, and the mean products about it (about zero if not `centred`)."""
        offset = self.sums / self.weight
        if centred:
            return self.shift + offset, self.products / self.weight - np.outer(offset, offset)
        if self.shift.any():
            raise ValueError("uncentred moments need sums about zero")
        return np.zeros_like(self.shift), self.products / self.weight

    @property
    def std(self) -> Array:
        """Standard deviation of every input and target."""
        offset = self.sums / self.weight
        return np.sqrt(np.maximum(np.diag(self.products) / self.weight - offset**2, 0.0))

    @property
    def still(self) -> NDArray[np.bool_]:
        """Which inputs do not vary, but for rounding."""
        m = self.n_inputs
        mean = np.abs(self.moments(centred=True)[0][:m])
        return self.std[:m] <= _STILL * np.maximum(mean, np.finfo(float).tiny)

    def solve(
        self, affine: bool, prior: Solution | None = None, held: Sequence[int] = ()
    ) -> Solution:
        """Solve for the coefficients.

        Parameters
        ----------
        affine
            Fit an offset.
        prior
            A fit over more data, whose coefficients hold in directions that these samples hardly
            excite (a torque at its limit, say). None takes the solution of minimum norm in the
            standardised inputs.
        held
            Inputs whose coefficients are those of the prior.
        """
        mean, products = self.moments(centred=affine)
        if prior is not None:
            return self._lean_on(prior, self.solve(affine), mean, products, held)
        m = self.n_inputs
        scale = np.sqrt(np.maximum(np.diag(products)[:m], 0.0))
        # A column that does not vary gets no coefficient; any scale but zero will do.
        still = scale <= _STILL * np.maximum(np.abs(mean[:m]), np.finfo(float).tiny)
        scale[still] = np.inf
        Q = products[:m, :m] / np.outer(scale, scale)
        # It is confounded with nothing, so it has no part in the condition number.
        Q[still, still] = 1.0
        eigenvalues, V = np.linalg.eigh(Q)
        floor = eigenvalues[-1] * max(1e-13, 10 * m * np.finfo(float).eps)
        used = eigenvalues > floor
        inverse = np.where(used, 1 / np.where(used, eigenvalues, 1.0), 0.0)
        right = products[:m, m:] / scale[:, None]
        X = V @ (inverse[:, None] * (V.T @ right))
        L = (X / scale[:, None]).T
        rss = np.diag(products)[m:] - np.einsum("ij,ij->j", 2 * right - Q @ X, X)
        return Solution(
            coefficients=L,
            offset=mean[m:] - L @ mean[:m],
            residual_variance=np.maximum(rss, 0.0),
            target_variance=np.maximum(np.diag(products)[m:], 0.0),
            input_variance=np.where(still, 0.0, np.maximum(np.diag(products)[:m], 0.0)),
            eigenvalues=np.maximum(eigenvalues, 0.0),
            directions=V,
        )

    def _lean_on(
        self, prior: Solution, own: Solution, mean: Array, products: Array, held: Sequence[int]
    ) -> Solution:
        """Ridge towards `prior`, weighted by its input variances.

        The weight is the share of the target that these samples' `own` fit leaves over, so that
        data without noise are not biased, over the number of independent samples: as many as the
        time that they cover holds of the time that a residual remembers, at any sampling rate.
        """
        m = self.n_inputs
        Q, right = products[:m, :m], products[:m, m:]
        target_variance = np.maximum(np.diag(products)[m:], np.finfo(float).tiny)
        share = np.minimum(own.residual_variance / target_variance, 1.0)
        weight = share / max(self.independent, 1.0)
        fixed = np.array(held, dtype=int)
        free = np.delete(np.arange(m), fixed)
        pull = np.diag(prior.input_variance[free])
        L = prior.coefficients.copy()
        for t, w in enumerate(np.maximum(weight, 1e-12)):
            rest = right[free, t] - Q[np.ix_(free, fixed)] @ L[t, fixed]
            A, b = Q[np.ix_(free, free)] + w * pull, rest + w * pull @ prior.coefficients[t, free]
            L[t, free] = np.linalg.lstsq(A, b, rcond=None)[0]
        rss = np.diag(products)[m:] - np.einsum("ij,ji->j", 2 * right - Q @ L.T, L)
        return replace(
            prior,
            coefficients=L,
            offset=mean[m:] - L @ mean[:m],
            residual_variance=np.maximum(rss, 0.0),
            target_variance=target_variance,
        )

    def partial_covariance(self, columns: slice, affine: bool) -> Array:
        """Covariance of some inputs that the other inputs do not explain."""
        _, products = self.moments(centred=affine)
        m = self.n_inputs
        free = np.ones(m, dtype=bool)
        free[columns] = False
        Q = products[:m, :m]
        scale = np.sqrt(np.maximum(np.diag(Q), np.finfo(float).tiny))
        R = Q / np.outer(scale, scale)
        others = np.linalg.lstsq(R[np.ix_(free, free)], R[free, columns], rcond=1e-9)[0]
        partial = R[columns, columns] - R[columns, free] @ others
        # A state that the others explain altogether may change freely, but not without bound.
        partial = partial + 1e-9 * np.eye(len(partial))
        return partial * np.outer(scale[columns], scale[columns])

    def holding(
        self, solution: Solution, columns: Sequence[int], fixed: Array, affine: bool
    ) -> Solution:
        """A solution with some inputs' coefficients fixed and the best others; see `complete`."""
        L, offset, rss = self.complete(columns, fixed, affine)
        return replace(solution, coefficients=L, offset=offset, residual_variance=rss)

    def complete(
        self, columns: Sequence[int], fixed: Array, affine: bool
    ) -> tuple[Array, Array, Array]:
        """Best remaining coefficients where those of some inputs are fixed.

        Parameters
        ----------
        columns
            The inputs whose coefficients are fixed.
        fixed
            Those coefficients, shape ``(target, len(columns))``.
        affine
            Fit an offset.

        Returns
        -------
        tuple of ndarray
            All coefficients ``(target, input)``, offsets and residual variances ``(target,)``.
        """
        mean, products = self.moments(centred=affine)
        m = self.n_inputs
        Q, right = products[:m, :m], products[:m, m:]
        free = np.ones(m, dtype=bool)
        free[list(columns)] = False
        scale = np.sqrt(np.maximum(np.diag(Q)[free], np.finfo(float).tiny))
        rest = (right - Q[:, list(columns)] @ fixed.T)[free] / scale[:, None]
        L = np.empty((len(fixed), m))
        L[:, list(columns)] = fixed
        solved = np.linalg.lstsq(Q[np.ix_(free, free)] / np.outer(scale, scale), rest, rcond=1e-9)[
            0
        ]
        L[:, free] = (solved / scale[:, None]).T
        rss = np.diag(products)[m:] - np.einsum("ij,ji->j", 2 * right - Q @ L.T, L)
        return L, mean[m:] - L @ mean[:m], np.maximum(rss, 0.0)


@dataclass(frozen=True)
class Solution:
    """Coefficients of one least-squares fit with the figures that judge it."""

    coefficients: Array
    offset: Array
    residual_variance: Array
    target_variance: Array
    input_variance: Array
    eigenvalues: Array
    directions: Array

    @property
    def condition(self) -> float:
        """Condition number of the standardised inputs."""
        low = self.eigenvalues[0]
        return float(np.sqrt(self.eigenvalues[-1] / low)) if low > 0 else float("inf")

    def confounded(self, names: list[str]) -> list[str]:
        """Name the inputs that dominate the direction in which the data hardly vary."""
        weight = np.abs(self.directions[:, 0])
        return [names[i] for i in np.argsort(-weight) if weight[i] > 0.3 * weight.max()]


def correlation_length(residuals: Array) -> Array:
    """Samples of a time series per independent one: its autocorrelation, summed up.

    ``τ = 1 + 2 Σ ρ_k`` until ρ first falls to zero, beyond which an estimate is mostly noise (the
    variance of a mean is τ times that of as many independent samples; Priestley 1981, Sec. 5.3).
    Times the sampling step it is a time, which does not depend on the sampling rate.

    Parameters
    ----------
    residuals
        Equidistant samples, shape ``(sample, target)``.

    Returns
    -------
    ndarray
        Shape ``(target,)``: 1 for white noise, at most the number of samples.
    """
    n = len(residuals)
    centred = residuals - residuals.mean(axis=0)
    # Twice the length, so that the end does not meet the beginning.
    power = np.abs(np.fft.rfft(centred, 2 * n, axis=0)) ** 2
    covariance = np.fft.irfft(power, 2 * n, axis=0)[:n]
    rho = covariance / np.maximum(covariance[0], np.finfo(float).tiny)
    positive = np.logical_and.accumulate(rho > 0, axis=0)
    return np.clip(2 * np.sum(rho * positive, axis=0) - 1, 1.0, n)


def merge(parts: Sequence[NormalEquations]) -> NormalEquations:
    """Add up sums that were taken about the same shift."""
    total = NormalEquations(parts[0].shift, parts[0].n_inputs)
    for part in parts:
        total.count += part.count
        total.weight += part.weight
        total.independent += part.independent
        total.sums += part.sums
        total.products += part.products
    return total


def shared_coefficients(
    parts: Sequence[NormalEquations],
    columns: Sequence[int],
    affine: bool,
    known: Mapping[tuple[int, int], float] | None = None,
) -> Array:
    """Least-squares coefficients of some inputs that all parts share; the others are free in each.

    Parameters
    ----------
    parts
        Sums over the samples of each part.
    columns
        The inputs in question.
    affine
        Every part has an offset of its own.
    known
        Some of them, which are not fitted, by target and place in `columns`.

    Returns
    -------
    ndarray
        Shape ``(target, len(columns))``.
    """
    m = parts[0].n_inputs
    some = np.array(columns, dtype=int)
    rest = np.delete(np.arange(m), some)
    left = np.zeros((len(some), len(some)))
    right = np.zeros((len(some), len(parts[0].shift) - m))
    for part in parts:
        _, products = part.moments(centred=affine)
        scale = np.sqrt(np.maximum(np.diag(products)[rest], np.finfo(float).tiny))
        inner = products[np.ix_(rest, rest)] / np.outer(scale, scale)
        # What the free inputs explain is taken out of both sides (Frisch, Waugh and Lovell).
        out = np.linalg.lstsq(inner, products[rest][:, some] / scale[:, None], rcond=1e-9)[0]
        out = out / scale[:, None]
        left += part.weight * (products[np.ix_(some, some)] - out.T @ products[rest][:, some])
        right += part.weight * (products[some, m:] - out.T @ products[rest, m:])
    shared = np.linalg.lstsq(left, right, rcond=None)[0].T
    for target in {t for t, _ in known or {}}:
        held = {k: value for (t, k), value in (known or {}).items() if t == target}
        fixed, open_ = list(held), [k for k in range(len(some)) if k not in held]
        values = np.array(list(held.values()))
        rest = right[open_, target] - left[np.ix_(open_, fixed)] @ values
        shared[target, fixed] = values
        shared[target, open_] = np.linalg.lstsq(left[np.ix_(open_, open_)], rest, rcond=None)[0]
    return shared

"""How well the coefficients of a linear fit are known.

With samples ``x`` of the inputs about their mean and what the fit leaves over, ``r``,

    L̂ - L = Σ_t r(t) g(t),      g = (Σ x xᵀ)⁻¹ x ,

so the variance of a coefficient is that of a sum of the products r g, which remember each other: a
sum over n of them varies like that of n/τ independent ones, times τ² (τ as in
`correlation_length`; Newey and West 1987 sum the same correlations with weights). Over few
independent samples a fit also bends to what it should leave over, which the degrees of freedom
make good for; where none is left, nothing is known.
"""

from __future__ import annotations

import numpy as np

from dfsm.core.types import Array, IntArray
from dfsm.numerics.least_squares import correlation_length

_PER_MEMORY = 10
# A derivative out of a spline draws on about so many samples.
_STENCIL = 4.0


def standard_errors(inputs: Array, left: Array, runs: IntArray) -> Array:
    """Standard errors of the coefficients of one row.

    Parameters
    ----------
    inputs
        ``(sample, input)``.
    left
        What the fit of all samples leaves over, ``(sample,)``.
    runs
        Run of every sample; each is one time series, taken as equidistant.

    Returns
    -------
    ndarray
        ``(input,)`` in the unit of the row per unit of the input; infinite where there are fewer
        independent samples than coefficients, and for inputs that do not vary.
    """
    x = inputs - inputs.mean(axis=0)
    scale = x.std(axis=0)
    varies = scale > 1e-12 * np.maximum(np.abs(inputs).max(axis=0), np.finfo(float).tiny)
    errors = np.full(x.shape[1], np.inf)
    if not varies.any():
        return errors
    x = x if varies.all() else x[:, varies]
    x /= scale[varies]
    inverse = np.linalg.pinv(x.T @ x, rcond=1e-13, hermitian=True)
    ends = np.flatnonzero(np.diff(runs, append=-1)) + 1
    variance, independent = np.zeros(x.shape[1]), 0.0
    for start, stop in zip([0, *ends[:-1]], ends, strict=True):
        remembers = float(correlation_length(left[start:stop, None])[0])
        independent += (stop - start) / max(remembers, _STENCIL)
        # Sums over much less than the residual remembers do not change how sums vary.
        places = np.arange(0, stop - start, max(1, int(remembers / _PER_MEMORY)))
        g = x[start:stop] @ inverse
        products = np.add.reduceat(g * left[start:stop, None], places, axis=0)
        variance += correlation_length(products) * np.sum(products**2, axis=0)
    free = independent - x.shape[1] - 1
    if free > 0:
        errors[varies] = np.sqrt(variance * independent / free) / scale[varies]
    return errors

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

from collections.abc import Sequence

import numpy as np

from dfsm.core.types import Array
from dfsm.numerics.least_squares import correlation_length
from dfsm.numerics.time_mesh import std_over

_PER_MEMORY = 10
# A derivative out of a spline draws on about so many samples.
_STENCIL = 4.0


def standard_errors(inputs: Array, left: Array, parts: Sequence[slice]) -> Array:
    """Standard errors of the coefficients of one row.

    Parameters
    ----------
    inputs
        ``(sample, input)``.
    left
        What the fit of all samples leaves over, ``(sample,)``.
    parts
        The samples of every run, a time series each, taken as equidistant.

    Returns
    -------
    ndarray
        ``(input,)`` in the unit of the row per unit of the input; infinite where there are fewer
        independent samples than coefficients, and for inputs that do not vary.
    """
    mean, scale = inputs.mean(axis=0), std_over(inputs, None)
    largest = np.maximum(inputs.max(axis=0), -inputs.min(axis=0))
    varies = scale > 1e-12 * np.maximum(largest, np.finfo(float).tiny)
    errors, count = np.full(inputs.shape[1], np.inf), int(varies.sum())
    if not count:
        return errors

    def standardised(rows: slice) -> Array:
        return (inputs[rows] - mean)[:, varies] / scale[varies]

    products = np.zeros((count, count))
    for rows in parts:
        x = standardised(rows)
        products += x.T @ x
    inverse = np.linalg.pinv(products, rcond=1e-13, hermitian=True)
    variance, independent = np.zeros(count), 0.0
    for rows in parts:
        here, g = left[rows, None], standardised(rows) @ inverse
        remembers = float(correlation_length(here)[0])
        independent += len(here) / max(remembers, _STENCIL)
        # Sums over much less than the residual remembers do not change how sums vary.
        places = np.arange(0, len(here), max(1, int(remembers / _PER_MEMORY)))
        sums = np.add.reduceat(g * here, places, axis=0)
        variance += correlation_length(sums) * np.sum(sums**2, axis=0)
    free = independent - count - 1
    if free > 0:
        errors[varies] = np.sqrt(variance * independent / free) / scale[varies]
    return errors

"""Noise in an input weakens its effect: by how much, where the samples tell.

A fit of ``y = b v`` on recorded ``v + n`` finds ``b S / (S + N)``, S and N being the variances that
the other inputs do not explain (Fuller 1987, Measurement Error Models, Sec. 1.1). White noise shows
between neighbouring samples of a signal that is otherwise smooth. An input may truly be white,
though; then its effect is white, too. So what changes from sample to sample in an input is noise
only where the derivative does not follow it as the fit says.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array, IntArray

# Share of an input's own variance from which noise is told, and share of the fitted effect below
# which its fast part has none.
_SHARE, _NO_EFFECT = 0.05, 0.3
# Normal distribution: its upper quartile; and squares of the binomial coefficients 1, 3, 3, 1.
_QUARTILE, _BINOMIAL = 0.6745, 20.0
_FEWEST = 100


def noise_shares(inputs: Array, target: Array, runs: IntArray, row: Array) -> Array:
    """Share of each input's own variance that is noise without an effect.

    Parameters
    ----------
    inputs, target
        Equidistant samples ``(sample, input)`` and the derivative ``(sample,)``.
    runs
        Run of every sample.
    row
        Fitted coefficients, ``(input,)``.

    Returns
    -------
    ndarray
        ``(input,)``: the share by which the fit weakens the input's effect; 0 where the samples
        show no noise.
    """
    shares = np.zeros(inputs.shape[1])
    if len(inputs) < _FEWEST:
        return shares
    own = _partial_variance(inputs)
    within = np.diff(runs) == 0
    noise = np.array([_white(column, within) for column in inputs.T])
    share = noise / np.maximum(own, np.finfo(float).tiny)
    if not ((share > _SHARE) & (share < 1)).any():
        return shares
    fast = np.diff(np.column_stack([inputs, target]), n=2, axis=0)[within[1:] & within[:-1]]
    fast = fast - fast.mean(axis=0)
    spread = np.maximum(fast.std(axis=0)[:-1], np.finfo(float).tiny)
    effect = np.linalg.lstsq(fast[:, :-1] / spread, fast[:, -1], rcond=1e-10)[0] / spread
    silent = np.abs(effect) < _NO_EFFECT * np.abs(row)
    told = (share > _SHARE) & (share < 1) & silent
    shares[told] = share[told]
    return shares


def _white(values: Array, within: NDArray[np.bool_]) -> float:
    """Variance of what is white in samples ``(sample,)`` of runs, by their differences."""
    third = np.diff(values, n=3)[within[2:] & within[1:-1] & within[:-2]]
    noise = (np.median(np.abs(third)) / _QUARTILE) ** 2 / _BINOMIAL
    # What is white must also be white over two steps; jumps and slow changes are not.
    wide = (values[2:] - values[:-2])[within[1:] & within[:-1]]
    return float(min(noise, (np.median(np.abs(wide)) / _QUARTILE) ** 2 / 2))


def _partial_variance(inputs: Array) -> Array:
    """Variance of each input that the others do not explain."""
    z = inputs - inputs.mean(axis=0)
    scale = np.maximum(z.std(axis=0), np.finfo(float).tiny)
    z /= scale
    correlations = z.T @ z / len(z)
    inverse = np.linalg.pinv(correlations, rcond=1e-12, hermitian=True)
    return scale**2 / np.maximum(np.diag(inverse), 1.0)

"""Noise in an input weakens its effect: by how much, where the samples tell.

A fit of ``y = b v`` on recorded ``v + n`` finds ``b S / (S + N)``, S and N being the variances that
the other inputs do not explain (Fuller 1987, Measurement Error Models, Sec. 1.1). White noise shows
between neighbouring samples of a signal that is otherwise smooth. An input may truly be white,
though; then its effect is white, too. So what changes from sample to sample in an input is noise
only where the derivative does not follow it as the fit says.
"""

from __future__ import annotations

import numpy as np

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
    x = inputs - inputs.mean(axis=0)
    own = _partial_variance(x)
    within = np.diff(runs) == 0
    third = np.diff(inputs, n=3, axis=0)[within[2:] & within[1:-1] & within[:-2]]
    noise = (np.median(np.abs(third), axis=0) / _QUARTILE) ** 2 / _BINOMIAL
    # What is white must also be white over two steps; jumps and slow changes are not.
    wide = (inputs[2:] - inputs[:-2])[within[1:] & within[:-1]]
    noise = np.minimum(noise, (np.median(np.abs(wide), axis=0) / _QUARTILE) ** 2 / 2)
    share = noise / np.maximum(own, np.finfo(float).tiny)
    fast = np.diff(np.column_stack([inputs, target]), n=2, axis=0)[within[1:] & within[:-1]]
    fast = fast - fast.mean(axis=0)
    spread = np.maximum(fast.std(axis=0)[:-1], np.finfo(float).tiny)
    effect = np.linalg.lstsq(fast[:, :-1] / spread, fast[:, -1], rcond=1e-10)[0] / spread
    silent = np.abs(effect) < _NO_EFFECT * np.abs(row)
    told = (share > _SHARE) & (share < 1) & silent
    shares[told] = share[told]
    return shares


def _partial_variance(x: Array) -> Array:
    """Variance of each input that the others do not explain."""
    scale = np.maximum(x.std(axis=0), np.finfo(float).tiny)
    correlations = (x / scale).T @ (x / scale) / len(x)
    inverse = np.linalg.pinv(correlations, rcond=1e-12, hermitian=True)
    return scale**2 / np.maximum(np.diag(inverse), 1.0)

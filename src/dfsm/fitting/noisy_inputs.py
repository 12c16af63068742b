"""Noise in an input weakens its effect: by how much, where the samples tell.

A fit of ``y = b v`` on recorded ``v + n`` finds ``b S / (S + N)``, S and N being the variances that
the other inputs do not explain (Fuller 1987, Measurement Error Models, Sec. 1.1). White noise shows
between neighbouring samples of a signal that is otherwise smooth. An input may truly be white,
though; then its effect is white, too. So what changes from sample to sample in an input is noise
only where the derivative does not follow it as the fit says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dfsm.core.types import Array
from dfsm.numerics.time_mesh import std_over

# Share of an input's own variance from which noise is told, and share of the fitted effect below
# which its fast part has none.
_SHARE, _NO_EFFECT = 0.05, 0.3
# Normal distribution: its upper quartile; and squares of the binomial coefficients 1, 3, 3, 1.
_QUARTILE, _BINOMIAL = 0.6745, 20.0
_FEWEST = 100


def noise_shares(inputs: Array, target: Array, parts: Sequence[slice], row: Array) -> Array:
    """Share of each input's own variance that is noise without an effect.

    Parameters
    ----------
    inputs, target
        Equidistant samples ``(sample, input)`` and the derivative ``(sample,)``.
    parts
        The samples of every run.
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
    own = _partial_variance(inputs, parts)
    noise = np.array([_white(column, parts) for column in inputs.T])
    share = noise / np.maximum(own, np.finfo(float).tiny)
    if not ((share > _SHARE) & (share < 1)).any():
        return shares
    effect = effect_of_fast_parts(inputs, target, parts)
    silent = np.abs(effect) < _NO_EFFECT * np.abs(row)
    told = (share > _SHARE) & (share < 1) & silent
    shares[told] = share[told]
    return shares


def effect_of_fast_parts(inputs: Array, target: Array, parts: Sequence[slice]) -> Array:
    """Coefficients of the target's second differences on those of the inputs, ``(input,)``."""
    table = np.zeros((0, inputs.shape[1] + 1))
    mean, count = np.zeros(table.shape[1]), 0
    for centred in (False, True):
        for rows in parts:
            fast = np.diff(np.column_stack([inputs[rows], target[rows]]), n=2, axis=0)
            if centred:  # the triangle of all rows so far tells the same as they do
                table = np.asarray(np.linalg.qr(np.concatenate([table, fast - mean]), mode="r"))
            else:
                mean, count = mean + fast.sum(axis=0), count + len(fast)
        mean = mean / max(count, 1) if not centred else mean
    spread = np.sqrt(np.sum(table**2, axis=0) / max(count, 1))[:-1]
    spread = np.maximum(spread, np.finfo(float).tiny)
    return np.linalg.lstsq(table[:, :-1] / spread, table[:, -1], rcond=1e-10)[0] / spread


def _white(values: Array, parts: Sequence[slice]) -> float:
    """Variance of what is white in samples ``(sample,)`` of runs, by their differences."""
    third = _median_size(lambda v: np.diff(v, n=3), values, parts)
    noise = (third / _QUARTILE) ** 2 / _BINOMIAL
    # What is white must also be white over two steps; jumps and slow changes are not.
    wide = _median_size(lambda v: v[2:] - v[:-2], values, parts)
    return float(min(noise, (wide / _QUARTILE) ** 2 / 2))


def _median_size(
    differences: Callable[[Array], Array], values: Array, parts: Sequence[slice]
) -> float:
    """Median over all runs of how large differences are, in one array as long as `values`."""
    sizes, count = np.empty(len(values)), 0
    for rows in parts:
        found = np.abs(differences(values[rows]))
        sizes[count : count + len(found)] = found
        count += len(found)
    return float(np.median(sizes[:count], overwrite_input=True))


def _partial_variance(inputs: Array, parts: Sequence[slice]) -> Array:
    """Variance of each input that the others do not explain."""
    mean, tiny = inputs.mean(axis=0), np.finfo(float).tiny
    scale = np.maximum(std_over(inputs, None), tiny)
    correlations = np.zeros((len(scale), len(scale)))
    for rows in parts:
        z = (inputs[rows] - mean) / scale
        correlations += z.T @ z
    inverse = np.linalg.pinv(correlations / len(inputs), rcond=1e-12, hermitian=True)
    return scale**2 / np.maximum(np.diag(inverse), 1.0)

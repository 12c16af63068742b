"""Extremes beyond what was simulated: Gumbel's distribution of the maxima of blocks.

Source: E. J. Gumbel, "Statistics of extremes", 1958; the variances of its estimates are those of
maximum likelihood for many maxima.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import gumbel_r

from dfsm.core.shapes import Series
from dfsm.core.types import Array
from dfsm.errors import DfsmError

# Variances of location and scale and their covariance, in squares of the scale over the maxima.
_VARIANCE = (1.1087, 0.6079, 0.2570)
_FEWEST = 5


class Gumbel(NamedTuple):
    """Distribution of the largest value in a block: exp(-exp(-(x - location) / scale))."""

    location: float
    scale: float
    maxima: int


def block_maxima(time: Series, values: Series, block: float) -> Array:
    """Largest value in every whole block.

    Parameters
    ----------
    time, values
        Shapes ``(time,)``.
    block
        Length in s; a rest that is shorter is left out.

    Returns
    -------
    ndarray
        Shape ``(block,)``.

    Raises
    ------
    DfsmError
        There are fewer than five whole blocks, or blocks without samples.
    """
    # An interval of the mesh that is longer than a block leaves one without samples.
    longest = float(np.diff(time).max())
    if block < longest * (1 - 1e-9):
        raise DfsmError(
            f"blocks of {block:g} s hold no sample where samples are {longest:g} s apart: take "
            "longer blocks"
        )
    count = int((time[-1] - time[0]) / block * (1 + 1e-9))
    if count < _FEWEST:
        raise DfsmError(
            f"{time[-1] - time[0]:g} s hold {count} whole blocks of {block:g} s, expected at least "
            f"{_FEWEST}: take shorter blocks or longer runs"
        )
    edges = np.searchsorted(time, time[0] + block * np.arange(count) * (1 - 1e-12))
    last = int(np.searchsorted(time, time[0] + block * count * (1 - 1e-12), side="right"))
    return np.maximum.reduceat(values[:last], edges)


def fit_gumbel(maxima: Array) -> Gumbel:
    """Most likely distribution of some maxima, shape ``(block,)``."""
    if np.ptp(maxima) == 0:
        return Gumbel(float(maxima[0]), 0.0, len(maxima))
    location, scale = gumbel_r.fit(maxima)
    return Gumbel(float(location), float(scale), len(maxima))


def extrapolated(
    fits: Sequence[Gumbel], weights: Sequence[float], blocks: float
) -> tuple[float, float]:
    """Value that is exceeded once in so many blocks, and its standard error.

    Parameters
    ----------
    fits
        Distribution under every condition.
    weights
        Share of the time of every condition; a sum below 1 leaves time without exceedance.
    blocks
        Number of blocks, more than 1.

    Returns
    -------
    tuple
        x with Σ weight (1 - F(x)) = 1 / blocks, and the standard error that follows from those of
        locations and scales, to first order.
    """
    w = np.asarray(weights, dtype=np.float64)
    location, scale = (np.array([f[i] for f in fits]) for i in range(2))
    wide = np.maximum(scale, 1e-12 * np.maximum(np.abs(location), 1.0))

    def rare(x: float) -> float:
        # 1 - exp(-e), accurate where it is tiny; far below a narrow one nothing is rare.
        with np.errstate(over="ignore"):
            above = -np.expm1(-np.exp(-(x - location) / wide))
        return float(w @ above) - 1 / blocks

    low = float((location - 20 * wide).min())
    high = float((location + (np.log(blocks) + 50) * wide).max())
    if rare(low) <= 0:
        return float(location.max()), 0.0
    x = float(brentq(rare, low, high, xtol=1e-12 * max(abs(low), abs(high), 1e-300)))  # pyright: ignore[reportArgumentType]
    y = (x - location) / wide
    with np.errstate(over="ignore"):
        density = w * np.exp(-y - np.exp(-y)) / wide
    # dx = Σ density (d location + y d scale) / Σ density.
    share = density / density.sum()
    a, b, c = _VARIANCE
    counts = np.array([f.maxima for f in fits])
    variance = (share * scale) ** 2 * (a + 2 * c * y + b * y**2) / counts
    return x, float(np.sqrt(variance.sum()))

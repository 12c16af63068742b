"""Gaussian units on many samples: activations, and least squares on them in bounded memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.fitting.corrective.training import TrainingSet
from dfsm.models.corrective import GaussianUnits
from dfsm.numerics.least_squares import NormalEquations

_BLOCK = 8192


def activations(z: Array, centres: Array, width: float | Array) -> Array:
    """Gaussian units exp(-|z - c|² / width²), shape ``(sample, unit)``."""
    a, c = z / width, centres / width
    # In place, and with a unit's activations next to each other: this is where training spends
    # its time.
    exponents = c @ (2 * a.T)
    exponents -= (a**2).sum(1)
    exponents -= (c**2).sum(1)[:, None]
    np.minimum(exponents, 0.0, out=exponents)
    return np.exp(exponents, out=exponents).T


def unit_sums(z: Array, targets: Array, centres: Array, width: float | Array) -> NormalEquations:
    """Collect the normal equations of targets on unit activations, in blocks of bounded memory."""
    n = len(centres)
    result = NormalEquations(np.zeros(n + targets.shape[1]), n)
    for start in range(0, len(z), _BLOCK):
        part = slice(start, start + _BLOCK)
        result.add(activations(z[part], centres, width), targets[part])
    return result


def mean_diagonal(Q: Array) -> float:
    """Average diagonal element, never zero: the scale of a ridge."""
    return float(np.trace(Q)) / len(Q) + np.finfo(float).tiny


def gaussian_units(
    data: TrainingSet,
    centres: Array,
    width: float | Array,
    weights: NDArray[np.floating],
    bias: Array,
) -> GaussianUnits:
    """Build the JAX module from centres and weights that refer to standardised samples."""
    return GaussianUnits(
        shift=from_host(data.shift),
        scale=from_host(data.scale * width),
        centres=from_host((centres / width).T),
        weights=from_host((weights * data.target_scale).T),
        bias=from_host(bias * data.target_scale),
    )

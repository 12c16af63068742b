"""Damage-equivalent loads with their exact slopes: cycles are pairs of samples, not of classes."""

from __future__ import annotations

import numpy as np

from dfsm.core.shapes import Series
from dfsm.core.types import Array, IntArray
from dfsm.numerics.rainflow import four_point_cycles


def rainflow_cycles(values: Series) -> IntArray:
    """Samples between which the cycles of a load history lie, repeated end to end.

    Parameters
    ----------
    values
        Load history, shape ``(time,)``, finite.

    Returns
    -------
    ndarray
        Shape ``(cycle, 2)``: the samples at the two turning points of every cycle. Four points at a
        time (ISO 12110-2) along the history from its maximum to its maximum, after which nothing
        remains open (ASTM E1049, 5.4.5).
    """
    values = np.asarray(values, dtype=np.float64)
    if len(values) < 2 or np.ptp(values) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    first = int(np.argmax(values))
    order = np.concatenate([np.arange(first, len(values)), np.arange(first + 1)])
    at = order[_turns(values[order])]
    pairs, kept = four_point_cycles(values[at].tolist())
    # What is left is the maximum, the minimum and the maximum again: one cycle.
    if len(kept) >= 2:
        pairs.append((kept[0], kept[1]))
    return at[np.array(pairs, dtype=np.int64)]


def damage_with_slope(
    values: Series, duration: float, exponent: float, frequency: float = 1.0
) -> tuple[float, Array]:
    """Damage-equivalent load, and its slope with every sample.

    The slope is exact as long as no cycle closes with another partner: turning points move with the
    samples, which samples they are does not change.

    Parameters
    ----------
    values, duration, exponent, frequency
        As for `damage_equivalent_load`, but finite already.

    Returns
    -------
    tuple
        The load, and its derivative with respect to the samples, shape ``(time,)``. It differs from
        `damage_equivalent_load`, which sorts turning points into 256 classes first, by less than
        a class.
    """
    slope = np.zeros(len(values))
    pairs = rainflow_cycles(values)
    if not len(pairs):
        return 0.0, slope
    rise = values[pairs[:, 1]] - values[pairs[:, 0]]
    largest = float(np.abs(rise).max())
    shares = np.abs(rise) / largest
    damage = float(np.sum(shares**exponent)) / (frequency * duration)
    size = damage ** (1 / exponent)
    # d/dS of (Σ S^m / T)^(1/m), all in units of the largest range.
    steps = (damage / size) ** -1 * shares ** (exponent - 1) / (frequency * duration)
    steps = steps * np.sign(rise)
    np.add.at(slope, pairs[:, 1], steps)
    np.add.at(slope, pairs[:, 0], -steps)
    return largest * size, slope


def _turns(values: Array) -> IntArray:
    """Samples at which a history turns, both ends included; of a plateau the first sample."""
    steps = np.diff(values)
    moved = np.flatnonzero(steps)
    ways = np.sign(steps[moved])
    turned = moved[1:][ways[1:] != ways[:-1]]
    return np.concatenate([[0], _plateaus(steps, turned), [len(values) - 1]]).astype(np.int64)


def _plateaus(steps: Array, turned: IntArray) -> IntArray:
    """First sample of the plateau that ends where the history turns."""
    moved = np.flatnonzero(steps)
    before = moved[np.searchsorted(moved, turned) - 1]
    return before + 1

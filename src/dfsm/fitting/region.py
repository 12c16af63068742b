"""How far an input vector is from the training data, along the schedule.

A range per input says nothing of combinations: torque and speed may each be usual, and never occur
together. At every operating point the data have a mean and a covariance; the distance is
Mahalanobis's, and how large it may be follows from runs that did not enter the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import jax
import numpy as np
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray
from dfsm.data.dataset import Dataset
from dfsm.fitting.samples import Samples
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region, squared_distance
from dfsm.numerics.hats import hats
from dfsm.numerics.time_mesh import mean_over, quantiles_over, std_over

# Operating points along the schedule: means of the inputs over equally filled bins.
_OPERATING_POINTS = 12
# Share of the samples that are nearer than is said to be usual, measured by the other runs. Few are
# left out: a run that went where no other did must not make everything usual.
_SHARE = 0.98
# Standard deviations of any direction are at least this share of an input's overall one.
_FLOOR = 1e-2


def region_of(samples: Samples, model: LinearModel, data: Dataset) -> Region:
    """Ranges, operating points and distances of the training samples of a model."""
    inputs, weights = samples.inputs, samples.weights
    # A signal at a limit differs from file to file by its rounding; that is not "outside".
    order = samples.signals.order
    names = order.names
    steps = np.array([(data.channel(n).step or 0.0) if n in data.names else 0.0 for n in names])
    bins, column = np.zeros(len(inputs), dtype=np.int8), model.schedule
    operating = mean_over(inputs, weights)[None]
    if column is not None:
        bins = _equal_bins(inputs[:, column], weights)
        inside = [np.flatnonzero(bins == place) for place in range(int(bins.max()) + 1)]
        each = [None if weights is None else weights[rows] for rows in inside]
        operating = np.stack([mean_over(inputs[b], w) for b, w in zip(inside, each, strict=True)])
        del inside
    fixed = np.r_[order.columns("disturbances"), order.columns("parameters")]
    W, reach = whiten(inputs, samples.parts, bins, column, fixed, weights)
    return Region(
        low=from_host(inputs.min(axis=0) - steps),
        high=from_host(inputs.max(axis=0) + steps),
        mean=from_host(mean_over(inputs, weights)),
        std=from_host(std_over(inputs, weights)),
        grid=from_host(operating[:, column or 0]),
        operating=from_host(operating),
        whitening=from_host(W / reach),
        fixed=len(fixed),
        schedule=column,
    )


def _equal_bins(schedule: Array, weights: Array | None) -> NDArray[np.int8]:
    """Bin of every sample, in the order of the schedule, so that all are filled alike."""
    ranks = np.argsort(schedule, kind="stable")
    if weights is None:
        parts = np.array_split(ranks, _OPERATING_POINTS)
    else:
        ends = np.cumsum(weights[ranks])
        shares = np.arange(1, _OPERATING_POINTS) / _OPERATING_POINTS
        parts = np.split(ranks, np.searchsorted(ends, shares * ends[-1]))
    bins = np.zeros(len(schedule), dtype=np.int8)
    place, only = -1, None
    for rows in (rows for rows in parts if len(rows)):
        first, last = schedule[rows[[0, -1]]]
        # Bins of one value, as a parameter has it in many runs, are one operating point.
        place += first != last or first != only
        only = first if first == last else None
        bins[rows] = place
    return bins


def whiten(
    inputs: Array,
    parts: Sequence[slice],
    bins: NDArray[np.integer],
    schedule: int | None,
    first: IntArray,
    weights: Array | None = None,
) -> tuple[Array, float]:
    """Matrices that turn deviations from the operating points into distances.

    Parameters
    ----------
    inputs
        Training samples, shape ``(sample, input)``.
    parts
        The samples of every run.
    bins
        Operating point of every sample, ``(sample,)``; one for all without a schedule.
    schedule
        Input column that schedules.
    first
        Columns that nobody chooses, disturbances and parameters.
    weights
        Of the samples, 1 on average, ``(sample,)``; None where all count alike.

    Returns
    -------
    tuple
        Matrices W, shape ``(point, input, input)``, and the largest usual distance. The distance
        of I at an operating point with mean μ is |W (I − μ)|; its first components depend on the
        columns in `first` alone.
    """
    mean, std = mean_over(inputs, weights), std_over(inputs, weights)
    std = np.where(std > 0, std, 1.0)
    order = np.concatenate([first, np.delete(np.arange(len(std)), first)])
    groups, count = _groups(parts, len(inputs)), int(bins.max()) + 1

    def sums_of(group: slice) -> list[Array]:
        z, w = (inputs[group] - mean) / std, None if weights is None else weights[group]
        inside = [bins[group] == place for place in range(count)]
        return [_sums(z[rows], None if w is None else w[rows]) for rows in inside]

    # One group after the other: standardised samples would take as much memory again.
    sums = np.array([sums_of(group) for group in groups])
    total = sums.sum(axis=0)
    means = total[:, 0, 1:] / total[:, :1, 0]
    grid = means[:, schedule or 0]
    distances = np.empty(len(inputs))
    for group, own in zip(groups, sums, strict=True):
        others = total - own
        # A point that only this run has seen is measured by its own data.
        enough = others[:, 0, 0] > 2 * len(std)
        used = np.where(enough[:, None, None], others, total)
        W = np.stack([_whitening(s, order) for s in used])
        middles, z = used[:, 0, 1:] / used[:, :1, 0], (inputs[group] - mean) / std
        distances[group] = np.sqrt(_squared(z, grid, z[:, schedule or 0], middles, W))
    reach = float(quantiles_over(distances, _SHARE, weights))
    return np.stack([_whitening(s, order) for s in total]) / std, reach


@jax.jit
def _squared(z: Array, grid: Array, value: Array, middles: Array, W: Array) -> jax.Array:
    return squared_distance(z, hats(grid, value), middles, W)


def _groups(parts: Sequence[slice], count: int) -> Sequence[slice]:
    """Parts of the data that are judged by the others: runs, or quarters of a single one."""
    if len(parts) > 1:
        return parts
    ends = [-(-count * k // 4) for k in range(5)]
    return [slice(start, stop) for start, stop in pairwise(ends) if stop > start]


def _sums(z: Array, weights: Array | None) -> Array:
    """[1, z] products summed up, shape ``(1 + input, 1 + input)``."""
    wide = np.concatenate([np.ones((len(z), 1)), z], axis=1)
    return wide.T @ (wide if weights is None else wide * weights[:, None])


def _whitening(sums: Array, order: IntArray) -> Array:
    """Inverse root of a covariance; row k sees the columns ``order[: k + 1]`` only."""
    mean = sums[0, 1:] / sums[0, 0]
    C = sums[1:, 1:] / sums[0, 0] - np.outer(mean, mean) + _FLOOR**2 * np.eye(len(mean))
    W = np.zeros_like(C)
    W[:, order] = np.linalg.inv(np.linalg.cholesky(C[np.ix_(order, order)]))
    return W

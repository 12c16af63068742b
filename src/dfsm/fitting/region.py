"""How far an input vector is from the training data, along the schedule.

A range per input says nothing of combinations: torque and speed may each be usual, and never occur
together. At every operating point the data have a mean and a covariance; the distance is
Mahalanobis's, and how large it may be follows from runs that did not enter the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array, IntArray
from dfsm.data.dataset import Dataset
from dfsm.fitting.samples import Samples
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region, squared_distance
from dfsm.numerics.hats import hats

# Operating points along the schedule: means of the inputs over equally filled bins.
_OPERATING_POINTS = 12
# Share of the samples that are nearer than is said to be usual, measured by the other runs. Few are
# left out: a run that went where no other did must not make everything usual.
_SHARE = 0.98
# Standard deviations of any direction are at least this share of an input's overall one.
_FLOOR = 1e-2


def region_of(samples: Samples, model: LinearModel, data: Dataset) -> Region:
    """Ranges, operating points and distances of the training samples of a model."""
    inputs = samples.inputs
    # A signal at a limit differs from file to file by its rounding; that is not "outside".
    order = samples.signals.order
    names = order.names
    steps = np.array([(data.channel(n).step or 0.0) if n in data.names else 0.0 for n in names])
    bins, column = [np.arange(len(inputs))], model.schedule
    if column is not None:
        ranks = np.argsort(inputs[:, column], kind="stable")
        bins = np.array_split(ranks, _OPERATING_POINTS)
    operating = np.stack([inputs[rows].mean(axis=0) for rows in bins])
    fixed = np.r_[order.columns("disturbances"), order.columns("parameters")]
    W, reach = whiten(inputs, samples.runs, bins, column, fixed)
    return Region(
        low=jnp.asarray(inputs.min(axis=0) - steps),
        high=jnp.asarray(inputs.max(axis=0) + steps),
        mean=jnp.asarray(inputs.mean(axis=0)),
        std=jnp.asarray(inputs.std(axis=0)),
        grid=jnp.asarray(operating[:, column or 0]),
        operating=jnp.asarray(operating),
        whitening=jnp.asarray(W / reach),
        fixed=len(fixed),
        schedule=column,
    )


def whiten(
    inputs: Array, runs: IntArray, bins: Sequence[IntArray], schedule: int | None, first: IntArray
) -> tuple[Array, float]:
    """Matrices that turn deviations from the operating points into distances.

    Parameters
    ----------
    inputs
        Training samples, shape ``(sample, input)``.
    runs
        Run of every sample, ``(sample,)``.
    bins
        Samples of every operating point; one for all without a schedule.
    schedule
        Input column that schedules.
    first
        Columns that nobody chooses, disturbances and parameters.

    Returns
    -------
    tuple
        Matrices W, shape ``(point, input, input)``, and the largest usual distance. The distance
        of I at an operating point with mean μ is |W (I − μ)|; its first components depend on the
        columns in `first` alone.
    """
    std = np.where(inputs.std(axis=0) > 0, inputs.std(axis=0), 1.0)
    z = (inputs - inputs.mean(axis=0)) / std
    order = np.concatenate([first, np.delete(np.arange(z.shape[1]), first)])
    groups = _groups(runs)
    sums = np.array([[_sums(z[b[groups[b] == k]]) for b in bins] for k in np.unique(groups)])
    total = sums.sum(axis=0)
    means = total[:, 0, 1:] / total[:, :1, 0]
    grid = means[:, schedule or 0]
    distances = []
    for k in np.unique(groups):
        mine, others = groups == k, total - sums[k]
        # A point that only this run has seen is measured by its own data.
        enough = others[:, 0, 0] > 2 * z.shape[1]
        used = np.where(enough[:, None, None], others, total)
        W = np.stack([_whitening(s, order) for s in used])
        middles = used[:, 0, 1:] / used[:, :1, 0]
        shares = hats(jnp.asarray(grid), jnp.asarray(z[mine, schedule or 0]))
        squared = squared_distance(*map(jnp.asarray, (z[mine], shares, middles, W)))
        distances.append(np.sqrt(squared))
    reach = float(np.quantile(np.concatenate(distances), _SHARE))
    return np.stack([_whitening(s, order) for s in total]) / std, reach


def _groups(runs: IntArray) -> IntArray:
    """Parts of the data that are judged by the others: runs, or quarters of a single one."""
    if len(np.unique(runs)) > 1:
        return runs
    return np.arange(len(runs)) * 4 // len(runs)


def _sums(z: Array) -> Array:
    """[1, z] products summed up, shape ``(1 + input, 1 + input)``."""
    wide = np.concatenate([np.ones((len(z), 1)), z], axis=1)
    return wide.T @ wide


def _whitening(sums: Array, order: IntArray) -> Array:
    """Inverse root of a covariance; row k sees the columns ``order[: k + 1]`` only."""
    mean = sums[0, 1:] / sums[0, 0]
    C = sums[1:, 1:] / sums[0, 0] - np.outer(mean, mean) + _FLOOR**2 * np.eye(len(mean))
    W = np.zeros_like(C)
    W[:, order] = np.linalg.inv(np.linalg.cholesky(C[np.ix_(order, order)]))
    return W

"""Subsampling: a few hundred points that stand for all samples (Sec. 3.5).

All three ways work on standardised inputs and take a seed. They return the points, the samples
that each stands for, and so allow both the paper's cluster-mean targets and plain ones.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from dfsm.core.shapes import Labels, Means, Points, Rows, Samples, Targets
from dfsm.errors import DfsmError

Method = Literal["kmeans", "maxmin", "random"]

# k-means++ places its centres on at most this many samples per centre, drawn at random: samples
# of one run 0.05 s apart are near copies, and the means are then taken over all of them.
_SAMPLES_PER_CENTRE = 50
# Samples whose nearest point is looked for at once.
_TOGETHER = 2**16


@dataclass(frozen=True)
class Subsample:
    """Points that represent a set of samples.

    Attributes
    ----------
    points
        Representative inputs, shape ``(point, input)``, in the units of the samples.
    labels
        The point that each sample belongs to (its nearest), shape ``(sample,)``.
    """

    points: Points
    labels: Labels

    def means(self, values: Targets) -> Means:
        """Average the values of the samples of each point.

        Parameters
        ----------
        values
            Shape ``(sample, target)``.

        Returns
        -------
        ndarray
            Shape ``(point, target)``.
        """
        n = len(self.points)
        counts = np.bincount(self.labels, minlength=n)
        sums = [np.bincount(self.labels, weights=v, minlength=n) for v in values.T]
        return np.stack(sums, axis=1) / counts[:, None]


def subsample(inputs: Samples, size: int, method: Method = "kmeans", seed: int = 0) -> Subsample:
    """Choose `size` points that represent the samples.

    Parameters
    ----------
    inputs
        Standardised samples, shape ``(sample, input)``: distances are Euclidean.
    size
        Number of points n_s.
    method
        ``"kmeans"``: k-means with k-means++ initialisation, points are cluster means (the paper;
        Arthur & Vassilvitskii 2007). ``"maxmin"``: start from a random sample and add the one
        farthest from those chosen (Johnson et al. 1990). ``"random"``: without replacement.
    seed
        Seed of every draw.

    Returns
    -------
    Subsample
        Every point has at least one sample.

    Raises
    ------
    DfsmError
        More points than samples.
    """
    if size > len(inputs):
        raise DfsmError(
            f"{size} points were asked for but there are only {len(inputs)} samples: "
            "lower corrective.samples or give more runs"
        )
    rng = np.random.default_rng(seed)
    if method == "kmeans":
        points = _kmeans(inputs, size, rng)
    elif method == "maxmin":
        points = inputs[maxmin(inputs, size, rng)]
    else:
        points = inputs[np.sort(rng.choice(len(inputs), size, replace=False))]
    labels = nearest(inputs, points)
    used, labels = np.unique(labels, return_inverse=True)
    points = points[used]
    result = Subsample(points, labels.astype(np.int64))
    if method == "kmeans":
        result = Subsample(result.means(inputs), result.labels)
    return result


def nearest(inputs: Samples, points: Points) -> Labels:
    """Index of the nearest point for every sample, by Euclidean distance."""
    from scipy.spatial import KDTree

    tree, index = KDTree(points), np.empty(len(inputs), dtype=np.int64)
    for start in range(0, len(inputs), _TOGETHER):
        _, index[start : start + _TOGETHER] = tree.query(inputs[start : start + _TOGETHER])
    return index


def _kmeans(inputs: Samples, size: int, rng: np.random.Generator) -> Points:
    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning

    limit = _SAMPLES_PER_CENTRE * size
    if len(inputs) > limit:
        inputs = inputs[np.sort(rng.choice(len(inputs), limit, replace=False))]
    state = int(rng.integers(2**31))
    # The stub of scikit-learn knows only the string form of n_init.
    one: Any = 1
    model: Any = KMeans(size, init="k-means++", n_init=one, random_state=state, max_iter=50)
    with warnings.catch_warnings():
        # Fewer distinct samples than centres: `subsample` drops those that stand for none.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(inputs).cluster_centers_


def maxmin(inputs: Samples, size: int, rng: np.random.Generator) -> Rows:
    """Indices of samples each as far as possible from those before it (Johnson et al. 1990).

    Parameters
    ----------
    inputs
        Standardised samples, shape ``(sample, input)``.
    size
        How many, at most all.
    rng
        Draws the first.

    Returns
    -------
    ndarray
        Shape ``(size,)``, in the order chosen.
    """
    chosen = np.empty(size, dtype=np.int64)
    chosen[0] = rng.integers(len(inputs))
    distance = np.full(len(inputs), np.inf)
    columns = np.ascontiguousarray(inputs.T)
    for i in range(1, size):
        new = np.zeros(len(inputs))
        for column in columns:
            new += (column - column[chosen[i - 1]]) ** 2
        np.minimum(distance, new, out=distance)
        chosen[i] = np.argmax(distance)
    return chosen

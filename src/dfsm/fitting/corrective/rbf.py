"""RBF networks: ridge weights on all units, or units added one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Literal

import numpy as np

from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array, IntArray
from dfsm.fitting.corrective.gaussians import gaussian_units, unit_sums
from dfsm.fitting.corrective.length_scales import hyper_parameters
from dfsm.fitting.corrective.training import SEARCH_SAMPLES, CorrectiveFit, TrainingSet
from dfsm.numerics.least_squares import NormalEquations, merge
from dfsm.numerics.sampling import Method, Subsample, subsample

# Widths tried first, as multiples of the typical distance between two standardised samples; then
# the neighbours of the best.
_WIDTHS = (0.5, 1.0, 2.0)
_FINER = np.sqrt(2.0)
# Cluster means that the length scales come from: the work grows with their third power.
_LENGTH_POINTS = 200
_RIDGES = 10.0 ** np.arange(-9.0, 1.0)


@settings_class
class RBF:
    """RBF network: Gaussian units at the subsample, weights by ridge regression.

    Attributes
    ----------
    samples
        Number of units n_s (the paper: 200 to 500).
    sampling
        How their centres are chosen, see `subsample`.
    targets
        ``"all"`` fits the weights to every sample; ``"cluster_means"`` to the means over the
        clusters, as the paper does.
    width
        Width of the units relative to the typical distance between two samples; None chooses it
        by cross-validation over runs.
    directions
        ``"equal"`` makes the units as long in all standardised inputs, as in the paper;
        ``"per_input"`` as long in the direction of each as a Gaussian process through the cluster
        means finds the function to be, where that is better on runs left out.
    """

    kind: Literal["rbf"] = "rbf"
    samples: int = 200
    sampling: Method = "kmeans"
    targets: Literal["all", "cluster_means"] = "all"
    width: float | None = None
    directions: Literal["per_input", "equal"] = "per_input"

    def __post_init__(self) -> None:
        _check_units(self.samples, self.width)

    def train(self, data: TrainingSet, seed: int) -> CorrectiveFit:
        """Train a network of all units."""
        return _train(data, self, seed)


@settings_class
class IncrementalRBF:
    """RBF network that grows unit by unit, as MATLAB's ``newrb`` does.

    Each step adds the candidate that lowers the squared error most (orthogonal least squares,
    Chen, Cowan & Grant 1991), until the goal or the limit is reached.

    Attributes
    ----------
    goal
        Mean-square error to stop at, as a fraction of the residual's mean square.
    neurons
        Largest number of units.
    samples, sampling, targets, width, directions
        As for `RBF`; the subsample provides the candidates.
    """

    kind: Literal["rbf_incremental"] = "rbf_incremental"
    goal: float = 0.0
    neurons: int = 100
    samples: int = 400
    sampling: Method = "kmeans"
    targets: Literal["all", "cluster_means"] = "all"
    width: float | None = None
    directions: Literal["per_input", "equal"] = "per_input"

    def __post_init__(self) -> None:
        _check_units(self.samples, self.width)
        require(self.neurons >= 1, "corrective.neurons", self.neurons, "at least 1")
        require(self.goal >= 0, "corrective.goal", self.goal, "0 or more")

    def train(self, data: TrainingSet, seed: int) -> CorrectiveFit:
        """Train a network of the units that help most."""

        def choose(Q: Array, right: Array, power: Array) -> IntArray:
            return _forward_selection(Q, right, power, self.goal, self.neurons)

        return _train(data, self, seed, choose)


def _check_units(samples: int, width: float | None) -> None:
    require(samples >= 1, "corrective.samples", samples, "at least 1")
    positive = width is None or 0 < width < np.inf
    require(positive, "corrective.width", width, "a positive number")


def _train(
    data: TrainingSet,
    settings: RBF | IncrementalRBF,
    seed: int,
    choose: Callable[[Array, Array, Array], IntArray] | None = None,
) -> CorrectiveFit:
    """Width and ridge by cross-validation, then weights of all units, or of some, on all targets.

    `choose` tells which units from their products with each other and with the targets, and the
    targets' squares.
    """
    points = subsample(data.z, settings.samples, settings.sampling, seed)
    tried = []
    if settings.directions == "per_input":
        tried.append(_relative_lengths(data, points, seed))
    tried.append(np.ones(data.z.shape[1]))
    # Likelihood may take levels of an input for unrelated functions; runs left out know better.
    fits = [_search(data, points, lengths, settings.width) for lengths in tried]
    k = int(np.argmin([error.sum() for error, _, _ in fits]))
    (error, ridge, width), lengths = fits[k], tried[k]
    data, points = data.stretched(lengths), replace(points, points=points.points / lengths)
    size = width * data.typical_distance
    total = _final_sums(data, points, size, settings.targets)
    mean, products = total.moments(centred=True)
    n = len(points.points)
    Q, right = products[:n, :n], products[:n, n:]
    used = np.arange(n)
    if choose is not None:
        used = choose(Q, right, np.diag(products)[n:])
        # Few units explain less than all candidates do, and want another ridge.
        error, ridge = _cross_validate(data.thinned(SEARCH_SAMPLES), points.points[used], size)
    eigenvalues, V = np.linalg.eigh(Q[np.ix_(used, used)])
    weights = V @ _shrink(V.T @ right[used], eigenvalues, ridge)
    function = gaussian_units(
        data, points.points[used], size, weights, mean[n:] - mean[used] @ weights
    )
    ridges = ", ".join(f"{r:.0e}" for r in ridge)
    detail = f"{len(used)} Gaussian units, relative width {width:.2g}, ridge {ridges}"
    return CorrectiveFit(function, 1 - error, detail)


def _search(
    data: TrainingSet, points: Subsample, lengths: Array, width: float | None
) -> tuple[Array, Array, float]:
    """Error on left-out runs, ridges and relative width for some lengths; the best, or as set.

    Parameters
    ----------
    data, points
        Samples, of which some judge, and the centres.
    lengths
        Of every input, shape ``(input,)``; only their ratios matter.
    width
        None tries several.
    """
    data, centres = data.stretched(lengths), points.points / lengths
    base, judges = data.typical_distance, data.thinned(SEARCH_SAMPLES)

    def best(widths: Iterable[float]) -> tuple[Array, Array, float]:
        trials = [(*_cross_validate(judges, centres, base * w), w) for w in widths]
        return min(trials, key=lambda trial: float(trial[0].sum()))

    if width is not None:
        return best((width,))
    coarse = best(_WIDTHS)
    finer = best((coarse[2] * _FINER, coarse[2] / _FINER))
    return min(coarse, finer, key=lambda trial: float(trial[0].sum()))


def _relative_lengths(data: TrainingSet, points: Subsample, seed: int) -> Array:
    """Length scale of every input over their geometric mean, from some of the cluster means."""
    some = slice(None, None, -(-len(points.points) // _LENGTH_POINTS))
    *_, lengths = hyper_parameters(points.points[some], points.means(data.targets)[some], seed)
    return lengths / np.exp(np.log(lengths).mean())


def _final_sums(
    data: TrainingSet, points: Subsample, width: float, targets: str
) -> NormalEquations:
    if targets == "cluster_means":
        return unit_sums(points.points, points.means(data.targets), points.points, width)
    return unit_sums(data.z, data.targets, points.points, width)


def _shrink(rotated: Array, eigenvalues: Array, ridge: Array | float) -> Array:
    """Ridge solution in the eigenbasis; the ridge is relative to the mean eigenvalue."""
    eigenvalues = np.maximum(eigenvalues, 0.0)
    floor = eigenvalues.mean() + np.finfo(float).tiny
    return rotated / (eigenvalues[:, None] + np.asarray(ridge) * floor)


def _cross_validate(data: TrainingSet, centres: Array, width: float) -> tuple[Array, Array]:
    """Error of each target on left-out folds relative to no correction, and its best ridge."""
    n, labels = len(centres), np.unique(data.folds)
    parts = [
        unit_sums(data.z[data.folds == k], data.targets[data.folds == k], centres, width)
        for k in labels
    ]
    errors = np.zeros((len(_RIDGES), data.targets.shape[1]))
    baseline = np.zeros(data.targets.shape[1])
    for k in range(len(parts)):
        rest = merge([p for i, p in enumerate(parts) if i != k])
        mean, products = rest.moments(centred=True)
        Q, right = products[:n, :n], products[:n, n:]
        eigenvalues, V = np.linalg.eigh(Q)
        rotated = V.T @ right
        # The left-out fold about the mean of the others, without going back to its samples.
        held = parts[k]
        offset = held.sums / held.count - mean
        _, own = held.moments(centred=True)
        own = own + np.outer(offset, offset)
        H, h = V.T @ own[:n, :n] @ V, V.T @ own[:n, n:]
        baseline += held.count * np.diag(own)[n:]
        for i, ridge in enumerate(_RIDGES):
            w = _shrink(rotated, eigenvalues, ridge)
            errors[i] += held.count * (
                np.diag(own)[n:] - 2 * (w * h).sum(0) + np.einsum("ij,ij->j", w, H @ w)
            )
    relative = errors / baseline
    return relative.min(axis=0), _RIDGES[relative.argmin(axis=0)]


def _forward_selection(Q: Array, right: Array, power: Array, goal: float, limit: int) -> IntArray:
    """Orthogonal least squares on the normal equations: one unit per step."""
    Q, right = Q.copy(), right.copy()
    left = power.copy()
    usable = np.diag(Q) > 1e-10 * np.diag(Q).max()
    floor = 1e-10 * np.diag(Q).max()
    chosen: list[int] = []
    while len(chosen) < min(limit, len(Q)) and left.sum() > goal * power.sum():
        d = np.diag(Q)
        usable &= d > floor
        if not usable.any():
            break
        gain = np.where(usable, (right**2).sum(1) / np.where(usable, d, 1.0), -1.0)
        j = int(np.argmax(gain))
        chosen.append(j)
        usable[j] = False
        # What the chosen unit explains is removed from all others (a Cholesky step).
        left -= right[j] ** 2 / Q[j, j]
        column = Q[:, j] / Q[j, j]
        right -= np.outer(column, right[j])
        Q -= np.outer(column, Q[j])
    return np.array(chosen, dtype=np.int64)

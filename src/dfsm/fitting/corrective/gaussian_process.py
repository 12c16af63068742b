"""Gaussian process regression, exact on cluster means or sparse on all samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.fitting.corrective.gaussians import activations, gaussian_units, mean_diagonal, unit_sums
from dfsm.fitting.corrective.length_scales import hyper_parameters
from dfsm.fitting.corrective.training import CorrectiveFit, TrainingSet, cross_validated
from dfsm.numerics.sampling import Method, subsample

# Eigenvalues of a kernel matrix below this share of the largest are rounding.
_LEAST = 1e-9


@settings_class
class GP:
    """Gaussian process with one length scale per input, hyper-parameters by marginal likelihood.

    Attributes
    ----------
    samples
        Number of cluster means it is trained on, or of inducing points.
    sampling
        How they are chosen, see `subsample`.
    targets
        ``"cluster_means"``: exact regression on the means. ``"all"``: the means give the
        hyper-parameters and every sample enters through the inducing points (subset of
        regressors, Quiñonero-Candela & Rasmussen 2005).
    """

    kind: Literal["gp"] = "gp"
    samples: int = 200
    sampling: Method = "kmeans"
    targets: Literal["all", "cluster_means"] = "all"

    def __post_init__(self) -> None:
        require(self.samples >= 1, "corrective.samples", self.samples, "at least 1")

    def train(self, data: TrainingSet, seed: int) -> CorrectiveFit:
        """Train a Gaussian process; one kernel is shared by all targets."""
        points = subsample(data.z, self.samples, self.sampling, seed)
        means = points.means(data.targets)
        signal, noise, lengths = hyper_parameters(points.points, means, seed)
        kernel = _Kernel(points.points, np.sqrt(2.0) * lengths, signal)
        # The scatter within the clusters is the noise of single samples; that of means is smaller.
        scatter = noise + float(np.mean((data.targets - means[points.labels]) ** 2))
        if self.targets == "all":
            weights = kernel.sparse_weights(data, scatter)
        else:
            weights = kernel.exact_weights(means, noise)
        bias = np.zeros(means.shape[1])
        return CorrectiveFit(
            function=gaussian_units(data, kernel.points, kernel.width, weights, bias),
            explained=cross_validated(data, lambda rest: kernel.predictor(rest, scatter)),
            detail=f"{len(means)} points, length scales " + ", ".join(f"{v:.2g}" for v in lengths),
        )


@dataclass(frozen=True)
class _Kernel:
    """Squared-exponential kernel on fixed points, ``signal exp(-|z - z'|² / width²)``."""

    points: Array
    width: Array
    signal: float

    @property
    def gram(self) -> Array:
        return self.signal * activations(self.points, self.points, self.width)

    def exact_weights(self, targets: Array, noise: float) -> Array:
        """Weights of the units for exact regression on the points' own targets."""
        K = self.gram
        jitter = 1e-10 * mean_diagonal(K)
        return self.signal * np.linalg.solve(K + (noise + jitter) * np.eye(len(K)), targets)

    def sparse_weights(self, data: TrainingSet, noise: float) -> Array:
        """Weights of the units from all samples: (K_mn K_nm + noise K_mm)⁻¹ K_mn y."""
        n = len(self.points)
        products = unit_sums(data.z, data.targets, self.points, self.width).products
        # In the eigenbasis of the kernel, scaled to 1: long length scales make K_mm nearly
        # singular, and what varies slowly would be lost in its square.
        values, vectors = np.linalg.eigh(self.gram)
        known = values > _LEAST * values[-1]
        basis = vectors[:, known] / np.sqrt(values[known])
        A = basis.T @ (self.signal**2 * products[:n, :n]) @ basis
        right = basis.T @ (self.signal * products[:n, n:])
        return self.signal * basis @ np.linalg.solve(A + noise * np.eye(len(A)), right)

    def predictor(self, data: TrainingSet, noise: float) -> Callable[[Array], Array]:
        weights = self.sparse_weights(data, noise)
        return lambda z: activations(z, self.points, self.width) @ weights

"""What every kind of corrective function is trained on, and what training returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array, IntArray
from dfsm.models.corrective import Corrective
from dfsm.numerics.sampling import maxmin
from dfsm.numerics.time_mesh import std_over

# Cross-validation and iterative training see at most this many samples, evenly thinned.
SEARCH_SAMPLES = 12_000
# Samples that `TrainingSet.spread` chooses from, per sample that it keeps.
_CANDIDATES = 3


@dataclass(frozen=True)
class CorrectiveFit:
    """A trained corrective function and what cross-validation says about it.

    Attributes
    ----------
    function
        Maps an input vector to the corrections of the targets it was trained on.
    explained
        Share of each target's residual variance that it explains on runs left out of training,
        shape ``(target,)``; at or below zero it does not generalise.
    detail
        What was chosen, in words.
    """

    function: Corrective
    explained: Array
    detail: str


@dataclass(frozen=True)
class TrainingSet:
    """Standardised samples: what every kind of corrective function is trained on.

    Attributes
    ----------
    z
        Standardised inputs, shape ``(sample, input)``.
    targets
        Residuals scaled to unit variance, shape ``(sample, target)``.
    runs
        Run of each sample, shape ``(sample,)``.
    folds
        Cross-validation fold of each sample, shape ``(sample,)``; a run is never split over two
        folds unless there are fewer than two runs.
    shift, scale, target_scale
        The standardisation.
    """

    z: Array
    targets: Array
    runs: IntArray
    folds: IntArray
    shift: Array
    scale: Array
    target_scale: Array

    @classmethod
    def build(cls, inputs: Array, targets: Array, runs: IntArray) -> TrainingSet:
        """Standardise samples; `runs` holds the run index of each, shape ``(sample,)``."""
        shift, scale = inputs.mean(0), std_over(inputs, None)
        scale = np.where(scale > 1e-12 * np.maximum(np.abs(shift), 1e-300), scale, 1.0)
        target_scale = np.maximum(std_over(targets, None), np.finfo(float).tiny)
        n_runs = int(runs.max()) + 1
        if n_runs > 1:
            folds = (runs * min(4, n_runs)) // n_runs
        else:
            folds = (np.arange(len(inputs)) * 4) // len(inputs)
        z = inputs - shift
        z /= scale
        return cls(
            z,
            targets / target_scale,
            runs,
            folds,
            shift,
            scale,
            target_scale,
        )

    def thinned(self, size: int) -> TrainingSet:
        """Keep every k-th sample so that at most `size` remain."""
        k = max(1, -(-len(self.z) // size))
        return self.subset(np.arange(0, len(self.z), k))

    def spread(self, size: int, seed: int) -> TrainingSet:
        """Keep at most `size` samples that cover the inputs evenly, rare ones as well as common.

        Max-min points of a thinned copy (Johnson et al. 1990): where a run passes slowly or often
        its samples are near copies, and what is rare decides how far a network can be trusted.
        """
        some = self.thinned(_CANDIDATES * size)
        if len(some.z) <= size:
            return some
        return some.subset(np.sort(maxmin(some.z, size, np.random.default_rng(seed))))

    @property
    def typical_distance(self) -> float:
        """Root-mean-square distance between two samples drawn at random."""
        return float(np.sqrt(2 * np.sum(std_over(self.z, None) ** 2)))

    def stretched(self, lengths: Array) -> TrainingSet:
        """Measure every input in a length of its own, shape ``(input,)``."""
        return replace(self, z=self.z / lengths, scale=self.scale * lengths)

    def subset(self, keep: NDArray[np.bool_] | IntArray) -> TrainingSet:
        """Keep some samples under the same standardisation."""
        kept = {name: getattr(self, name)[keep] for name in ("z", "targets", "runs", "folds")}
        return replace(self, **kept)


class CorrectiveKind(Protocol):
    """Settings of one kind of corrective function, which know how it is trained."""

    @property
    def kind(self) -> str:
        """What configuration files call it."""
        ...

    def train(self, data: TrainingSet, seed: int) -> CorrectiveFit | None:
        """Train on samples; None where nothing is to be corrected.

        Parameters
        ----------
        data
            Standardised; the function that comes out takes and gives physical units.
        seed
            Of everything random.

        Raises
        ------
        DfsmError
            The samples do not suffice.
        """
        ...


def cross_validated(
    data: TrainingSet, train: Callable[[TrainingSet], Callable[[Array], Array]]
) -> Array:
    """Share of each target's variance explained on folds left out of training.

    Parameters
    ----------
    data
        All samples; a thinned copy is used.
    train
        Maps a training set to a function from ``(sample, input)`` to ``(sample, target)``.

    Returns
    -------
    ndarray
        Shape ``(target,)``; at most 1.
    """
    data = data.thinned(SEARCH_SAMPLES)
    squared, total = np.zeros(data.targets.shape[1]), np.zeros(data.targets.shape[1])
    for k in np.unique(data.folds):
        rest, held = data.subset(data.folds != k), data.subset(data.folds == k)
        squared += ((held.targets - train(rest)(held.z)) ** 2).sum(0)
        total += ((held.targets - rest.targets.mean(0)) ** 2).sum(0)
    return 1 - squared / total

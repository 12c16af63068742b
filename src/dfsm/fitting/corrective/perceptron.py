"""Multi-layer perceptron trained by Levenberg-Marquardt."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice, pairwise
from typing import Literal

import numpy as np

from dfsm.core.host import from_host
from dfsm.core.progress import track
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array, IntArray
from dfsm.fitting.corrective.network import NetworkError, Sizes, evaluate, layers
from dfsm.fitting.corrective.training import SEARCH_SAMPLES, CorrectiveFit, TrainingSet
from dfsm.models.corrective import Perceptron
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Step

# Damping at first: little, so that a start shows soon where it leads.
_FIRST_DAMPING = 1e-2
# Steps without progress on the held-out runs after which training stops.
_PATIENCE = 20
# Random starts, and steps that each gets to show where it leads.
_STARTS, _TRIAL = 4, 20
# Of the steps taken on three quarters of the runs, this share again on all of them.
_POLISH = 0.5


@settings_class
class MLP:
    """Multi-layer perceptron with tanh units, trained by Levenberg-Marquardt.

    Attributes
    ----------
    hidden
        Units per hidden layer.
    iterations
        Largest number of training steps; training stops earlier when the held-out quarter of
        the runs no longer improves. Half as many steps on all runs follow.
    weight_decay
        Penalty on the squared weights, per sample of standardised targets.
    samples
        Samples used for training, spread over the inputs: neighbours in time are near copies.
    """

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[int, ...] = (20, 20)
    iterations: int = 120
    weight_decay: float = 1e-8
    samples: int = 8000

    def __post_init__(self) -> None:
        wide = all(n >= 1 for n in self.hidden)
        require(wide, "corrective.hidden", list(self.hidden), "at least 1 unit per layer")
        require(self.iterations >= 1, "corrective.iterations", self.iterations, "at least 1")
        require(self.weight_decay >= 0, "corrective.weight_decay", self.weight_decay, "0 or more")
        require(self.samples >= 1, "corrective.samples", self.samples, "at least 1")

    def train(self, data: TrainingSet, seed: int) -> CorrectiveFit:
        """Train a perceptron; the last fold of the runs decides when to stop."""
        return _train(data, self, seed)


def _train(data: TrainingSet, settings: MLP, seed: int) -> CorrectiveFit:
    last = data.folds == data.folds.max()
    held = data.subset(last).thinned(SEARCH_SAMPLES)
    train = data.subset(~last).spread(settings.samples, seed)
    sizes = (data.z.shape[1], *settings.hidden, data.targets.shape[1])

    def squares(w: Array) -> Array:
        predicted = evaluate(from_host(w), from_host(held.z), sizes)
        return (np.asarray(predicted) - held.targets) ** 2

    def typical(step: Step) -> float:
        return _typical(squares(step.weights), held.runs)

    before, best = _promising(sizes, train, settings, seed, typical)
    error, taken = typical(best), 0
    for count, step in _steps(sizes, best, train, settings, settings.iterations):
        now = typical(step)
        if now < error:
            best, error, taken = step, now, count
        elif count - taken >= _PATIENCE:
            break
    final, everything = best, data.spread(settings.samples, seed)
    for _, step in _steps(sizes, best, everything, settings, round(_POLISH * taken)):
        final = step
    *hidden, last_layer = layers(np.asarray(final.weights), sizes)
    matrices = (*hidden, last_layer * np.asarray(data.target_scale)[:, None])
    function = Perceptron(
        shift=from_host(data.shift),
        scale=from_host(data.scale),
        weights=tuple(from_host(M[:, :-1]) for M in matrices),
        biases=tuple(from_host(M[:, -1]) for M in matrices),
    )
    return CorrectiveFit(
        function=function,
        explained=1 - squares(best.weights).mean(0) / held.targets.var(0),
        detail=f"{'-'.join(map(str, sizes))} tanh network, {before + taken} training steps",
    )


def _promising(
    sizes: Sizes, train: TrainingSet, settings: MLP, seed: int, error: Callable[[Step], float]
) -> tuple[int, Step]:
    """Best of a few random starts after a few steps each, some lead nowhere; and how many."""
    found: list[tuple[float, int, int, Step]] = []
    for k in range(_STARTS):
        start = Step(_start(sizes, seed * _STARTS + k), _FIRST_DAMPING)
        found.append((error(start), len(found), 0, start))
        for count, step in _steps(sizes, start, train, settings, min(_TRIAL, settings.iterations)):
            found.append((error(step), len(found), count, step))
    return min(found)[2:]


def _typical(squares: Array, runs: IntArray) -> float:
    """Geometric mean over runs of their mean squares: one run out of reach does not decide."""
    means = [squares[runs == run].mean() for run in np.unique(runs)]
    return float(np.exp(np.mean(np.log(np.maximum(means, np.finfo(float).tiny)))))


def _start(sizes: Sizes, seed: int) -> Array:
    """Random hidden layers under an output of zero: the first step is a linear fit to them."""
    rng = np.random.default_rng(seed)
    hidden = [
        np.column_stack([rng.normal(size=(o, i)) / np.sqrt(i), rng.normal(0, 0.5, o)]).ravel()
        for i, o in pairwise(sizes[:-1])
    ]
    return np.concatenate([*hidden, np.zeros(sizes[-1] * (sizes[-2] + 1))])


def _steps(
    sizes: Sizes, start: Step, data: TrainingSet, settings: MLP, limit: int
) -> Iterator[tuple[int, Step]]:
    """At most `limit` training steps, counted from 1, with a progress bar."""
    problem = NetworkError.of(sizes, data.z, data.targets)
    # Measured: fixed factors end in minima that hold better between the samples.
    penalty = settings.weight_decay * len(data.z)
    steps = LevenbergMarquardt(problem, start, penalty, fixed=True)
    yield from enumerate(track(islice(steps, limit), "training", limit), start=1)

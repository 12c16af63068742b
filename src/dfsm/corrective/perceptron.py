"""Multi-layer perceptron trained by Levenberg-Marquardt."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, pairwise
from typing import Literal

import jax.numpy as jnp
import numpy as np

from dfsm.corrective.functions import Perceptron
from dfsm.corrective.levenberg_marquardt import Step, levenberg_marquardt
from dfsm.corrective.network import NetworkError, Sizes, evaluate, layers
from dfsm.corrective.training import CorrectiveFit, TrainingSet
from dfsm.progress import track
from dfsm.settings import require, settings
from dfsm.types import Array

# Steps without progress on the held-out runs after which training stops.
_PATIENCE = 10
# Of the steps taken on three quarters of the runs, this share again on all of them.
_POLISH = 0.5


@settings
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
        Samples used for training, evenly thinned: neighbours in time are near copies.
    """

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[int, ...] = (20, 20)
    iterations: int = 60
    weight_decay: float = 1e-8
    samples: int = 8000

    def __post_init__(self) -> None:
        wide = all(n >= 1 for n in self.hidden)
        require(wide, "corrective.hidden", list(self.hidden), "at least 1 unit per layer")
        require(self.iterations >= 1, "corrective.iterations", self.iterations, "at least 1")
        require(self.weight_decay >= 0, "corrective.weight_decay", self.weight_decay, "0 or more")
        require(self.samples >= 1, "corrective.samples", self.samples, "at least 1")


def fit_mlp(data: TrainingSet, choice: MLP, seed: int) -> CorrectiveFit:
    """Train a perceptron; the last fold of the runs decides when to stop."""
    data = data.thinned(choice.samples)
    last = data.folds == data.folds.max()
    train, held = data.subset(~last), data.subset(last)
    sizes = (data.z.shape[1], *choice.hidden, data.targets.shape[1])

    def held_error(w: Array) -> Array:
        predicted = evaluate(jnp.asarray(w), jnp.asarray(held.z), sizes)
        return np.mean((np.asarray(predicted) - held.targets) ** 2, axis=0)

    best, taken = Step(_start(sizes, seed)), 0
    error = held_error(best.weights)
    for count, step in _steps(sizes, best, train, choice, choice.iterations):
        now = held_error(step.weights)
        if now.sum() < error.sum():
            best, error, taken = step, now, count
        elif count - taken >= _PATIENCE:
            break
    final = best
    for _, step in _steps(sizes, best, data, choice, round(_POLISH * taken)):
        final = step
    *hidden, last_layer = layers(jnp.asarray(final.weights), sizes)
    matrices = (*hidden, last_layer * jnp.asarray(data.target_scale)[:, None])
    function = Perceptron(
        shift=jnp.asarray(data.shift),
        scale=jnp.asarray(data.scale),
        weights=tuple(M[:, :-1] for M in matrices),
        biases=tuple(M[:, -1] for M in matrices),
    )
    return CorrectiveFit(
        function=function,
        explained=1 - error / ((held.targets - train.targets.mean(0)) ** 2).mean(0),
        detail=f"{'-'.join(map(str, sizes))} tanh network, {taken} training steps",
    )


def _start(sizes: Sizes, seed: int) -> Array:
    """Random hidden layers under an output of zero: the first step is a linear fit to them."""
    rng = np.random.default_rng(seed)
    hidden = [
        np.column_stack([rng.normal(size=(o, i)) / np.sqrt(i), rng.normal(0, 0.5, o)]).ravel()
        for i, o in pairwise(sizes[:-1])
    ]
    return np.concatenate([*hidden, np.zeros(sizes[-1] * (sizes[-2] + 1))])


def _steps(
    sizes: Sizes, start: Step, data: TrainingSet, choice: MLP, limit: int
) -> Iterator[tuple[int, Step]]:
    """At most `limit` training steps, counted from 1, with a progress bar."""
    problem = NetworkError.of(sizes, data.z, data.targets)
    steps = levenberg_marquardt(problem, start, choice.weight_decay * len(data.z))
    yield from enumerate(track(islice(steps, limit), "training", limit), start=1)

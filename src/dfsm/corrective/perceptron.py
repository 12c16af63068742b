"""Multi-layer perceptron trained with exact gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import OptimizeResult, minimize

from dfsm.corrective.functions import Perceptron
from dfsm.corrective.training import SEARCH_SAMPLES, CorrectiveFit, TrainingSet
from dfsm.settings import require, settings
from dfsm.types import Array

Layers = tuple[tuple[jax.Array, jax.Array], ...]

# Iterations without progress on the held-out runs after which training stops.
_PATIENCE = 40


@settings
class MLP:
    """Multi-layer perceptron with tanh units, trained by L-BFGS with exact gradients.

    Attributes
    ----------
    hidden
        Units per hidden layer.
    iterations
        Largest number of L-BFGS iterations; training stops earlier when the held-out quarter of
        the runs no longer improves.
    weight_decay
        Penalty on the mean square of the weights.
    """

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[int, ...] = (24, 24)
    iterations: int = 300
    weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        wide = all(n >= 1 for n in self.hidden)
        require(wide, "corrective.hidden", list(self.hidden), "at least 1 unit per layer")
        require(self.iterations >= 1, "corrective.iterations", self.iterations, "at least 1")
        require(self.weight_decay >= 0, "corrective.weight_decay", self.weight_decay, "0 or more")


def fit_mlp(data: TrainingSet, choice: MLP, seed: int) -> CorrectiveFit:
    """Train a perceptron; the last fold of the runs decides when to stop."""
    search = data.thinned(SEARCH_SAMPLES)
    last = search.folds == search.folds.max()
    train, held = search.subset(~last), search.subset(last)
    sizes = (data.z.shape[1], *choice.hidden, data.targets.shape[1])
    layers, iterations = _train(train, held, sizes, choice, seed)
    predicted = np.asarray(_forward(layers, jnp.asarray(held.z)))
    total = ((held.targets - train.targets.mean(0)) ** 2).sum(0)
    scale = jnp.asarray(data.target_scale)
    W, b = layers[-1]
    layers = (*layers[:-1], (W * scale[:, None], b * scale))
    function = Perceptron(
        shift=jnp.asarray(data.shift),
        scale=jnp.asarray(data.scale),
        weights=tuple(W for W, _ in layers),
        biases=tuple(b for _, b in layers),
    )
    return CorrectiveFit(
        function=function,
        explained=1 - ((held.targets - predicted) ** 2).sum(0) / total,
        detail=f"{'-'.join(map(str, sizes))} tanh network, {iterations} L-BFGS iterations",
    )


def _forward(layers: Layers, z: jax.Array) -> jax.Array:
    for W, b in layers[:-1]:
        z = jnp.tanh(z @ W.T + b)
    W, b = layers[-1]
    return z @ W.T + b


def _train(
    train: TrainingSet, held: TrainingSet, sizes: Sequence[int], choice: MLP, seed: int
) -> tuple[Layers, int]:
    """Layers with the lowest error on `held`, and the iteration that gave them."""
    z, y = jnp.asarray(train.z), jnp.asarray(train.targets)
    keys = jax.random.split(jax.random.key(seed), len(sizes) - 1)
    start = tuple(
        (jax.random.normal(k, (o, i)) / np.sqrt(i), jnp.zeros(o))
        for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )
    flat, unravel = ravel_pytree(start)

    @jax.jit
    @jax.value_and_grad
    def loss(flat: jax.Array) -> jax.Array:
        layers = unravel(flat)
        penalty = sum(jnp.sum(W**2) for W, _ in layers) / flat.size
        return jnp.mean((_forward(layers, z) - y) ** 2) + choice.weight_decay * penalty

    @jax.jit
    def held_error(flat: jax.Array, z: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.mean((_forward(unravel(flat), z) - y) ** 2)

    best, count = (np.inf, flat, 0), 0

    def objective(x: Array) -> tuple[float, Array]:
        value, slope = loss(jnp.asarray(x))
        return float(value), np.asarray(slope)

    def watch(intermediate_result: OptimizeResult) -> None:
        nonlocal best, count
        count += 1
        x = jnp.asarray(intermediate_result.x)
        error = float(held_error(x, jnp.asarray(held.z), jnp.asarray(held.targets)))
        if error < best[0]:
            best = (error, x, count)
        elif count - best[2] > _PATIENCE:
            raise StopIteration

    options = {"maxiter": choice.iterations, "maxcor": 30}
    minimize(
        objective, np.asarray(flat), jac=True, method="L-BFGS-B", callback=watch, options=options
    )
    return unravel(best[1]), best[2]

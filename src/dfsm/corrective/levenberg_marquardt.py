"""Levenberg-Marquardt for small networks: far fewer iterations, and far lower errors, than L-BFGS.

Each step solves ``(JᵀJ + (μ + λ N) 1) Δ = -(Jᵀr + λ N w)`` for the weights w (Levenberg 1944,
Marquardt 1963; for networks Hagan & Menhaj 1994). The sums over samples are taken block by block,
so the Jacobian is never held as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from dfsm.types import Array

_BLOCK = 1000
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-8, 1e12
_LESS, _MORE = 1 / 3, 4.0

# Weights (weight,) and one input vector (input,) to the outputs (target,).
Network = Callable[[jax.Array, jax.Array], jax.Array]


@dataclass(frozen=True)
class Step:
    """Weights after an accepted step, shape ``(weight,)``, and the damping μ for the next."""

    weights: Array
    damping: float = _FIRST_DAMPING


def levenberg_marquardt(
    network: Network,
    start: Step,
    z: Array,
    targets: Array,
    decay: float,
) -> Iterator[Step]:
    """Minimise ``Σ |network(w, z) - target|² + λ N |w|²`` step by step, until the caller stops.

    Parameters
    ----------
    network
        The function to fit.
    start
        Weights and damping to start with.
    z, targets
        Samples, shapes ``(sample, input)`` and ``(sample, target)``.
    decay
        λ, the penalty on the squared weights per sample.

    Yields
    ------
    Step
        Every accepted step; the error never grows. Ends where no step lowers the error.
    """
    normal_equations, cost = _sums(network, z, targets)
    penalty = decay * len(z)
    w, damping = start.weights, start.damping
    here = float(cost(jnp.asarray(w))) + penalty * float(w @ w)
    while True:
        JtJ, Jtr = map(np.asarray, normal_equations(jnp.asarray(w)))
        slope = Jtr + penalty * w
        trial, there = w, np.inf
        while not there < here:
            if damping > _MOST_DAMPING:
                return
            try:
                factor = cho_factor(JtJ + (damping + penalty) * np.eye(len(w)), overwrite_a=True)
                trial = w - cho_solve(factor, slope)
                there = float(cost(jnp.asarray(trial))) + penalty * float(trial @ trial)
            except LinAlgError:
                pass
            if not there < here:
                damping *= _MORE
        w, here = trial, there
        damping = max(damping * _LESS, _LEAST_DAMPING)
        yield Step(w, damping)


def _sums(
    network: Network, z: Array, targets: Array
) -> tuple[Callable[[jax.Array], tuple[jax.Array, jax.Array]], Callable[[jax.Array], jax.Array]]:
    """Functions of the weights: JᵀJ with Jᵀr, and |r|²."""
    blocks = -(-len(z) // _BLOCK)
    rows = np.arange(blocks * _BLOCK)
    # The last block is filled up with samples that do not count.
    counts = jnp.asarray((rows < len(z)).astype(float)).reshape(blocks, _BLOCK)
    rows = np.minimum(rows, len(z) - 1)
    zs = jnp.asarray(z)[rows].reshape(blocks, _BLOCK, -1)
    ys = jnp.asarray(targets)[rows].reshape(blocks, _BLOCK, -1)
    many = jax.vmap(network, (None, 0))
    slopes = jax.vmap(jax.jacrev(network), (None, 0))

    @jax.jit
    def normal_equations(w: jax.Array) -> tuple[jax.Array, jax.Array]:
        def add(
            sums: tuple[jax.Array, jax.Array], block: tuple[jax.Array, ...]
        ) -> tuple[tuple[jax.Array, jax.Array], None]:
            zb, yb, count = block
            J = (slopes(w, zb) * count[:, None, None]).reshape(-1, len(w))
            r = (many(w, zb) - yb).ravel()
            return (sums[0] + J.T @ J, sums[1] + J.T @ r), None

        zero = jnp.zeros((len(w), len(w))), jnp.zeros(len(w))
        return jax.lax.scan(add, zero, (zs, ys, counts))[0]

    @jax.jit
    def cost(w: jax.Array) -> jax.Array:
        def one(block: tuple[jax.Array, ...]) -> jax.Array:
            zb, yb, count = block
            return jnp.sum((many(w, zb) - yb) ** 2 * count[:, None])

        return jnp.sum(jax.lax.map(one, (zs, ys, counts)))

    return normal_equations, cost

"""A tanh network's weights as one vector, and the normal equations of fitting it to samples.

Each layer is a matrix ``[W b]``, shape ``(out, in + 1)``, that acts on ``[a, 1]``; the vector holds
them row by row. The slope of output k in the weights of a layer is an outer product of what comes
from the outputs and what comes from the inputs, ``δ_k aᵀ`` (backpropagation), so for two layers

    JᵀJ = Σ_n Σ_k (δ_k aᵀ) ⊗ (δ'_k a'ᵀ) = Σ_n (Σ_k δ_k δ'_kᵀ) ⊗ (a a'ᵀ)

is one product of two matrices with a row per sample. The Jacobian itself is never formed, and the
work does not grow with the number of outputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray

_BLOCK = 1000

Sizes = tuple[int, ...]
# Of the host or of JAX.
Numbers = TypeVar("Numbers", bound=Any)


@partial(jax.jit, static_argnames="sizes")
def evaluate(weights: jax.Array, z: jax.Array, sizes: Sizes) -> jax.Array:
    """Outputs of a network, ``(sample, input)`` to ``(sample, output)``.

    Parameters
    ----------
    weights
        Shape ``(weight,)``.
    z
        Samples.
    sizes
        Inputs, units per hidden layer, outputs.
    """
    *hidden, last = layers(weights, sizes)
    for W in hidden:
        z = jnp.tanh(_extended(z) @ W.T)
    return _extended(z) @ last.T


def layers(weights: Numbers, sizes: Sizes) -> list[Numbers]:
    """Matrices ``[W b]`` of the layers, shapes ``(out, in + 1)``."""
    matrices, at = [], 0
    for i, o in pairwise(sizes):
        matrices.append(weights[at : at + o * (i + 1)].reshape(o, i + 1))
        at += o * (i + 1)
    return matrices


@dataclass(frozen=True)
class NetworkError:
    """Squared error of a network over samples, as a function of its weights.

    Attributes
    ----------
    sizes
        Inputs, units per hidden layer, outputs.
    z, targets, counts
        Samples in blocks, shapes ``(block, sample, n)`` and ``(block, sample)``; those that fill up
        the last block count zero.
    """

    sizes: Sizes
    z: jax.Array
    targets: jax.Array
    counts: jax.Array

    @classmethod
    def of(cls, sizes: Sizes, z: Array, targets: Array) -> NetworkError:
        """Put samples ``(sample, input)`` and ``(sample, target)`` into blocks."""
        blocks = -(-len(z) // _BLOCK)
        rows = np.arange(blocks * _BLOCK)
        counts = (rows < len(z)).astype(float).reshape(blocks, _BLOCK)
        rows = np.minimum(rows, len(z) - 1)
        zs, ys = (np.asarray(a)[rows].reshape(blocks, _BLOCK, -1) for a in (z, targets))
        return cls(sizes, from_host(zs), from_host(ys), from_host(counts))

    def cost(self, weights: Array) -> float:
        """Sum of the squared residuals r."""
        samples = self.z, self.targets, self.counts
        return float(_cost(from_host(weights), samples, self.sizes))

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ and Jᵀr, shapes ``(weight, weight)`` and ``(weight,)``, with J = dr/dw."""
        samples = self.z, self.targets, self.counts
        JtJ, Jtr = _normal_equations(from_host(weights), samples, self.sizes)
        return np.asarray(JtJ), np.asarray(Jtr)


_Samples = tuple[jax.Array, jax.Array, jax.Array]


@partial(jax.jit, static_argnames="sizes")
def _cost(weights: jax.Array, samples: _Samples, sizes: Sizes) -> jax.Array:
    def one(block: _Samples) -> jax.Array:
        z, targets, count = block
        return jnp.sum((evaluate(weights, z, sizes) - targets) ** 2 * count[:, None])

    return jnp.sum(jax.lax.map(one, samples))


@partial(jax.jit, static_argnames="sizes")
def _normal_equations(
    weights: jax.Array, samples: _Samples, sizes: Sizes
) -> tuple[jax.Array, jax.Array]:
    matrices = layers(weights, sizes)
    pairs = [(k, m) for k in range(len(matrices)) for m in range(k, len(matrices))]

    def sums(block: _Samples) -> tuple[list[jax.Array], jax.Array]:
        z, targets, count = block
        arriving = [_extended(z)]
        for W in matrices[:-1]:
            arriving.append(_extended(jnp.tanh(arriving[-1] @ W.T)))
        # The outputs are linear in the last layer; from there the slopes go back to the first.
        residuals = (arriving[-1] @ matrices[-1].T - targets) * count[:, None]
        outputs = sizes[-1]
        slopes = [jnp.eye(outputs) * count[:, None, None]]
        for W, a in zip(matrices[:0:-1], arriving[:0:-1], strict=True):
            slopes.insert(0, (slopes[0] @ W[:, :-1]) * (1 - a[:, None, :-1] ** 2))
        gradient = [
            jnp.einsum("nk,nko,ni->oi", residuals, d, a).ravel()
            for d, a in zip(slopes, arriving, strict=True)
        ]
        return [_products(slopes, arriving, *pair) for pair in pairs], jnp.concatenate(gradient)

    def add(
        total: tuple[list[jax.Array], jax.Array], block: _Samples
    ) -> tuple[tuple[list[jax.Array], jax.Array], None]:
        return jax.tree.map(jnp.add, total, sums(block)), None

    shapes = jax.eval_shape(sums, tuple(part[0] for part in samples))
    zero = jax.tree.map(lambda s: jnp.zeros(s.shape), shapes)
    (products, Jtr), _ = jax.lax.scan(add, zero, samples)
    blocks = {(k, m): _unfolded(s, sizes, k, m) for (k, m), s in zip(pairs, products, strict=True)}
    order = range(len(matrices))
    JtJ = jnp.block([[blocks[k, m] if k <= m else blocks[m, k].T for m in order] for k in order])
    return JtJ, Jtr


def _products(slopes: list[jax.Array], arriving: list[jax.Array], k: int, m: int) -> jax.Array:
    """The sum over samples for two layers; for a layer with itself, upper halves only."""
    D = jnp.einsum("nko,nkp->nop", slopes[k], slopes[m])
    A = arriving[k][:, :, None] * arriving[m][:, None, :]
    if k == m:
        return D[:, *np.triu_indices(D.shape[1])].T @ A[:, *np.triu_indices(A.shape[1])]
    return D.reshape(len(D), -1).T @ A.reshape(len(A), -1)


def _unfolded(products: jax.Array, sizes: Sizes, k: int, m: int) -> jax.Array:
    """The block of JᵀJ from `_products`, shape ``(weight of layer k, weight of layer m)``."""
    o, i, p, j = sizes[k + 1], sizes[k] + 1, sizes[m + 1], sizes[m] + 1
    if k == m:
        products = products[_places(o)][:, _places(i)]
    return products.reshape(o, p, i, j).transpose(0, 2, 1, 3).reshape(o * i, p * j)


def _places(n: int) -> IntArray:
    """Where the elements of a symmetric matrix stand in its upper half, row by row."""
    places = np.zeros((n, n), dtype=np.int64)
    places[np.triu_indices(n)] = np.arange(n * (n + 1) // 2)
    return np.maximum(places, places.T).ravel()


def _extended(a: jax.Array) -> jax.Array:
    return jnp.concatenate([a, jnp.ones((*a.shape[:-1], 1))], axis=-1)

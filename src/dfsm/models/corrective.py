"""The two forms that every corrective function takes when it is evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401


class GaussianUnits(eqx.Module):
    """Σ_i w_i exp(-|z - c_i|²) + bias, with ``z = (I - shift) / scale`` (Eq. 8).

    Attributes
    ----------
    shift, scale
        Per input, shape ``(input,)``; the scale holds the width of the units.
    centres
        In z, shape ``(input, unit)``: units last, so that a simulation reads them in one run.
    weights, bias
        In the unit of the target, shapes ``(target, unit)`` and ``(target,)``.
    """

    shift: jax.Array
    scale: jax.Array
    centres: jax.Array
    weights: jax.Array
    bias: jax.Array

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        return self.prepared()(inputs)

    def prepared(self) -> ProductForm:
        """The same function in the form that is fastest to evaluate again and again."""
        norms = jnp.sum(self.centres**2, axis=0)
        matrix = jnp.concatenate([2 * self.centres, -norms[None], -jnp.ones_like(norms)[None]])
        return ProductForm(self.shift, self.scale, matrix, self.weights, self.bias)

    def select(self, rows: Sequence[int]) -> GaussianUnits:
        """Keep some of the targets."""
        keep = np.array(rows)
        return GaussianUnits(
            self.shift, self.scale, self.centres, self.weights[keep], self.bias[keep]
        )


class ProductForm(eqx.Module):
    """Gaussian units with -|z - c|² multiplied out, ``[z, 1, |z|²] @ [2c; -|c|²; -1]``.

    Attributes
    ----------
    shift, scale, weights, bias
        As for `GaussianUnits`.
    matrix
        The right factor, shape ``(input + 2, unit)``.
    """

    shift: jax.Array
    scale: jax.Array
    matrix: jax.Array
    weights: jax.Array
    bias: jax.Array

    def prepared(self) -> ProductForm:
        """Itself."""
        return self

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        z = (inputs - self.shift) / self.scale
        exponents = jnp.concatenate([z, jnp.ones(1), jnp.sum(z**2)[None]]) @ self.matrix
        return self.weights @ jnp.exp(exponents) + self.bias


class Perceptron(eqx.Module):
    """Fully connected tanh network on standardised inputs, linear output layer.

    Attributes
    ----------
    shift, scale
        Per input, shape ``(input,)``.
    weights, biases
        Per layer, shapes ``(out, in)`` and ``(out,)``; the last layer is in the target's unit.
    """

    shift: jax.Array
    scale: jax.Array
    weights: tuple[jax.Array, ...]
    biases: tuple[jax.Array, ...]

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        z = (inputs - self.shift) / self.scale
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            z = jnp.tanh(W @ z + b)
        return self.weights[-1] @ z + self.biases[-1]

    def prepared(self) -> Perceptron:
        """Itself: there is nothing to compute beforehand."""
        return self

    def select(self, rows: Sequence[int]) -> Perceptron:
        """Keep some of the targets."""
        keep = np.array(rows)
        return Perceptron(
            self.shift,
            self.scale,
            (*self.weights[:-1], self.weights[-1][keep]),
            (*self.biases[:-1], self.biases[-1][keep]),
        )


Corrective = GaussianUnits | Perceptron


def ignoring(function: Corrective, columns: Sequence[int]) -> Corrective:
    """The function with some inputs held at the middle of their range, whatever they are."""
    return replace(function, scale=function.scale.at[np.array(columns, dtype=int)].set(jnp.inf))

"""The two forms that every corrective function takes when it is evaluated."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.precision  # noqa: F401


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
        z = (inputs - self.shift) / self.scale
        # |z - c|² multiplied out: one product instead of a loop over all differences.
        squared = jnp.sum(self.centres**2, axis=0) + z @ z - 2 * (z @ self.centres)
        return self.weights @ jnp.exp(-squared) + self.bias

    def select(self, rows: Sequence[int]) -> GaussianUnits:
        """Keep some of the targets."""
        keep = np.array(rows)
        return GaussianUnits(
            self.shift, self.scale, self.centres, self.weights[keep], self.bias[keep]
        )


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

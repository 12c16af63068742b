"""Multi-layer perceptrons, and the networks that refinement adds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.models.corrective.form import Corrective


class Perceptron(Corrective):
    """Fully connected tanh network on standardised inputs, linear output layer.

    Attributes
    ----------
    shift, scale
        Per input, shape ``(input,)``.
    weights, biases
        Per layer, shapes ``(out, in)`` and ``(out,)``; the last layer is in the target's unit.
    """

    kind = "perceptron"
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
        last = (from_host(np.asarray(a[-1])[np.array(rows)]) for a in (self.weights, self.biases))
        weights, biases = last
        return replace(
            self, weights=(*self.weights[:-1], weights), biases=(*self.biases[:-1], biases)
        )

    def with_more_inputs(self, at: int, count: int) -> Perceptron:
        """The same function of more inputs: the first layer gives them no weight."""
        place = np.full(count, at)
        first, *others = self.weights
        return replace(
            self,
            shift=from_host(np.insert(self.shift, place, 0.0)),
            scale=from_host(np.insert(self.scale, place, 1.0)),
            weights=(from_host(np.insert(first, place, 0.0, axis=1)), *others),
        )

    @property
    def parameters(self) -> tuple[jax.Array, ...]:
        """Weights of all layers, then their biases."""
        return (*self.weights, *self.biases)

    def moved(self, deviations: Sequence[jax.Array], spread: jax.Array) -> Perceptron:
        """The function with other weights and biases."""
        n = len(self.weights)
        weights = [*deviations[: n - 1], spread[:, None] * deviations[n - 1]]
        biases = [*deviations[n:-1], spread * deviations[-1]]
        return replace(
            self,
            weights=tuple(a + b for a, b in zip(self.weights, weights, strict=True)),
            biases=tuple(a + b for a, b in zip(self.biases, biases, strict=True)),
        )

    def structure(self) -> dict[str, Any]:
        """Kind and number of layers."""
        return {"kind": self.kind, "layers": len(self.weights)}

    def arrays(self) -> dict[str, jax.Array]:
        """``weights.0``, ``biases.0``, … by layer beside shift and scale."""
        named = {"shift": self.shift, "scale": self.scale}
        for i, (W, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            named |= {f"weights.{i}": W, f"biases.{i}": b}
        return named

    @classmethod
    def restored(cls, arrays: Mapping[str, jax.Array], structure: Mapping[str, Any]) -> Perceptron:
        """The network of which they came."""
        layers = range(structure["layers"])
        return cls(
            shift=arrays["shift"],
            scale=arrays["scale"],
            weights=tuple(arrays[f"weights.{i}"] for i in layers),
            biases=tuple(arrays[f"biases.{i}"] for i in layers),
        )

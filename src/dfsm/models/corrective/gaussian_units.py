"""Gaussian units: what RBF networks and Gaussian processes are evaluated as."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from dfsm.models.corrective.form import Corrective


class GaussianUnits(Corrective):
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

    kind = "gaussian_units"
    centres: jax.Array
    weights: jax.Array
    bias: jax.Array

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        return self.prepared()(inputs)

    def prepared(self) -> ProductForm:
        """The same function with the square of the distance multiplied out.

        Without the inputs that have no effect, where their scale is known: JAX may be tracing it.
        """
        norms = jnp.sum(self.centres**2, axis=0)
        spans, kept = _effective(self.scale)
        matrix = jnp.concatenate(
            [2 * self.centres[kept], -norms[None], -jnp.ones_like(norms)[None]]
        )
        return ProductForm(
            self.shift[kept], self.scale[kept], matrix, self.weights, self.bias, spans
        )

    def select(self, rows: Sequence[int]) -> GaussianUnits:
        """Keep some of the targets."""
        keep = np.array(rows)
        return replace(self, weights=self.weights[keep], bias=self.bias[keep])

    def with_more_inputs(self, at: int, count: int) -> GaussianUnits:
        """The same function of more inputs: its units are infinitely wide in their directions."""
        place = np.full(count, at)
        return replace(
            self,
            shift=jnp.insert(self.shift, place, 0.0),
            scale=jnp.insert(self.scale, place, jnp.inf),
            centres=jnp.insert(self.centres, place, 0.0, axis=0),
        )

    @property
    def parameters(self) -> tuple[jax.Array, ...]:
        """Weights and bias; the units stay where they are."""
        return self.weights, self.bias

    def moved(self, deviations: Sequence[jax.Array], spread: jax.Array) -> GaussianUnits:
        """The function with other weights and another bias."""
        weights, bias = deviations
        return replace(
            self,
            weights=self.weights + spread[:, None] * weights,
            bias=self.bias + spread * bias,
        )


class ProductForm(eqx.Module):
    """Gaussian units with -|z - c|² multiplied out, ``[z, 1, |z|²] @ [2c; -|c|²; -1]``.

    Attributes
    ----------
    shift, scale, weights, bias
        As for `GaussianUnits`, of the inputs that have an effect.
    matrix
        The right factor, shape ``(input + 2, unit)``.
    spans
        First of some inputs that have an effect and one past the last, span by span.
    """

    shift: jax.Array
    scale: jax.Array
    matrix: jax.Array
    weights: jax.Array
    bias: jax.Array
    spans: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def prepared(self) -> ProductForm:
        """Itself."""
        return self

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        # Slices put together; general indexing costs several times as much in a rollout.
        kept = jnp.concatenate([inputs[first:end] for first, end in self.spans])
        z = (kept - self.shift) / self.scale
        exponents = jnp.concatenate([z, jnp.ones(1), jnp.sum(z**2)[None]]) @ self.matrix
        return self.weights @ jnp.exp(exponents) + self.bias


def _effective(scale: jax.Array) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
    """Spans of the inputs that have an effect, and their columns; all where nobody can know."""
    count = scale.shape[0]
    if isinstance(scale, Tracer):
        return ((0, count),), np.arange(count)
    kept = np.flatnonzero(np.isfinite(np.asarray(scale)))
    if not len(kept):
        return ((0, 0),), kept
    parts = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
    return tuple((int(part[0]), int(part[-1]) + 1) for part in parts), kept

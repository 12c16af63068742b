"""Gaussian units: what RBF networks and Gaussian processes are evaluated as."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.models.corrective.form import Corrective
from dfsm.numerics.exponential import exp


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
        """The same function with the square of the distance multiplied out."""
        norms = jnp.sum(self.centres**2, axis=0)
        matrix = jnp.concatenate([2 * self.centres, -norms[None], -jnp.ones_like(norms)[None]])
        return ProductForm(self.shift, self.scale, matrix, self.weights, self.bias)

    def stripped(self) -> ProductForm:
        """The prepared function without the inputs that have no effect, as loops take it."""
        kept = np.flatnonzero(np.isfinite(np.asarray(self.scale)))
        parts = np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1)
        spans = tuple((int(part[0]), int(part[-1]) + 1) for part in parts if len(part))
        ready, count = self.prepared(), self.centres.shape[0]
        # Units keep their distance from the middle of the others' ranges.
        rows = np.array([*kept, count, count + 1])
        return replace(
            ready,
            shift=from_host(np.asarray(ready.shift)[kept]),
            scale=from_host(np.asarray(ready.scale)[kept]),
            matrix=from_host(np.asarray(ready.matrix)[rows]),
            spans=spans or ((0, 0),),
        )

    def select(self, rows: Sequence[int]) -> GaussianUnits:
        """Keep some of the targets."""
        weights, bias = (from_host(np.asarray(a)[np.array(rows)]) for a in self.parameters)
        return replace(self, weights=weights, bias=bias)

    def with_more_inputs(self, at: int, count: int) -> GaussianUnits:
        """The same function of more inputs: its units are infinitely wide in their directions."""
        place = np.full(count, at)
        return replace(
            self,
            shift=from_host(np.insert(self.shift, place, 0.0)),
            scale=from_host(np.insert(self.scale, place, np.inf)),
            centres=from_host(np.insert(self.centres, place, 0.0, axis=0)),
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
        First of some inputs that have an effect and one past the last, span by span; None for all.
    """

    shift: jax.Array
    scale: jax.Array
    matrix: jax.Array
    weights: jax.Array
    bias: jax.Array
    spans: tuple[tuple[int, int], ...] | None = eqx.field(static=True, default=None)

    def prepared(self) -> ProductForm:
        """Itself."""
        return self

    def stripped(self) -> ProductForm:
        """Itself."""
        return self

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        if self.spans is not None:
            # Slices put together; general indexing costs several times as much in a rollout.
            inputs = jnp.concatenate([inputs[first:end] for first, end in self.spans])
        z = (inputs - self.shift) / self.scale
        exponents = jnp.concatenate([z, jnp.ones(1), jnp.sum(z**2)[None]]) @ self.matrix
        powers = jnp.exp(exponents) if self.spans is None else exp(exponents)
        return self.weights @ powers + self.bias

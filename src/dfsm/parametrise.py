"""The numbers of a model that refinement may change, as one well-scaled vector.

The vector holds deviations from the model that it was made of, so zero is that model. Coefficients
are scaled by what their input and their row typically are: a unit deviation of any of them changes
a derivative by about its own spread.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.corrective.functions import Corrective, GaussianUnits, Perceptron
from dfsm.derivatives import kinematic_rows
from dfsm.latents import Poles, poles, with_poles
from dfsm.linear import LinearModel
from dfsm.model import DFSM
from dfsm.types import Array


class Parametrisation(eqx.Module):
    """Deviations from a model, and the model that they make.

    Coefficients that do not depend on the schedule stay so.

    Attributes
    ----------
    model
        The model at zero.
    rows
        Rows of the linear fit that are neither kinematic nor of latent states.
    spread
        Typical size of each of these derivatives, shape ``(row,)``, in its unit.
    scheduled, constant
        Input columns whose coefficients in these rows vary along the schedule, and the others.
    """

    model: DFSM
    spread: jax.Array
    rows: tuple[int, ...] = eqx.field(static=True)
    scheduled: tuple[int, ...] = eqx.field(static=True)
    constant: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, model: DFSM, spread: Array) -> Parametrisation:
        """Make one; `spread` holds the typical size of the observed states' derivatives."""
        s = model.signals
        known = kinematic_rows(s.specs)
        rows = tuple(i for i in range(len(s.observed)) if i not in known)
        L = np.asarray(model.f.coefficients)[:, list(rows)]
        varies = np.ptp(L, axis=0).any(axis=0) | (len(L) == 1)
        # Nothing is known yet about states that have only been added.
        varies[s.observed_columns.stop :] |= np.array(
            [c in s.latents for c in (*s.latents, *s.parameters)], dtype=bool
        )
        scheduled, constant = (tuple(np.flatnonzero(v).tolist()) for v in (varies, ~varies))
        typical = np.maximum(spread[list(rows)], np.finfo(float).tiny)
        return cls(model, jnp.asarray(typical), rows, scheduled, constant)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(int(np.prod(shape)) for shape in self._shapes)

    @property
    def latent_part(self) -> slice:
        """Where the parameters of the latent states' own dynamics lie in the vector."""
        sizes = [int(np.prod(shape)) for shape in self._shapes[:4]]
        return slice(sum(sizes[:2]), sum(sizes))

    @property
    def _shapes(self) -> list[tuple[int, ...]]:
        points, rows = len(self.model.f.grid), len(self.rows)
        pairs = len(self.model.signals.latents) // 2
        return [
            (points, rows, len(self.scheduled) + 1),
            (rows, len(self.constant)),
            (2, pairs),
            (2, pairs, len(self.model.signals.driving) + 1),
            *self._corrective_shapes,
        ]

    @property
    def _corrective_shapes(self) -> list[tuple[int, ...]]:
        e = self.model.e
        if isinstance(e, GaussianUnits):
            return [e.weights.shape, e.bias.shape]
        if isinstance(e, Perceptron):
            return [a.shape for a in (*e.weights, *e.biases)]
        return []

    def at(self, deviations: jax.Array) -> DFSM:
        """The model at some deviations, shape ``(parameter,)``; JAX can follow it."""
        scheduled, constant, dynamics, drive, *corrective = self._parts(deviations)
        model = replace(
            self.model, f=self._linear(scheduled, constant), e=self._corrective(corrective)
        )
        return self._latents(model, dynamics, drive) if self.model.signals.latents else model

    def slopes(self, deviations: jax.Array, model: DFSM, inputs: jax.Array) -> jax.Array:
        """∂f̂/∂θ at one input vector, ``(state, parameter)``.

        Written out because it is what refinement spends its time on; tracing `at` backwards gives
        the same several times slower.

        Parameters
        ----------
        deviations
            θ, shape ``(parameter,)``.
        model
            What `at` makes of them.
        inputs
            I, shape ``(input,)``.
        """
        s, region = self.model.signals, self.model.region
        states, n_uw = len(s.states), len(s.driving)
        std = jnp.where(region.std > 0, region.std, 1.0)
        z = (inputs - region.mean) / std
        line = jnp.zeros((states, len(self.rows)))
        line = line.at[list(self.rows), np.arange(len(self.rows))].set(self.spread)
        hats = model.f.shares(inputs)
        one = jnp.ones(1)
        parts = [
            jnp.einsum(
                "sr,k,j->skrj",
                line,
                hats,
                jnp.concatenate([z[np.array(self.scheduled, dtype=int)], one]),
            ),
            jnp.einsum("sr,j->srj", line, z[np.array(self.constant, dtype=int)]),
        ]
        if s.latents:
            now, start = poles(model), poles(self.model)
            first = len(s.observed)
            latent = inputs[n_uw + first : n_uw + states]
            a, b = latent[::2], latent[1::2]
            even = np.eye(states)[:, first::2]
            odd = np.eye(states)[:, first + 1 :: 2]
            decay = -now.decay * (even * a + odd * b)
            frequency = now.frequency * (even * b - odd * a)
            size = jnp.hypot(start.decay, start.frequency)
            moved = jnp.concatenate([z[:n_uw], one])
            drive = [jnp.einsum("sp,p,j->spj", row, size, moved) for row in (even, odd)]
            parts += [jnp.stack([decay, frequency], axis=1), jnp.stack(drive, axis=1)]
        if self._corrective_shapes:
            corrective = self._parts(deviations)[4:]
            by_part = jax.jacrev(lambda parts: self._correction(parts, inputs))(corrective)
            rows = np.eye(states)[:, list(self.model.corrected)]
            parts += [rows @ p.reshape(len(self.model.corrected), -1) for p in by_part]
        return jnp.concatenate([p.reshape(states, -1) for p in parts], axis=1)

    def _parts(self, deviations: jax.Array) -> list[jax.Array]:
        parts, start = [], 0
        for shape in self._shapes:
            count = int(np.prod(shape))
            parts.append(deviations[start : start + count].reshape(shape))
            start += count
        return parts

    def _linear(self, scheduled: jax.Array, constant: jax.Array) -> LinearModel:
        f, region = self.model.f, self.model.region
        std = jnp.where(region.std > 0, region.std, 1.0)
        change = jnp.zeros((len(f.grid), len(self.rows), len(std)))
        change = change.at[:, :, np.array(self.scheduled, dtype=int)].set(scheduled[..., :-1])
        change = change.at[:, :, np.array(self.constant, dtype=int)].set(constant)
        L = change * self.spread[:, None] / std
        # The offset belongs to the middle of the data, where coefficients do not disturb it.
        b = scheduled[..., -1] * self.spread - L @ region.mean
        return replace(
            f,
            coefficients=f.coefficients.at[:, list(self.rows)].add(L),
            offsets=f.offsets.at[:, list(self.rows)].add(b),
        )

    def _latents(self, model: DFSM, dynamics: jax.Array, drive: jax.Array) -> DFSM:
        """Decay and frequency change by factors, so that no latent state becomes unstable."""
        now, region = poles(self.model), self.model.region
        n_uw = len(self.model.signals.driving)
        std = jnp.where(region.std > 0, region.std, 1.0)[:n_uw]
        decay, frequency = jnp.exp(dynamics) * jnp.stack([now.decay, now.frequency])
        # Per unit of an input's spread a pair moves by about one.
        size = jnp.hypot(now.decay, now.frequency)
        b = (drive[0, :, :-1] + 1j * drive[1, :, :-1]) * size[:, None] / std
        offset = (drive[0, :, -1] + 1j * drive[1, :, -1]) * size - b @ region.mean[:n_uw]
        return with_poles(model, Poles(decay, frequency, now.drive + b, now.offset + offset))

    def _correction(self, parts: list[jax.Array], inputs: jax.Array) -> jax.Array:
        e = self._corrective(parts)
        if e is None:
            raise ValueError("the model has no corrective function")
        return e(inputs)

    def _corrective(self, parts: list[jax.Array]) -> Corrective | None:
        e = self.model.e
        if e is None:
            return None
        place = {row: k for k, row in enumerate(self.rows)}
        scale = jnp.asarray([self.spread[place[row]] for row in self.model.corrected])
        if isinstance(e, GaussianUnits):
            weights, bias = parts
            return replace(
                e, weights=e.weights + scale[:, None] * weights, bias=e.bias + scale * bias
            )
        n = len(e.weights)
        weights = [*parts[: n - 1], scale[:, None] * parts[n - 1]]
        biases = [*parts[n:-1], scale * parts[-1]]
        return replace(
            e,
            weights=tuple(a + b for a, b in zip(e.weights, weights, strict=True)),
            biases=tuple(a + b for a, b in zip(e.biases, biases, strict=True)),
        )

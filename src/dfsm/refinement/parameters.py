"""The numbers of a model that refinement may change, as one well-scaled vector.

The vector holds deviations from the model that it was made of, so zero is that model. Coefficients
are scaled by what their input and their row typically are: a unit deviation of any of them changes
a derivative by about its own spread.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray
from dfsm.data.derivatives import kinematic_rows
from dfsm.models.corrective import Corrective
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import Poles, poles, with_poles
from dfsm.models.linear import LinearModel
from dfsm.models.terms import Terms


class Parametrization(eqx.Module):
    """Deviations from a model, and the model that they make.

    Coefficients that do not depend on the schedule stay so.

    Attributes
    ----------
    model
        The model at zero.
    rows
        Rows of the linear fit that are neither kinematic nor of latent states nor
        balances of known torques.
    spread
        Typical size of each of these derivatives, shape ``(row,)``, in its unit.
    scheduled, constant
        Input columns whose coefficients in these rows vary along the schedule, and the others.
    free
        Which of the constant coefficients may change, by row: those that physics gave stay.
    driven
        Input columns that drive the latent pairs.
    """

    model: DFSM
    spread: jax.Array
    rows: tuple[int, ...] = eqx.field(static=True)
    scheduled: tuple[int, ...] = eqx.field(static=True)
    constant: tuple[int, ...] = eqx.field(static=True)
    free: tuple[tuple[bool, ...], ...] = eqx.field(static=True)
    driven: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, model: DFSM, spread: Array) -> Parametrization:
        """Make one; `spread` holds the typical size of the observed states' derivatives."""
        s = model.signals
        known = {*kinematic_rows(s.specs), *model.balances}
        rows = tuple(i for i in range(len(s.observed)) if i not in known)
        L = np.asarray(model.f.coefficients)[:, list(rows)]
        varies = np.ptp(L, axis=0).any(axis=0) | (len(L) == 1)
        varies[list(model.f.known_among(len(varies)))] = False
        # Nothing is known yet about states that have only been added.
        varies[s.pair_columns] = True
        scheduled, constant = (tuple(np.flatnonzero(v).tolist()) for v in (varies, ~varies))
        free = tuple(tuple((i, c) not in model.f.known for c in constant) for i in rows)
        typical = np.maximum(spread[list(rows)], np.finfo(float).tiny)
        driven = tuple(np.flatnonzero(np.asarray(poles(model).drive).any(axis=0)).tolist())
        return cls(model, from_host(typical), rows, scheduled, constant, free, driven)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(int(np.prod(shape)) for shape in self._shapes)

    @property
    def latent_columns(self) -> IntArray:
        """Where the parameters of each pair's dynamics lie in the vector, ``(pair, own)``.

        In the order decay, frequency, drives and offset of the real part, those of the imaginary.
        """
        sizes = [int(np.prod(shape)) for shape in self._shapes[:4]]
        first, pairs = sum(sizes[:2]), self._shapes[2][1]
        dynamics = np.arange(sizes[2]).reshape(2, pairs)
        drive = sizes[2] + np.arange(sizes[3]).reshape(2, pairs, len(self.driven) + 1)
        return first + np.concatenate([dynamics.T, *drive], axis=1)

    @property
    def term_columns(self) -> slice:
        """Where the parameters of terms lie in the vector."""
        first = sum(int(np.prod(shape)) for shape in self._shapes[:4])
        return slice(first, first + sum(int(np.prod(shape)) for shape in self._term_shapes))

    @property
    def _shapes(self) -> list[tuple[int, ...]]:
        points, rows = len(self.model.f.grid), len(self.rows)
        pairs = len(self.model.signals.pairs) // 2
        return [
            (points, rows, len(self.scheduled) + 1),
            (rows, len(self.constant)),
            (2, pairs),
            (2, pairs, len(self.driven) + 1),
            *self._term_shapes,
            *self._corrective_shapes,
        ]

    @property
    def _term_shapes(self) -> list[tuple[int, ...]]:
        terms = self.model.terms
        return [] if terms is None else [a.shape for a in terms.parameters]

    @property
    def _corrective_shapes(self) -> list[tuple[int, ...]]:
        e = self.model.e
        return [] if e is None else [a.shape for a in e.parameters]

    def at(self, deviations: jax.Array) -> DFSM:
        """The model at some deviations, shape ``(parameter,)``; JAX can follow it."""
        f, e, terms = self._functions(deviations)
        return replace(self.model, f=f, e=e, terms=terms)

    # One compilation instead of one for each little operation; not of the model, whose provenance
    # would be that of the first.
    @eqx.filter_jit
    def _functions(
        self, deviations: jax.Array
    ) -> tuple[LinearModel, Corrective | None, Terms | None]:
        scheduled, constant, dynamics, drive, *others = self._parts(deviations)
        terms, corrective = self._divided(others)
        f, e = self._linear(scheduled, constant), self._corrective(corrective)
        if self.model.signals.pairs:
            f = self._latents(replace(self.model, f=f), dynamics, drive).f
        return f, e, self._terms(terms)

    def slopes(
        self, deviations: jax.Array, model: DFSM, inputs: jax.Array, weights: jax.Array
    ) -> jax.Array:
        """Σ_i W_i ∂f̂/∂θ(I_i) of the states that are marched, but for the dynamics of latent pairs.

        Written out because it is what refinement spends its time on; tracing `at` backwards gives
        the same several times slower.

        Parameters
        ----------
        deviations
            θ, shape ``(parameter,)``.
        model
            What `at` makes of them.
        inputs
            I, shape ``(step, i, input)``.
        weights
            W, shape ``(step, i, state, state)`` of those.

        Returns
        -------
        Array
            Shape ``(step, state, parameter)``; zero for the latent pairs' own.
        """
        steps, stages, states = weights.shape[:3]
        z = jax.vmap(jax.vmap(partial(self._wide, model)))(inputs)
        hats = jax.vmap(jax.vmap(model.f.shares))(inputs)
        by_row = weights[..., list(self.rows)] * self.spread
        ones = jnp.ones((steps, stages, 1))
        moved = jnp.concatenate([z[..., np.array(self.scheduled, dtype=int)], ones], axis=2)
        constant = z[..., self._constant_columns]

        # Sums of products written so that each becomes one pass over its result.
        scheduled = sum(
            hats[:, i, None, :, None, None]
            * by_row[:, i, :, None, :, None]
            * moved[:, i, None, None, None]
            for i in range(stages)
        )
        always = sum(by_row[:, i, ..., None] * constant[:, i, None, None] for i in range(stages))
        parts = [scheduled, always * self._free]
        parts = [jnp.reshape(p, (steps, states, -1)) for p in parts]
        parts.append(jnp.zeros((steps, states, self.latent_columns.size)))
        if self._term_shapes:
            by_term = self._term_slopes(deviations, model, inputs)
            parts += [jnp.einsum("tiar,tirp->tap", weights, by_term)]
        if self._corrective_shapes:
            corrected = weights[..., list(self.model.corrected)]
            by_part = self._corrective_slopes(deviations, inputs)
            parts += [jnp.einsum("tiar,tirp->tap", corrected, by_part)]
        return jnp.concatenate(parts, axis=2)

    def _term_slopes(self, deviations: jax.Array, model: DFSM, inputs: jax.Array) -> jax.Array:
        """∂(L_φ φ)/∂θ, shape ``(step, i, state, parameter of terms)``."""
        terms, _ = self._divided(self._parts(deviations)[4:])
        # Those of rows that are known, too: what a term takes may be learnt.
        first, states = len(model.signals.inputs), model.signals.marched

        def at_one(inputs: jax.Array) -> jax.Array:
            known = self.model.terms
            J = jnp.zeros((0, 0)) if known is None else known.parameter_slopes(terms, inputs)
            L, _ = model.f.at(inputs[model.f.schedule or 0])
            return L[:states, first:] @ J

        return jax.vmap(jax.vmap(at_one))(inputs)

    def _corrective_slopes(self, deviations: jax.Array, inputs: jax.Array) -> jax.Array:
        """∂e/∂θ, shape ``(step, i, corrected row, corrective parameter)``."""
        _, corrective = self._divided(self._parts(deviations)[4:])
        rows = len(self.model.corrected)

        def at_one(inputs: jax.Array) -> jax.Array:
            by_part = jax.jacrev(lambda parts: self._correction(parts, inputs))(corrective)
            return jnp.concatenate([p.reshape(rows, -1) for p in by_part], axis=1)

        return jax.vmap(jax.vmap(at_one))(inputs)

    def latent_slopes(self, model: DFSM, inputs: jax.Array) -> jax.Array:
        """∂f̂/∂θ of each latent pair and its own parameters, ``(pair, 2, own)``.

        Parameters
        ----------
        model
            What `at` makes of some deviations.
        inputs
            I, shape ``(input,)``.
        """
        s, now, start = self.model.signals, poles(model), poles(self.model)
        z = self._standardised(inputs)
        latent = inputs[s.pair_columns].reshape(-1, 2)
        turned = jnp.stack([latent[:, 1], -latent[:, 0]], axis=1)
        moved = jnp.concatenate([z[np.array(self.driven, dtype=int)], jnp.ones(1)])
        drive = jnp.hypot(start.decay, start.frequency)[:, None] * moved
        none = jnp.zeros_like(drive)
        by_drive = jnp.stack(
            [jnp.concatenate([drive, none], axis=1), jnp.concatenate([none, drive], axis=1)], axis=1
        )
        decay = -now.decay[:, None] * latent
        frequency = now.frequency[:, None] * turned
        return jnp.concatenate([decay[..., None], frequency[..., None], by_drive], axis=2)

    def _standardised(self, inputs: jax.Array) -> jax.Array:
        region = self.model.region
        return (inputs - region.mean) / region.scale

    def _wide(self, model: DFSM, inputs: jax.Array) -> jax.Array:
        """[I, φ] of one input vector, standardised."""
        wide = inputs if model.terms is None else model.terms.extend(inputs)
        mean, scale = self._moments
        return (wide - mean) / scale

    @property
    def _moments(self) -> tuple[jax.Array, jax.Array]:
        """Mean and scale of [I, φ]."""
        region, terms = self.model.region, self.model.terms
        if terms is None:
            return region.mean, region.scale
        return (
            jnp.concatenate([region.mean, terms.mean]),
            jnp.concatenate([region.scale, terms.scale]),
        )

    @property
    def _constant_columns(self) -> IntArray:
        return np.array(self.constant, dtype=int)

    @property
    def _free(self) -> Array:
        return np.array(self.free, dtype=float).reshape(len(self.rows), len(self.constant))

    def _parts(self, deviations: jax.Array) -> list[jax.Array]:
        parts, start = [], 0
        for shape in self._shapes:
            count = int(np.prod(shape))
            parts.append(deviations[start : start + count].reshape(shape))
            start += count
        return parts

    def _divided(self, parts: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        """Parts of the terms and of the corrective function."""
        count = len(self._term_shapes)
        return parts[:count], parts[count:]

    def _terms(self, parts: list[jax.Array]) -> Terms | None:
        terms = self.model.terms
        return None if terms is None else terms.moved(parts)

    def _linear(self, scheduled: jax.Array, constant: jax.Array) -> LinearModel:
        f = self.model.f
        mean, std = self._moments
        change = jnp.zeros((len(f.grid), len(self.rows), len(std)))
        change = change.at[:, :, np.array(self.scheduled, dtype=int)].set(scheduled[..., :-1])
        change = change.at[:, :, self._constant_columns].set(constant * self._free)
        L = change * self.spread[:, None] / std
        # The offset belongs to the middle of the data, where coefficients do not disturb it.
        b = scheduled[..., -1] * self.spread - L @ mean
        return replace(
            f,
            coefficients=f.coefficients.at[:, list(self.rows)].add(L),
            offsets=f.offsets.at[:, list(self.rows)].add(b),
        )

    def _latents(self, model: DFSM, dynamics: jax.Array, drive: jax.Array) -> DFSM:
        """Decay and frequency change by factors, so that no latent state becomes unstable."""
        now, region = poles(self.model), self.model.region
        columns = np.array(self.driven, dtype=int)
        std = region.scale[columns]
        decay, frequency = jnp.exp(dynamics) * jnp.stack([now.decay, now.frequency])
        # Per unit of an input's spread a pair moves by about one.
        size = jnp.hypot(now.decay, now.frequency)
        b = (drive[0, :, :-1] + 1j * drive[1, :, :-1]) * size[:, None] / std
        offset = (drive[0, :, -1] + 1j * drive[1, :, -1]) * size - b @ region.mean[columns]
        drives = now.drive.at[:, columns].add(b)
        return with_poles(model, Poles(decay, frequency, drives, now.offset + offset))

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
        return e.moved(parts, scale)

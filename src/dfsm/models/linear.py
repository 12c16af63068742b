"""The linear part of a model: an affine map whose coefficients are interpolated in the schedule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.numerics.hats import hats

# Numbers that a processor takes at once.
_REGISTER = 4
# Coefficients that are multiplied one by one at most.
_FEW = 64
# An interval of a grid, and where in it, 0 to 1.
_At = tuple[jax.Array, jax.Array]


class LinearModel(eqx.Module):
    """Affine map ``y = L(s) I + b(s)`` whose coefficients are interpolated in a schedule ``s``.

    Attributes
    ----------
    grid
        Schedule points in the schedule's unit, shape ``(point,)``; one point for an LTI model.
    coefficients
        L at every schedule point, in physical units, shape ``(point, target, input)``.
    offsets
        b at every schedule point, shape ``(point, target)``.
    schedule
        Column of the input vector that schedules, None for an LTI model.
    known
        Pairs of target and input whose coefficient is known and was not fitted.
    """

    grid: jax.Array
    coefficients: jax.Array
    offsets: jax.Array
    schedule: int | None = eqx.field(static=True)
    known: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())

    def complete(self, latent: slice = slice(0, 0)) -> tuple[int, ...]:
        """Targets all of whose coefficients are known, but for those of latent states."""
        targets, width = self.coefficients.shape[1:]
        places = set(range(width)) - set(range(width)[latent])
        by_target = [{c for t, c in self.known if t == target} for target in range(targets)]
        return tuple(target for target, known in enumerate(by_target) if known >= places)

    def hidden_among(self, inputs: int, latent: slice = slice(0, 0)) -> tuple[int, ...]:
        """Which of the first columns no corrective function may take, lest it undo what is known.

        Targets all of whose coefficients are known are not corrected, and do not count.
        """
        complete = self.complete(latent)
        places = {c for target, c in self.known if c < inputs and target not in complete}
        return tuple(sorted(places))

    def known_among(self, inputs: int) -> tuple[int, ...]:
        """Which of the first columns have a coefficient that is known."""
        return tuple(sorted({column for _, column in self.known if column < inputs}))

    def at(self, value: jax.Array | float) -> tuple[jax.Array, jax.Array]:
        """Return L, shape ``(target, input)``, and b, shape ``(target,)``, at a schedule value.

        Outside the grid the coefficients of the nearest point hold.
        """
        if self.schedule is None:
            return self.coefficients[0], self.offsets[0]
        i, t = _place(self.grid, value)
        # Slices of two points; general indexing costs several times as much in a rollout.
        L = jax.lax.dynamic_slice_in_dim(self.coefficients, i, 2)
        b = jax.lax.dynamic_slice_in_dim(self.offsets, i, 2)
        return (1 - t) * L[0] + t * L[1], (1 - t) * b[0] + t * b[1]

    def shares(self, inputs: jax.Array) -> jax.Array:
        """Weight of every schedule point at one input vector, shape ``(point,)``."""
        return hats(self.grid, inputs[self.schedule or 0])

    def __call__(self, inputs: jax.Array, value: jax.Array | None = None) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``.

        `value` is the schedule's; None takes it from the inputs, see `InputOrder.element`.
        """
        L, b = self.at(inputs[self.schedule or 0] if value is None else value)
        return L @ inputs + b


class SplitLinear(eqx.Module):
    """The same map, where what some inputs contribute is asked for by itself.

    Attributes
    ----------
    grid
        As of `LinearModel`.
    first, then
        What some inputs and a 1 contribute, and what the others do.
    targets
        Their number.
    """

    grid: jax.Array
    first: Share
    then: Share
    targets: int = eqx.field(static=True)

    @classmethod
    def of(cls, linear: LinearModel, first: Sequence[int], then: Sequence[int]) -> SplitLinear:
        """The map of inputs in this order, which is another than that of the model's."""
        L, b = np.asarray(linear.coefficients), np.asarray(linear.offsets)
        known = np.concatenate([L[:, :, list(first)], b[:, :, None]], axis=2)
        return cls(linear.grid, Share.of(known), Share.of(L[:, :, list(then)]), b.shape[1])

    def __call__(self, first: jax.Array, then: jax.Array, value: jax.Array) -> jax.Array:
        """Evaluate at two vectors of inputs, ``(input,)``, and a schedule value: ``(target,)``."""
        at = None if self.grid.shape[0] == 1 else _place(self.grid, value)
        total = self.first(jnp.concatenate([first, jnp.ones(1)]), at)
        return jnp.stack([jnp.asarray(sum_, dtype=float) for sum_ in self.then(then, at, total)])


class Share(eqx.Module):
    """What some inputs contribute to all targets.

    Most coefficients of a model are zero or the same along its schedule. What is zero is left out,
    what is the same is not interpolated, and few are multiplied one by one: a product of small
    matrices costs as much as a hundred of them.

    Attributes
    ----------
    same, along
        Those that are the same along the schedule, and those that are not.
    """

    same: Coefficients
    along: Coefficients

    @classmethod
    def of(cls, coefficients: Array) -> Share:
        """Of coefficients by schedule point, ``(point, target, input)``."""
        moves = np.ptp(coefficients, axis=0) != 0
        same = np.where(moves, 0.0, coefficients[:1])
        return cls(Coefficients.of(same), Coefficients.of(np.where(moves, coefficients, 0.0)))

    def __call__(
        self, inputs: jax.Array, at: _At | None, total: Sequence[Any] | None = None
    ) -> list[Any]:
        """Their sums by target, to which those of `total` are added."""
        return self.along(inputs, at, self.same(inputs, None, total))


class Coefficients(eqx.Module):
    """Coefficients that are not zero, as loops take them.

    Attributes
    ----------
    values
        One by one, ``(point entry,)``; or where they are many as a matrix of the inputs that have
        any, schedule point by schedule point and input by input, ``(point input target,)``: what
        is read lies together. Zeros fill the targets of an input up to a whole number of a
        processor's registers.
    entries
        Pairs of target and input; None for a matrix.
    inputs
        Of the matrix.
    targets, filled
        Their number, without and with what fills them.
    """

    values: jax.Array
    entries: tuple[tuple[int, int], ...] | None = eqx.field(static=True)
    inputs: tuple[int, ...] = eqx.field(static=True)
    targets: int = eqx.field(static=True)
    filled: int = eqx.field(static=True)

    @classmethod
    def of(cls, coefficients: Array) -> Coefficients:
        """Of those by schedule point, ``(point, target, input)``."""
        targets = coefficients.shape[1]
        filled = -(-targets // _REGISTER) * _REGISTER
        found = (coefficients != 0).any(axis=0)
        inputs = tuple(np.flatnonzero(found.any(axis=0)).tolist())
        if found.sum() <= _FEW:
            rows, columns = np.nonzero(found)
            entries = tuple(zip(rows.tolist(), columns.tolist(), strict=True))
            values = coefficients[:, rows, columns]
            return cls(from_host(values.ravel()), entries, inputs, targets, filled)
        matrix = np.swapaxes(coefficients[:, :, list(inputs)], 1, 2)
        matrix = np.pad(matrix, ((0, 0), (0, 0), (0, filled - targets)))
        return cls(from_host(matrix.ravel()), None, inputs, targets, filled)

    def __call__(
        self, inputs: jax.Array, at: _At | None, total: Sequence[Any] | None = None
    ) -> list[Any]:
        """Sums of products by target, to which those of `total` are added."""
        sums: list[Any] = [0.0] * self.targets if total is None else list(total)
        if not self.inputs:
            return sums
        if self.entries is None:
            taken = _columns(inputs, self.inputs)
            values = self.values if at is None else self._two(at)
            if at is not None:
                taken = jnp.concatenate([(1 - at[1]) * taken, at[1] * taken])
            product = taken @ values.reshape(-1, self.filled)
            return [sum_ + product[k] for k, sum_ in enumerate(sums)]
        values, count = self.values, len(self.entries)
        if at is not None:
            two = self._two(at)
            values = (1 - at[1]) * two[:count] + at[1] * two[count:]
        for k, (target, column) in enumerate(self.entries):
            sums[target] = sums[target] + values[k] * inputs[column]
        return sums

    def _two(self, at: _At) -> jax.Array:
        """Values of two schedule points."""
        size = len(self.inputs) * self.filled if self.entries is None else len(self.entries)
        return jax.lax.dynamic_slice(
            self.values, (at[0] * size,), (2 * size,), allow_negative_indices=False
        )


def _columns(inputs: jax.Array, columns: tuple[int, ...]) -> jax.Array:
    """Some of the inputs, in parts that lie together."""
    cuts = np.flatnonzero(np.diff(columns) > 1) + 1
    spans = np.split(np.array(columns), cuts)
    return jnp.concatenate([inputs[span[0] : span[-1] + 1] for span in spans])


def _place(grid: jax.Array, value: jax.Array | float) -> _At:
    """Interval of the grid that a schedule value lies in, and where in it, 0 to 1."""
    value = jnp.clip(value, grid[0], grid[-1])
    i = jnp.clip(jnp.sum(value >= grid) - 1, 0, grid.shape[0] - 2)
    ends = jax.lax.dynamic_slice_in_dim(grid, i, 2)
    return i, (value - ends[0]) / (ends[1] - ends[0])

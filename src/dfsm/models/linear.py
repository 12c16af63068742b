"""The linear part of a model: an affine map whose coefficients are interpolated in the schedule."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.host import from_host
from dfsm.numerics.hats import hats

# Numbers that a processor takes at once.
_REGISTER = 4


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
        Coefficients of some inputs and a 1, and of the others, in one row, schedule point by
        schedule point and input by input, ``(point input target,)``: what is read lies together.
        Zeros fill the targets of an input up to a whole number of a processor's registers.
    targets, filled
        Their number, without and with what fills them.
    """

    grid: jax.Array
    first: jax.Array
    then: jax.Array
    targets: int = eqx.field(static=True)
    filled: int = eqx.field(static=True)

    @classmethod
    def of(cls, linear: LinearModel, first: Sequence[int], then: Sequence[int]) -> SplitLinear:
        """The map of inputs in this order, which is another than that of the model's."""
        targets = linear.offsets.shape[1]
        filled = -(-targets // _REGISTER) * _REGISTER
        more = ((0, 0), (0, 0), (0, filled - targets))
        L = np.pad(np.swapaxes(np.asarray(linear.coefficients), 1, 2), more)
        b = np.pad(np.asarray(linear.offsets)[:, None], more)
        parts = np.concatenate([L[:, list(first)], b], axis=1), L[:, list(then)]
        known, rest = (from_host(part.ravel()) for part in parts)
        return cls(linear.grid, known, rest, targets, filled)

    def __call__(self, first: jax.Array, then: jax.Array, value: jax.Array) -> jax.Array:
        """Evaluate at two vectors of inputs, ``(input,)``, and a schedule value: ``(target,)``."""
        known = jnp.concatenate([first, jnp.ones(1)])
        if self.grid.shape[0] == 1:
            parts = known @ self._rows(self.first), then @ self._rows(self.then)
        else:
            at = _place(self.grid, value)
            parts = self._between(known, self.first, at), self._between(then, self.then, at)
        return (parts[0] + parts[1])[: self.targets]

    def _between(
        self, inputs: jax.Array, table: jax.Array, at: tuple[jax.Array, jax.Array]
    ) -> jax.Array:
        """Inputs with the weights of two points times the coefficients there, as one product."""
        (i, t), size = at, len(inputs) * self.filled
        both = jax.lax.dynamic_slice(table, (i * size,), (2 * size,), allow_negative_indices=False)
        return jnp.concatenate([(1 - t) * inputs, t * inputs]) @ self._rows(both)

    def _rows(self, table: jax.Array) -> jax.Array:
        return table.reshape(-1, self.filled)


def _place(grid: jax.Array, value: jax.Array | float) -> tuple[jax.Array, jax.Array]:
    """Interval of the grid that a schedule value lies in, and where in it, 0 to 1."""
    value = jnp.clip(value, grid[0], grid[-1])
    i = jnp.clip(jnp.sum(value >= grid) - 1, 0, grid.shape[0] - 2)
    ends = jax.lax.dynamic_slice_in_dim(grid, i, 2)
    return i, (value - ends[0]) / (ends[1] - ends[0])

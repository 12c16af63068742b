"""The linear part of a model: an affine map whose coefficients are interpolated in the schedule."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

import dfsm.core.jax_setup  # noqa: F401
from dfsm.numerics.hats import hats


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
        n = self.grid.shape[0]
        value = jnp.clip(value, self.grid[0], self.grid[-1])
        i = jnp.clip(jnp.sum(value >= self.grid) - 1, 0, n - 2)
        ends = jax.lax.dynamic_slice_in_dim(self.grid, i, 2)
        t = (value - ends[0]) / (ends[1] - ends[0])
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

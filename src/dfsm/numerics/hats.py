"""The schedule's value, and linear interpolation between points along it."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp

import dfsm.core.jax_setup  # noqa: F401


def hats(grid: jax.Array, value: jax.Array) -> jax.Array:
    """Weight of every point at schedule values ``(...)``, shape ``(..., point)``.

    Beyond the ends the nearest point has it all, and a single point always.
    """
    value = jnp.asarray(value)[..., None]
    one = jnp.ones_like(value)
    after = jnp.clip((value - grid[:-1]) / jnp.diff(grid), 0.0, 1.0)
    return jnp.concatenate([one, after], axis=-1) - jnp.concatenate([after, 0 * one], axis=-1)


def scheduled(column: int | None, groups: Sequence[jax.Array]) -> jax.Array:
    """The element of I = [u, w, ξ, p] that schedules, shape ``(...)``; 0 for an LTI model.

    Taken from its own group, not from I. JAX then sees that it does not change with the other
    groups, and second derivatives in states and controls take a fraction of the time.

    Parameters
    ----------
    column
        Where it stands in I.
    groups
        u, w, ξ and p, shapes ``(..., n)``.
    """
    first = 0
    for group in groups:
        if column is not None and column < first + group.shape[-1]:
            return group[..., column - first]
        first += group.shape[-1]
    return jnp.zeros(())

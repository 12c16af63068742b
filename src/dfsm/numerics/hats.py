"""Linear interpolation between points along a schedule."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array


@jax.jit
def hats(grid: jax.Array, value: jax.Array) -> jax.Array:
    """Weight of every point at schedule values ``(...)``, shape ``(..., point)``.

    Beyond the ends the nearest point has it all, and a single point always.
    """
    value = jnp.asarray(value)[..., None]
    one = jnp.ones_like(value)
    after = jnp.clip((value - grid[:-1]) / jnp.diff(grid), 0.0, 1.0)
    return jnp.concatenate([one, after], axis=-1) - jnp.concatenate([after, 0 * one], axis=-1)


def hat_weights(grid: Array, values: Array) -> Array:
    """The same in NumPy, of values ``(value,)``: any number of them, and nothing is compiled."""
    return np.stack([np.interp(values, grid, row) for row in np.eye(len(grid))], axis=1)

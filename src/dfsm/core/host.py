"""Arrays of the host as JAX's own, without compiling anything.

Outside compiled code every operation of JAX is compiled by itself, for every shape, which takes
tens of milliseconds: slices, `jnp.zeros` and `jnp.asarray` of a NumPy array too. What only moves
values is done by NumPy there, to the same bits.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

import dfsm.core.jax_setup  # noqa: F401


def from_host(values: Any) -> jax.Array:
    """A copy of values of the host; an array of JAX, traced or not, as it is."""
    if isinstance(values, jax.Array):
        return values
    # JAX may keep what it is handed instead of a copy.
    return jax.device_put(np.array(values))


def traced(*arrays: Any) -> bool:
    """Whether JAX follows one of some arrays, so that its values are not known."""
    return any(isinstance(a, Tracer) for a in arrays)

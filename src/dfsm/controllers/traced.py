"""What JAX follows of a controller: its numbers, which are checked before."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer


def traced(tree: Any) -> bool:
    """Whether any number of a pytree is not known, because JAX traces a function of it."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def as_arrays(controller: Any) -> Any:
    """The same controller with its numbers as arrays: others would be compiled in.

    Names may stand among the numbers, in fields that nobody declared static; they stay.
    """
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf) if eqx.is_array_like(leaf) else leaf, controller
    )


def is_compiled(controller: Any) -> bool:
    """Whether JAX can follow a controller: an equinox module, and what it wraps likewise."""
    inner = getattr(controller, "inner", None)
    return isinstance(controller, eqx.Module) and (inner is None or is_compiled(inner))

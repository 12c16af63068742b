"""Whether JAX is following a controller: checks of its numbers are made before."""

from __future__ import annotations

from typing import Any

import jax
from jax.core import Tracer


def traced(tree: Any) -> bool:
    """Whether any number of a pytree is not known, because JAX traces a function of it."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))

"""Whether traced code depends on an argument: how linear-quadratic problems are recognised."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

# Calls whose inner code has the same inputs and outputs as the call itself.
_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "custom_jvp_call", "custom_vjp_call")


def varies(function: Callable[..., Any], first: Any, *rest: Any) -> bool:
    """Whether what a function returns depends on its first argument.

    Followed through the traced code operation by operation; loops count as depending on all that
    enters them. A False is therefore a proof, a True may be overcautious.

    Parameters
    ----------
    function
        Traceable by JAX.
    first
        Example of the argument in question.
    rest
        Examples of the others.
    """
    closed = jax.make_jaxpr(function)(first, *rest)
    count = len(jax.tree.leaves(first))
    touched = [i < count for i in range(len(closed.jaxpr.invars))]
    return any(_follow(closed.jaxpr, touched))


def _follow(jaxpr: Any, touched: list[bool]) -> list[bool]:
    reached = {v for v, t in zip(jaxpr.invars, touched, strict=True) if t}
    for equation in jaxpr.eqns:
        # Literals are not hashable and never depend on anything.
        enters = [not hasattr(v, "val") and v in reached for v in equation.invars]
        if not any(enters):
            continue
        inner = _inner(equation)
        leaves = _follow(inner, enters) if inner is not None else [True] * len(equation.outvars)
        reached |= {v for v, t in zip(equation.outvars, leaves, strict=True) if t}
    return [not hasattr(v, "val") and v in reached for v in jaxpr.outvars]


def _inner(equation: Any) -> Any:
    """Code of a call, if its inputs and outputs are those of the equation; else None."""
    if equation.primitive.name not in _CALLS:
        return None
    for key in ("jaxpr", "call_jaxpr"):
        found = equation.params.get(key)
        found = getattr(found, "jaxpr", found)
        if found is not None and len(found.invars) == len(equation.invars):
            return found
    return None

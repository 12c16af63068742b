"""Times at which something in a problem has a kink, known before it is solved.

Disturbances are linear between their samples, and so are limits that a run gives. Functions that
interpolate a table in time show its knots in their traced code: every search of a sorted table for
a value that depends on time alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from dfsm.control.nlp.structure import inner_code
from dfsm.control.nlp.terms import Functions, common_of
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory

# Times at which the argument of a search is followed.
_FOLLOWED = 4001
# Knots that are closer in normalised time are one.
_APART = 1e-9


def knots_of(problem: OptimalControlProblem, functions: Functions) -> Array:
    """Knots inside a fixed horizon in normalised time, increasing; none for a free last time."""
    if problem.free_time is not None:
        return np.empty(0)
    runs = [r for r in problem.scenarios if r is not None and problem.plant.names("disturbances")]
    for place in (problem.bounds, problem.rates, problem.constraints):
        limits = (limit for entry in place.values() for limit in entry[-2:])
        runs += [limit for limit in limits if isinstance(limit, Trajectory)]
    span = problem.last_time - problem.start
    parts = [(run.time - problem.start) / span for run in runs]
    parts += _searched(problem, functions)
    knots = np.unique(np.concatenate([np.empty(0), *parts]))
    knots = knots[(knots > _APART) & (knots < 1 - _APART)]
    # The same knot of two tables may differ by rounding.
    return knots[np.diff(knots, prepend=-1.0) > _APART]


def _searched(problem: OptimalControlProblem, functions: Functions) -> list[Array]:
    """Knots of the tables in which costs and constraints look up the time."""
    extra = len(problem.free_parameters)
    names, common = problem.plant.names("disturbances"), common_of(problem)
    found = []
    for part in functions.node.parts or ():

        def local(tau: Any, z: Any, part: Callable[..., Any] = part) -> Any:
            data = {"tau": tau, "scenario": 0, "w": from_host(np.ones(len(names)))}
            return part(z, data, common)

        one = from_host(np.ones(functions.nx + functions.nu + extra))
        code = jax.make_jaxpr(local)(0.5, one)
        if not _searches(code.jaxpr):
            continue
        tau = np.linspace(0, 1, _FOLLOWED)
        first, second = (_arguments(code, tau, k * one) for k in (1.0, 0.7))
        for (table, values), (_, others) in zip(first, second, strict=True):
            if np.array_equal(values, others, equal_nan=True):
                found.append(_met(table, tau, values))
    return found


def _met(table: Array, tau: Array, values: Array) -> Array:
    """Where values that are linear between times meet the entries of a table."""
    if not np.isfinite(values).all():
        return np.empty(0)
    steps = np.diff(values)
    if (steps > 0).all() or (steps < 0).all():
        order = 1 if steps[0] > 0 else -1
        inside = table[(table > values.min()) & (table < values.max())]
        return np.interp(inside, values[::order], tau[::order])
    crossed = np.diff(np.searchsorted(table, values)) != 0
    return (tau[1:][crossed] + tau[:-1][crossed]) / 2


def _searches(code: Any) -> bool:
    """Whether traced code searches a sorted table."""
    for equation in code.eqns:
        inner = inner_code(equation)
        if _is_search(equation) or (inner is not None and _searches(inner)):
            return True
    return False


def _is_search(equation: Any) -> bool:
    return equation.params.get("name") == "searchsorted" and len(equation.invars) == 2


def _arguments(closed: Any, tau: Array, z: Any) -> list[tuple[Array, Array]]:
    """Tables that the code searches, and what for at every time."""
    tables: list[Array] = []

    def values(t: Any) -> list[Any]:
        seen: list[tuple[Any, Any]] = []
        _run(closed.jaxpr, closed.consts, (t, *jax.tree.leaves(z)), seen)
        kept = [
            (table, value)
            for table, value in seen
            if not isinstance(table, jax.core.Tracer) and jnp.ndim(value) == 0
        ]
        tables[:] = [np.asarray(table) for table, _ in kept]
        return [jnp.asarray(value, dtype=float) for _, value in kept]

    followed = jax.vmap(values)(from_host(tau))
    return [(t, np.asarray(v)) for t, v in zip(tables, followed, strict=True)]


def _run(code: Any, consts: Sequence[Any], arguments: Sequence[Any], seen: list[Any]) -> list[Any]:
    """Evaluate traced code operation by operation; keep what its searches were called with."""
    known = dict(zip((*code.constvars, *code.invars), (*consts, *arguments), strict=True))

    def value(v: Any) -> Any:
        return v.val if hasattr(v, "val") else known[v]

    for equation in code.eqns:
        enters = [value(v) for v in equation.invars]
        if _is_search(equation):
            seen.append((enters[0], enters[1]))
        inner = inner_code(equation)
        if inner is None:
            out = equation.primitive.bind(*enters, **equation.params)
            results = out if equation.primitive.multiple_results else [out]
        else:
            closed = next(
                c for k in ("jaxpr", "call_jaxpr") if (c := equation.params.get(k)) is not None
            )
            results = _run(inner, getattr(closed, "consts", ()), enters, seen)
        known |= zip(equation.outvars, results, strict=True)
    return [value(v) for v in code.outvars]

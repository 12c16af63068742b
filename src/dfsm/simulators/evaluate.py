"""Right-hand sides and outputs evaluated: at a point, along a run, and their slopes.

A function takes states, controls, disturbances and parameters, one vector each. There is one way
for functions that JAX can trace and one for those that only Python can call.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array

Function = Callable[..., Any]


def takes_four(function: Function) -> bool:
    """Whether a function can be called with four arguments, as far as it tells."""
    try:
        inspect.signature(function).bind(None, None, None, None)
    except TypeError:
        return False
    except ValueError:  # compiled functions do not tell
        return True
    return True


def as_jax(values: Any) -> jax.Array:
    """An array of what a function returned, which may be a list of numbers."""
    return jnp.asarray(values, dtype=jnp.float64)


def shape_jax(function: Function, *point: Array) -> tuple[int, ...] | None:
    """Shape of what a function returns at a point, None where JAX cannot trace it."""
    try:
        return jax.eval_shape(lambda *point: as_jax(function(*point)), *point).shape
    except jax.errors.JAXTypeError:
        return None


def shape_numpy(function: Function, *point: Array) -> tuple[int, ...]:
    """Shape of what a function returns at a point."""
    with np.errstate(all="ignore"):  # whether the values are finite is looked at elsewhere
        return np.shape(function(*point))


def rows_jax(function: Function, *parts: Array) -> Array:
    """Evaluate at every row of arrays ``(row, n)``, shape ``(row, value)``."""
    return np.asarray(_rows(function, *parts))


def rows_numpy(function: Function, *parts: Array) -> Array:
    """Evaluate at every row of arrays ``(row, n)``, shape ``(row, value)``."""
    rows = zip(*parts, strict=True)
    with np.errstate(all="ignore"):
        return np.stack([np.asarray(function(*row), dtype=np.float64) for row in rows])


@eqx.filter_jit
def _rows(function: Function, *parts: Array) -> jax.Array:
    return jax.vmap(lambda *point: as_jax(function(*point)))(*map(jnp.asarray, parts))


def jacobian_jax(function: Function, *point: Array) -> Array:
    """Exact slopes in states, controls and disturbances, ``(value, all of them)``."""
    return np.asarray(_jacobian(function, *point))


@eqx.filter_jit
def _jacobian(function: Function, *point: Array) -> jax.Array:
    *free, parameters = map(jnp.asarray, point)
    slopes = jax.jacfwd(lambda *free: as_jax(function(*free, parameters)), argnums=(0, 1, 2))
    return jnp.concatenate(slopes(*free), axis=1)


def jacobian_numpy(function: Function, *point: Array) -> Array:
    """Slopes as from `jacobian_jax` by central differences, to about 1e-10 of the values.

    The step is the one at which rounding and truncation cost about the same.
    """
    *free, parameters = point
    z, ends = np.concatenate(free), np.cumsum([len(part) for part in free])[:-1]
    columns = []
    for i in range(len(z)):
        step = np.zeros(len(z))
        step[i] = np.cbrt(np.finfo(float).eps) * max(1.0, abs(z[i]))
        above, below = (
            np.asarray(function(*np.split(side, ends), parameters), dtype=np.float64)
            for side in (z + step, z - step)
        )
        columns.append((above - below) / (2 * step[i]))
    return np.stack(columns, axis=1)

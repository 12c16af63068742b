"""The classical Runge-Kutta step."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax

import dfsm.core.jax_setup  # noqa: F401

# An array, or several.
State = TypeVar("State")


def rk4_step(
    rate: Callable[[State, jax.Array], State],
    at: State,
    dt: float | jax.Array,
    drive: tuple[jax.Array, jax.Array, jax.Array],
) -> tuple[State, tuple[State, State, State, State]]:
    """One step of ẋ = f(x, v).

    Parameters
    ----------
    rate
        f.
    at
        x at the start.
    dt
        Length in s.
    drive
        v at the start, the middle and the end.

    Returns
    -------
    tuple
        x at the end, and where f was evaluated: at the start, twice in the middle, at the end.
    """
    v0, vm, v1 = drive

    def moved(k: State, by: float | jax.Array) -> State:
        return jax.tree.map(lambda x, k: x + by * k, at, k)

    k1 = rate(at, v0)
    x2 = moved(k1, 0.5 * dt)
    k2 = rate(x2, vm)
    x3 = moved(k2, 0.5 * dt)
    k3 = rate(x3, vm)
    x4 = moved(k3, dt)
    k4 = rate(x4, v1)
    total = jax.tree.map(lambda a, b, c, d: a + 2 * b + 2 * c + d, k1, k2, k3, k4)
    return moved(total, dt / 6), (at, x2, x3, x4)

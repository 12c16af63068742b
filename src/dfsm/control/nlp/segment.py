"""One segment of shooting: the model integrated by RK4 under controls that are linear in pieces."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from dfsm.control.nlp.terms import Functions


def segment(
    functions: Functions, pieces: int, steps: int, z: jax.Array, data: Any, common: Any
) -> jax.Array:
    """Integrate one segment by RK4: [∫ T L dτ, end state, inner states, path constraints]."""
    nx, nu = functions.nx, functions.nu
    x0, U, q = jnp.split(z, [nx, nx + (pieces + 1) * nu])
    U = U.reshape(pieces + 1, nu)
    # Controls at the ends and middles of all steps.
    place = jnp.arange(2 * pieces * steps + 1) / (2 * steps)
    k = jnp.minimum(place.astype(int), pieces - 1)
    part = (place - k)[:, None]
    u = (1 - part) * U[k] + part * U[k + 1]

    def signals(x: jax.Array, u: jax.Array, tau: jax.Array, w: jax.Array) -> Any:
        here = {"tau": tau, "w": w, "scenario": data["scenario"]}
        return functions.signals(jnp.concatenate([x, u, q]), here, common)

    def stage(carry: tuple[jax.Array, ...], at: tuple[jax.Array, ...]) -> tuple[Any, jax.Array]:
        base, k, total = carry
        (a, b, last, h), inputs = at[:4], at[4:]
        state = base + a * h * k
        s, duration = signals(state[:-1], *inputs)
        k = jnp.concatenate([s.derivative, functions.integrand(s)])
        k = k * duration
        total = total + b * h * k
        base = jnp.where(last, total, base)
        return (base, k, total), base

    # One loop over the four stages of all steps, where `rk4_step` has them one after another: the
    # plant with its second derivatives is compiled once and not four times.
    count = pieces * steps
    middle = 2 * jnp.repeat(jnp.arange(count), 4) + jnp.tile(jnp.array([0, 1, 1, 2]), count)
    a, b = jnp.array([0, 0.5, 0.5, 1]), jnp.array([1, 2, 2, 1]) / 6
    last = jnp.array([False, False, False, True])
    h = jnp.repeat(jnp.diff(data["tau"][::2]), 4)
    over = (*(jnp.tile(v, count) for v in (a, b, last)), h)
    over = (*over, u[middle], data["tau"][middle], data["w"][middle])
    begin = jnp.append(x0, 0.0)
    (final, _, _), states = jax.lax.scan(stage, (begin, jnp.zeros_like(begin), begin), over)
    at_pieces = jnp.concatenate([x0[None], states[4 * steps - 1 :: 4 * steps, :-1]])
    every = 2 * steps

    def path(x: jax.Array, u: jax.Array, tau: jax.Array, w: jax.Array) -> jax.Array:
        return functions.path(signals(x, u, tau, w)[0])

    paths = jax.vmap(path)(at_pieces, u[::every], data["tau"][::every], data["w"][::every])
    return jnp.concatenate([final[-1:], final[:-1], at_pieces[1:-1].ravel(), paths.ravel()])

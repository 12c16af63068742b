"""Squared errors of rollouts over windows, as a function of parameters and states at their starts.

Exact sensitivities: states first, then the slopes of every step at once, then their products along
time. Windows come in batches, so that memory does not grow with the data.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.windows import Windows

# Samples of one batch of windows: all batches have one shape, so that they are compiled once, and
# memory does not grow with the data.
_BATCH = 3200


class HiddenError:
    """What is to be made small: Σ |y - ŷ|² over what trains, and a decay of the parameters.

    The vector of weights holds the parameters of the form, then the states at the start of each
    window.

    Parameters
    ----------
    form
        The equation.
    windows
        Records.
    decay
        Weights of the squared parameters, one for all or ``(parameter,)``.
    """

    def __init__(self, form: Form, windows: Windows, decay: Array | float = 0.0) -> None:
        self.form, self.windows, self._decay = form, windows, decay
        count, samples = windows.used.shape
        each = max(1, min(count, _BATCH // samples))
        self._batches = [slice(i, min(i + each, count)) for i in range(0, count, each)]
        self._size = each
        n, room = form.states, max(form.room, form.states)
        # The form that is computed, and where the parameters and states are among its own.
        self._computed = replace(form, states=room, room=0)
        self._places = np.arange(form.size)
        if room > n:
            columns = np.concatenate([np.arange(n), room + np.arange(form.inputs + 1)])
            width = self._computed.width + 1
            self._places = (width * np.arange(n)[:, None] + columns).ravel()
            levels = form.size - len(self._places)
            last = np.arange(self._computed.size - levels, self._computed.size)
            self._places = np.concatenate([self._places, last])

    @property
    def size(self) -> int:
        """Number of weights."""
        return self.form.size + len(self.windows.y) * self.form.states

    def paths(self, weights: Array) -> Array:
        """States along all windows, ``(window, time, state)``."""
        paths = np.concatenate(self._each(partial(_paths, self._computed), weights))
        return paths[..., : self.form.states]

    def outputs(self, weights: Array) -> Array:
        """Outputs along all windows, ``(window, time, output)``."""
        levels = weights[self.form.size - self.form.outputs : self.form.size]
        return self.form.seen(levels, self.paths(weights))

    def left_out(self, weights: Array) -> float:
        """Mean square of the errors where data are left out; 1 is as wrong as a constant."""
        return self._mean(weights, self.windows.left_out)

    def trained(self, weights: Array) -> float:
        """Mean square of the errors that train."""
        return self._mean(weights, self.windows.used)

    def cost(self, weights: Array) -> float:
        """All that is to be made small; infinite where a rollout is not finite."""
        p = weights[: self.form.size]
        total = self._squares(weights, self.windows.used)
        return total + float(np.sum(self._decay * p**2)) if np.isfinite(total) else np.inf

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ and Jᵀr."""
        n, p = self.form.states, self.form.size
        JtJ, Jtr = np.zeros((self.size, self.size)), np.zeros(self.size)
        whole = np.arange(p)
        there = np.concatenate([self._places, self._computed.size + np.arange(n)])
        for rows, part in zip(
            self._batches, self._each(_products_of(self._computed), weights), strict=True
        ):
            for i, (own, slope) in enumerate(zip(*map(np.asarray, part), strict=True), rows.start):
                at = np.concatenate([whole, p + n * i + np.arange(n)])
                JtJ[np.ix_(at, at)] += own[np.ix_(there, there)]
                Jtr[at] += slope[there]
        JtJ[whole, whole] += self._decay
        Jtr[whole] += self._decay * weights[:p]
        return JtJ, Jtr

    def _mean(self, weights: Array, share: Array) -> float:
        total, count = self._squares(weights, share), share.sum() * self.form.outputs
        return total / max(count, 1) if np.isfinite(total) else np.inf

    def _squares(self, weights: Array, share: Array) -> float:
        r = self.outputs(weights) - self.windows.y
        return float(np.sum(r**2 * share[..., None]))

    def _each(self, function: Callable[..., Any], weights: Array) -> list[Any]:
        """The results of all batches, several at a time."""
        p = self.form.size
        own = weights[p:].reshape(-1, self.form.states)
        starts = np.pad(own, ((0, 0), (0, self._computed.states - self.form.states)))
        parameters = np.zeros(self._computed.size)
        parameters[self._places] = weights[:p]
        theta = from_host(parameters)

        def one(rows: slice) -> Any:
            # The last batch is filled up with its last window.
            at = np.minimum(np.arange(rows.start, rows.start + self._size), rows.stop - 1)
            w = self.windows.part(at)
            part = function(theta, starts[at], w.h, w.v, w.y, w.used)
            return jax.tree.map(lambda a: np.asarray(a)[: rows.stop - rows.start], part)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return list(pool.map(one, self._batches))


def _products_of(form: Form) -> Callable[..., Any]:
    return partial(_products, form)


@partial(jax.jit, static_argnums=0)
def _paths(
    form: Form, theta: jax.Array, starts: jax.Array, h: jax.Array, v: jax.Array, *_: Any
) -> jax.Array:
    parts = form.parts(theta)

    def along(x0: jax.Array, h: jax.Array, v: jax.Array) -> jax.Array:
        def step(x: jax.Array, drive: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x = form.interval(parts, x, *drive)
            return x, x

        return jnp.concatenate([x0[None], jax.lax.scan(step, x0, (h, v))[1]])

    return jax.vmap(along)(starts, h, v)


@partial(jax.jit, static_argnums=0)
def _products(
    form: Form,
    theta: jax.Array,
    starts: jax.Array,
    h: jax.Array,
    v: jax.Array,
    y: jax.Array,
    used: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """JᵀJ and Jᵀr of each window, of parameters and its own start."""
    n, p = form.states, form.size
    xs = _paths(form, theta, starts, h, v)

    def slopes(x: jax.Array, h: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        def after(theta: jax.Array, x: jax.Array) -> jax.Array:
            return form.interval(form.parts(theta), x, h, v)

        return jax.jacfwd(after, 1)(theta, x), jax.jacrev(after, 0)(theta, x)

    A, B = jax.vmap(jax.vmap(slopes))(xs[:, :-1], h, v)

    def along(A: jax.Array, B: jax.Array) -> jax.Array:
        first = jnp.concatenate([jnp.zeros((n, p)), jnp.eye(n)], axis=1)

        def step(S: jax.Array, ab: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            S = (ab[0] @ S).at[:, :p].add(ab[1])
            return S, S[: form.outputs]

        return jnp.concatenate([first[None, : form.outputs], jax.lax.scan(step, first, (A, B))[1]])

    J, seen = jax.vmap(along)(A, B), xs[..., : form.outputs]
    if form.sensors:
        levels = theta[p - form.outputs :]
        seen, gains = jax.jvp(partial(form.seen, levels), (xs,), (jnp.ones_like(xs),))
        folds = jnp.diag(jnp.array([float(s.folds) for s in form.sensors]))
        J = (gains[..., None] * J).at[..., p - form.outputs : p].add(folds)
    J = J * used[..., None, None]
    r = (seen - y) * used[..., None]
    return jnp.einsum("wtoi,wtoj->wij", J, J), jnp.einsum("wtoi,wto->wi", J, r)

"""The error of rollouts over windows of recorded runs, as a function of a model's parameters.

Exact slopes come from forward sensitivities, S = dξ/dθ, marched along with the states by the same
Runge-Kutta steps,

    Ṡ = (∂f̂/∂ξ) S + ∂f̂/∂θ ,

run by run, so that memory does not grow with the number of runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import get_blas_funcs

from dfsm.derivatives import differentiate
from dfsm.filters import moving_average
from dfsm.integrate import clip_range, exogenous_groups, rate, rk4
from dfsm.latents import Poles, as_states, evolve, poles, rest
from dfsm.model import DFSM
from dfsm.parametrise import Parametrisation
from dfsm.refine_stability import StabilityKept
from dfsm.signals import with_computed
from dfsm.trajectory import Trajectory
from dfsm.types import Array, IntArray

# A rollout that leaves the training range this many half-ranges from its middle is cut off there:
# the error stays finite and still has a slope.
_FAR = 30.0
_SYRK: Any = get_blas_funcs("syrk", dtype=np.float64)


@dataclass(frozen=True)
class Record:
    """One run on an equidistant mesh.

    Attributes
    ----------
    step
        In s.
    before
        Steps between the start of the record and the first state; latent states need them.
    states, slopes
        Observed states and their derivatives, shape ``(step + 1, state)``.
    inputs
        Exogenous inputs at ends and middles of all steps, those before the first state included,
        ``(2 (before + step) + 1, exogenous)``.
    rest
        Controls and disturbances before the record begins.
    """

    step: float
    before: int
    states: Array
    slopes: Array
    inputs: Array
    rest: Array

    def follow(self, found: Poles) -> Array:
        """Latent pairs from the start of the record on, complex, ``(before + step + 1, pair)``."""
        h = jnp.full(len(self.inputs) // 2, self.step)
        v = jnp.asarray(self.inputs[::2, : len(self.rest)])
        return np.asarray(evolve(found, h, v, jnp.asarray(self.rest)))

    def latent_states(self, model: DFSM) -> Array:
        """A model's latent states from the first state on, ``(step + 1, latent)``."""
        pairs = self.follow(poles(model))[self.before :]
        return np.asarray(as_states(jnp.asarray(pairs)))

    def left_over(self, model: DFSM) -> Array:
        """Recorded minus modelled derivatives of the observed states, ``(step + 1, state)``."""
        states = np.concatenate([self.states, self.latent_states(model)], axis=1)
        exogenous = exogenous_groups(model, jnp.asarray(self.inputs[2 * self.before :: 2]))
        modelled = np.asarray(model.derivative(states, *exogenous))
        return self.slopes - modelled[:, : self.slopes.shape[1]]


def record_of(
    model: DFSM, run: Trajectory, step: float, start: float | None, stop: float | None
) -> Record:
    """Put a run on the mesh of the refinement.

    Parameters
    ----------
    model
        Says which channels are what.
    run
        The whole record.
    step
        In s; inputs are averaged over it.
    start, stop
        Time window in s of the states.
    """
    s = model.signals
    run = with_computed(run, s.hub_height, s.features)
    found = differentiate(run, s.specs, s.derivatives)
    window = run.window(start, stop)
    count = int(window.duration / step * (1 + 1e-9))
    before = int((window.time[0] - run.time[0]) / step * (1 + 1e-9))
    mesh = window.time[0] + step / 2 * np.arange(-2 * before, 2 * count + 1)
    run.select(s.exogenous).require_finite()
    dense = run.time_step is not None and run.time_step < step / 2
    inputs = [
        np.interp(mesh, run.time, moving_average(run.time, run[n], step) if dense else run[n])
        for n in s.exogenous
    ]
    states = found.trajectory.select(found.names)
    at = mesh[2 * before :: 2]
    slopes = [np.interp(at, run.time, d) for d in found.derivatives.T]
    return Record(
        step,
        before,
        states.resample(at).values,
        np.stack(slopes, axis=1),
        np.stack(inputs, axis=1),
        rest(run.time, run.select(s.driving).values),
    )


class _Windows(NamedTuple):
    """The windows of one run.

    Attributes
    ----------
    step
        In s.
    states
        Shape ``(window, time, state)``.
    inputs
        At ends and middles, ``(window, 2 time - 1, exogenous)``.
    first
        Steps from the start of the record to that of each window.
    record, rest
        Controls and disturbances of the whole record at the ends of steps, and before it.
    """

    step: float
    states: Array
    inputs: Array
    first: IntArray
    record: Array
    rest: Array


def _windows(record: Record, length: float | None) -> _Windows:
    steps = len(record.states) - 1
    each = steps if length is None else min(steps, round(length / record.step))
    first = np.arange(0, steps - each + 1, each)
    begin = 2 * (first + record.before)
    return _Windows(
        record.step,
        np.stack([record.states[i : i + each + 1] for i in first]),
        np.stack([record.inputs[i : i + 2 * each + 1] for i in begin]),
        first + record.before,
        record.inputs[::2, : len(record.rest)],
        record.rest,
    )


# States, slopes of the observed ones, slopes of the latent pairs.
_At = tuple[jax.Array, jax.Array, jax.Array]


class RolloutError:
    """|r|² of rollouts over windows, with JᵀJ and Jᵀr by forward sensitivities.

    Parameters
    ----------
    parameters
        What may change.
    records
        Runs to follow.
    length
        Of the windows in s; None takes whole runs.
    weights
        Of the observed states' squared errors.
    decay
        Weight of the squared deviations, added to |r|².
    kept
        What else adds to |r|².
    """

    def __init__(
        self,
        parameters: Parametrisation,
        records: Sequence[Record],
        length: float | None,
        weights: Array,
        decay: float = 0.0,
        kept: StabilityKept | None = None,
    ) -> None:
        self._decay, self._kept = decay, kept
        self._batches = [_windows(r, length) for r in records]
        overall = np.concatenate([r.states for r in records]).std(axis=0)
        self._scales = [
            # A state that hardly moves in one run must not outweigh all others.
            np.sqrt(weights) / np.maximum(r.states.std(axis=0), 0.1 * overall)
            for r in records
        ]
        self._count = sum(b.states[:, 1:].size for b in self._batches)
        self._parameters = parameters

    def _over_runs(self, function: Callable[..., Any], weights: Array) -> list[Any]:
        w = jnp.asarray(weights)

        def one(k: int) -> Any:
            given = self._parameters, w, self._batches[k], self._scales[k]
            return jax.block_until_ready(function(*given))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return list(pool.map(one, range(len(self._batches))))

    def cost(self, weights: Array) -> float:
        """|r|² and what is added to it, infinite where a rollout is not finite."""
        extra = 0.0 if self._kept is None else self._kept.cost(weights)
        if not np.isfinite(extra):
            return np.inf
        return self.relative(weights) * self._count + self._decay * float(weights @ weights) + extra

    def relative(self, weights: Array) -> float:
        """Mean square of r: 1 is as wrong as a constant; infinite where one is not finite."""
        total = float(np.sum([float(v) for v in self._over_runs(_square, weights)]))
        return total / self._count if np.isfinite(total) else np.inf

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ and Jᵀr of all of it."""
        parts = self._over_runs(_products, weights)
        JtJ, Jtr = (np.sum([p[k] for p in parts], axis=0) for k in (0, 1))
        JtJ += np.triu(JtJ, 1).T
        if self._kept is not None:
            JtJ, Jtr = (
                a + b for a, b in zip((JtJ, Jtr), self._kept.normal_equations(weights), strict=True)
            )
        return JtJ + self._decay * np.eye(len(Jtr)), Jtr + self._decay * weights


@eqx.filter_jit
def _square(
    parameters: Parametrisation, w: jax.Array, windows: _Windows, scale: jax.Array
) -> jax.Array:
    """|r|² over the windows of one run."""
    model = parameters.at(w).prepared()
    h = jnp.full(windows.states.shape[1] - 1, windows.step)
    starts = _starts(model, windows)
    follow = jax.vmap(lambda x0, v: rk4(model, x0, h, v, _FAR))
    xs = follow(starts, jnp.asarray(windows.inputs))
    return jnp.sum(((xs[:, 1:, : len(scale)] - windows.states[:, 1:]) * scale) ** 2)


def _products(
    parameters: Parametrisation, w: jax.Array, windows: _Windows, scale: Array
) -> tuple[Array, Array]:
    """Upper half of JᵀJ, and Jᵀr, over the windows of one run."""
    J, r = (np.asarray(a) for a in _residuals(parameters, w, windows, scale))
    # BLAS computes one half only, which is most of the time of a step with many parameters.
    return _SYRK(1.0, J.T), J.T @ r


@eqx.filter_jit
def _residuals(
    parameters: Parametrisation, w: jax.Array, windows: _Windows, scale: Array
) -> tuple[jax.Array, jax.Array]:
    """J and r over the windows of one run."""
    starts = _starts(parameters.at(w), windows)
    slopes = _start_slopes(parameters, w, windows)
    follow = partial(_sensitivities, parameters, w, windows.step)
    xs, S = jax.vmap(follow)(starts, slopes, jnp.asarray(windows.inputs))
    r = (xs[..., : len(scale)] - windows.states[:, 1:]) * scale
    J = (S * scale[:, None]).reshape(-1, w.size)
    return J, r.ravel()


def _sensitivities(
    parameters: Parametrisation,
    w: jax.Array,
    step: float,
    x0: jax.Array,
    pairs0: jax.Array,
    v: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """States and slopes of the observed ones after every step, as `rk4` would find them.

    A latent pair depends on its own parameters alone, so that its slopes are few.

    Parameters
    ----------
    parameters, w
        The model.
    step
        In s.
    x0
        States at the start, shape ``(state,)``.
    pairs0
        Slopes of the latent pairs there, shape ``(pair, 2, own)``.
    v
        Exogenous inputs at ends and middles, ``(2 step + 1, exogenous)``.

    Returns
    -------
    tuple of Array
        Shapes ``(step, state)`` and ``(step, observed state, parameter)``.
    """
    plain = parameters.at(w)
    model, dynamics = plain.prepared(), poles(plain)
    low, high = clip_range(model, _FAR)
    observed, columns = len(plain.signals.observed), parameters.latent_columns
    first, last = (columns.min(), columns.max() + 1) if columns.size else (0, 0)
    order = np.argsort(columns, axis=None)
    M = jnp.stack([-dynamics.decay, dynamics.frequency, -dynamics.frequency, -dynamics.decay])
    M = M.T.reshape(-1, 2, 2)

    def slope(x: jax.Array, S: jax.Array, P: jax.Array, v: jax.Array) -> _At:
        value, pull = jax.vjp(lambda x: rate(model, x, v), x)
        (A,) = jax.vmap(pull)(jnp.eye(observed, len(x)))
        inputs = model.join(x, *exogenous_groups(model, v))
        grown = A[:, :observed] @ S + parameters.slopes(w, plain, inputs)
        if columns.size:
            seen = jnp.einsum("skc,kcq->skq", A[:, observed:].reshape(observed, -1, 2), P)
            through = seen.reshape(observed, -1)[:, order]
            grown = grown.at[:, first:last].add(through)
            P = M @ P + parameters.latent_slopes(plain, inputs)
        return value, grown, P

    def advance(at: _At, drive: tuple[jax.Array, ...]) -> tuple[_At, tuple[jax.Array, jax.Array]]:
        v0, vm, v1 = drive
        k1 = slope(*at, v0)
        k2 = slope(*_moved(at, k1, step / 2), vm)
        k3 = slope(*_moved(at, k2, step / 2), vm)
        k4 = slope(*_moved(at, k3, step), v1)
        total = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
        x, S, P = _moved(at, total, step)
        held = jnp.clip(x, low, high)
        same = held == x
        S = jnp.where(same[:observed, None], S, 0.0)
        P = jnp.where(same[observed:].reshape(-1, 2)[..., None], P, 0.0)
        return (held, S, P), (held, S)

    S0 = jnp.zeros((observed, w.size))
    return jax.lax.scan(advance, (x0, S0, pairs0), (v[:-2:2], v[1::2], v[2::2]))[1]


def _moved(at: _At, k: _At, dt: float) -> _At:
    return at[0] + dt * k[0], at[1] + dt * k[1], at[2] + dt * k[2]


def _start_slopes(parameters: Parametrisation, w: jax.Array, windows: _Windows) -> jax.Array:
    """Slopes of the latent pairs at the starts, ``(window, pair, 2, own)``."""
    columns = parameters.latent_columns
    pairs, own = columns.shape
    if not pairs:
        return jnp.zeros((len(windows.first), 0, 2, own))

    def starts(change: jax.Array) -> jax.Array:
        # Each pair follows its own parameters, so one direction serves all pairs.
        moved = w.at[columns].add(change)
        latent = _starts(parameters.at(moved), windows)[:, -2 * pairs :]
        return latent.reshape(-1, pairs, 2)

    return jax.jacfwd(starts)(jnp.zeros(own))


def _starts(model: DFSM, windows: _Windows) -> jax.Array:
    """States at the start of every window; latent ones follow from the inputs before it."""
    measured = jnp.asarray(windows.states[:, 0])
    if not model.signals.latents:
        return measured
    record = jnp.asarray(windows.record)
    h = jnp.full(len(record) - 1, windows.step)
    path = as_states(evolve(poles(model), h, record, jnp.asarray(windows.rest)))
    return jnp.concatenate([measured, path[windows.first]], axis=1)

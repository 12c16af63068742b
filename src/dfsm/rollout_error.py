"""The error of rollouts over windows of recorded runs, as a function of a model's parameters.

Exact slopes come from forward sensitivities, S = dξ/dθ, taken through the same Runge-Kutta steps as
the states,

    Ṡ = (∂f̂/∂ξ) S + ∂f̂/∂θ ,

run by run, so that memory does not grow with the number of runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial, reduce
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
# Steps whose slopes are computed at once.
_BLOCK = 48
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


# States, and slopes of the latent pairs.
_At = tuple[jax.Array, jax.Array]


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
        JtJ, Jtr = (reduce(np.add, [p[k] for p in parts]) for k in (0, 1))
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
    each = (starts, slopes, jnp.asarray(windows.inputs))
    xs, S = jax.lax.map(lambda one: follow(*one), each)
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

    Once the path is known, what each step does to the slopes, S ← Φ S + G, follows for all steps
    at once; only that recursion is left to march. A latent pair depends on its own parameters
    alone, so that its slopes are few and travel with the states.

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
    model = parameters.at(w)
    path = _path(parameters, model, step, x0, pairs0, v)
    observed, steps = len(model.signals.observed), len(path.states)

    def along(S: jax.Array, part: _Path) -> tuple[jax.Array, jax.Array]:
        return jax.lax.scan(_advance, S, _transitions(parameters, w, model, step, part))

    # Blocks stay in the cache; beyond the end the last step is repeated, and dropped again.
    size = min(_BLOCK, steps)
    count = -(-steps // size)

    def blocks(a: jax.Array) -> jax.Array:
        end = [(0, count * size - steps)] + [(0, 0)] * (a.ndim - 1)
        return jnp.pad(a, end, mode="edge").reshape(count, size, *a.shape[1:])

    S0 = jnp.zeros((observed, w.size))
    S = jax.lax.scan(along, S0, jax.tree.map(blocks, path))[1]
    return path.states, S.reshape(count * size, *S0.shape)[:steps]


def _advance(S: jax.Array, transition: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    S = transition[0] @ S + transition[1]
    return S, S


def _transitions(
    parameters: Parametrisation, w: jax.Array, model: DFSM, step: float, path: _Path
) -> tuple[jax.Array, jax.Array]:
    """Φ and G of every step, S ← Φ S + G.

    Parameters
    ----------
    parameters, w, model
        What may change, how much it has changed, and the model that makes.
    step
        In s.
    path
        Some steps of the rollout.

    Returns
    -------
    tuple of Array
        Shapes ``(step, observed state, observed state)`` and ``(step, observed state, parameter)``.
    """
    observed, columns = len(model.signals.observed), parameters.latent_columns
    A = jax.vmap(jax.vmap(partial(_state_matrix, model.prepared())))(path.inputs)
    own = A[..., :observed]
    free = path.free[:, :observed]
    weights = _stage_weights(own, step) * free[:, None, :, None]
    through = jnp.einsum("tiab,tibc->tac", weights, own)
    grown = parameters.slopes(w, model, path.inputs, weights)
    if columns.size:
        coupling = A[..., observed:].reshape(*A.shape[:3], -1, 2)
        by_pair = jnp.einsum("tiab,tibkc,tikcq->takq", weights, coupling, path.pairs)
        grown = grown.at[..., columns].add(by_pair)
    return free[..., None] * jnp.eye(observed) + through, grown


class _Path(NamedTuple):
    """A rollout with what happens at the four stages of each step.

    Attributes
    ----------
    states
        At the ends of the steps, ``(step, state)``.
    free
        1 where a state was not held at the end of its range there, else 0; same shape.
    inputs
        I at the stages, ``(step, stage, input)``.
    pairs
        Slopes of the latent pairs at the stages, ``(step, stage, pair, 2, own)``.
    """

    states: jax.Array
    free: jax.Array
    inputs: jax.Array
    pairs: jax.Array


def _path(
    parameters: Parametrisation,
    plain: DFSM,
    step: float,
    x0: jax.Array,
    pairs0: jax.Array,
    v: jax.Array,
) -> _Path:
    """March states and latent slopes; arguments as for `_sensitivities`, `plain` is the model."""
    model, dynamics = plain.prepared(), poles(plain)
    low, high = clip_range(model, _FAR)
    observed = len(plain.signals.observed)
    M = jnp.stack([-dynamics.decay, dynamics.frequency, -dynamics.frequency, -dynamics.decay])
    M = M.T.reshape(-1, 2, 2)

    def slope(at: _At, v: jax.Array) -> tuple[_At, jax.Array]:
        x, P = at
        inputs = model.join(x, *exogenous_groups(model, v))
        grown = M @ P + parameters.latent_slopes(plain, inputs) if P.size else P
        return (rate(model, x, v), grown), inputs

    def advance(at: _At, drive: tuple[jax.Array, ...]) -> tuple[_At, _Path]:
        v0, vm, v1 = drive
        stages = [at]
        k1, i1 = slope(stages[0], v0)
        stages.append(_moved(at, k1, step / 2))
        k2, i2 = slope(stages[1], vm)
        stages.append(_moved(at, k2, step / 2))
        k3, i3 = slope(stages[2], vm)
        stages.append(_moved(at, k3, step))
        k4, i4 = slope(stages[3], v1)
        total = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
        x, P = _moved(at, total, step)
        held = jnp.clip(x, low, high)
        free = jnp.where(held == x, 1.0, 0.0)
        P = P * free[observed:].reshape(-1, 2)[..., None]
        pairs = jnp.stack([s[1] for s in stages])
        return (held, P), _Path(held, free, jnp.stack([i1, i2, i3, i4]), pairs)

    return jax.lax.scan(advance, (x0, pairs0), (v[:-2:2], v[1::2], v[2::2]))[1]


def _moved(at: _At, k: _At, dt: float) -> _At:
    return at[0] + dt * k[0], at[1] + dt * k[1]


def _state_matrix(model: DFSM, inputs: jax.Array) -> jax.Array:
    """∂f̂/∂ξ of the observed states at one input vector, ``(observed state, state)``."""
    x, *others = model.split(inputs)
    observed = len(model.signals.observed)
    return jax.jacrev(lambda x: model.derivative(x, *others)[:observed])(x)


def _stage_weights(A: jax.Array, h: float) -> jax.Array:
    """How what is added to dS/dt at each of the four stages of a step enters S at its end.

    Parameters
    ----------
    A
        ∂f̂/∂ξ at the stages, ``(step, stage, state, state)``.
    h
        Length of the steps in s.

    Returns
    -------
    Array
        Matrices of the same shape; from unrolling the classical Runge-Kutta step.
    """
    _, A2, A3, A4 = (A[:, i] for i in range(4))
    one = jnp.broadcast_to(jnp.eye(A.shape[-1]), A2.shape)
    w3 = 2 * one + h * A4
    w2 = 2 * one + h / 2 * w3 @ A3
    w1 = one + h / 2 * w2 @ A2
    return h / 6 * jnp.stack([w1, w2, w3, one], axis=1)


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

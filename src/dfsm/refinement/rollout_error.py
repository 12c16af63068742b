"""The error of rollouts over windows of recorded runs, as a function of a model's parameters.

Least squares, generalised where runs have the same disturbances: what a model does not see of these
errs in all of them alike, so that their errors r₁ … r_m correlate, by ρ say, and

    (Σ |rᵢ|² - ρ / (1 + (m - 1) ρ) |Σ rᵢ|²) / (1 - ρ)

is what counts (Aitken 1935, for equal correlations). It weighs differences between such runs, which
are what controls and states do, more than what the runs have in common. Slopes come run by run, so
that memory does not grow with the number of runs.
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
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Trajectory
from dfsm.models.completion import completed
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import Poles, as_states, evolve, poles
from dfsm.models.past import with_past
from dfsm.models.recorded import recorded_states
from dfsm.models.wakes import wakes_along
from dfsm.numerics.filters import moving_average
from dfsm.refinement.growth import StabilityKept
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.slopes import FAR, sensitivities, spread_steps
from dfsm.simulation.integrate import rk4, stages

# JᵀJ is summed over the middle one of every four steps, and over more where windows have few:
# products of the matrices of slopes would be most of the time. Jᵀr is exact.
_EVERY, _FEWEST = 4, 10


@dataclass(frozen=True)
class Record:
    """One run on an equidistant mesh.

    Attributes
    ----------
    step
        In s.
    before
        Steps before the first state, on what was recorded and what `with_past` puts in front of
        it; latent states need them.
    states, slopes
        Observed states and their derivatives, shape ``(step + 1, state)``.
    inputs
        Exogenous inputs at ends and middles of all steps, those before the first state included,
        ``(2 (before + step) + 1, exogenous)``.
    rest
        Controls and disturbances before those steps.
    held
        Which exogenous inputs are the same throughout each step, as in its middle,
        ``(exogenous,)``; None where none is.
    """

    step: float
    before: int
    states: Array
    slopes: Array
    inputs: Array
    rest: Array
    held: NDArray[np.bool_] | None = None

    def driving(self) -> tuple[Array, Array | None]:
        """Controls and disturbances at the ends of steps, and where some jump, as each ends."""
        n, v = len(self.rest), self.inputs
        if self.held is None:
            return v[::2, :n], None
        begin, _, end = (np.asarray(part)[:, :n] for part in stages(from_host(v), self.held))
        return np.concatenate([begin, v[-1:, :n]]), end

    def follow(self, filters: Poles) -> Array:
        """Latent pairs at all ends of steps, complex, ``(before + step + 1, pair)``."""
        h = np.full(len(self.inputs) // 2, self.step)
        v, ends = self.driving()
        ends = None if ends is None else from_host(ends)
        return np.asarray(evolve(filters, h, from_host(v), from_host(self.rest), ends))

    def latent_states(self, model: DFSM) -> Array:
        """A model's latent states from the first state on, ``(step + 1, latent)``."""
        pairs = np.asarray(as_states(from_host(self.follow(poles(model))[self.before :])))
        seen = from_host(self.states), from_host(self.inputs[2 * self.before :: 2])
        wakes = wakes_along(model, self.step, *seen, from_host(pairs))
        return np.concatenate([wakes, pairs], axis=1)

    def inputs_at(self, model: DFSM) -> Array:
        """I along the record, ``(step + 1, input)``."""
        states, exogenous = self._along(model)
        return np.asarray(model.join(from_host(states), *exogenous))

    def _along(self, model: DFSM) -> tuple[Array, Any]:
        states = np.concatenate([self.states, self.latent_states(model)], axis=1)
        inputs = from_host(self.inputs[2 * self.before :: 2])
        return states, model.signals.order.split_exogenous(inputs)

    def left_over(self, model: DFSM) -> Array:
        """Recorded minus modelled derivatives of the observed states, ``(step + 1, state)``."""
        states, exogenous = self._along(model)
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
    run = completed(run, s)
    kinds = s.between_samples()
    recorded = recorded_states(model, run, start)
    window = run.window(start, stop)
    count = int(window.duration / step * (1 + 1e-9))
    held = np.array([kind == "hold" for kind in kinds], dtype=bool)
    driven, _, mean = with_past(run.select(s.exogenous).require_finite(), held)
    before = int((window.time[0] - driven.time[0]) / step * (1 + 1e-9))
    mesh = window.time[0] + step / 2 * np.arange(-2 * before, 2 * count + 1)
    dense = run.time_step is not None and run.time_step < step / 2
    inputs = [
        np.interp(mesh, driven.time, moving_average(driven.time, v, step) if dense else v)
        for v in driven.values.T
    ]
    for k in np.flatnonzero(held):
        inputs[k] = _held_along(mesh, driven.time, driven.values[:, k])
    at = mesh[2 * before :: 2]
    slopes = [
        np.interp(at, recorded.found.trajectory.time, d) for d in recorded.found.derivatives.T
    ]
    return Record(
        step,
        before,
        recorded.at(at),
        np.stack(slopes, axis=1),
        np.stack(inputs, axis=1),
        mean[: len(s.driving)],
        held if held.any() else None,
    )


def _held_along(mesh: Array, time: Array, values: Array) -> Array:
    """A held input at the ends of steps, and its mean over each of them in their middles.

    Jumps need not be where steps end: the mean is what acts on the states over a step.
    """
    at = values[np.clip(np.searchsorted(time, mesh, side="right") - 1, 0, None)]
    areas = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])
    ends = np.interp(mesh[::2], time, areas)
    at[1::2] = np.diff(ends) / np.diff(mesh[::2])
    return at


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
        Controls and disturbances of the record at the ends of all steps, and before these.
    held, record_ends
        As `Record.held`, and what `Record.driving` says of the record.
    before, along
        Steps of the record before its first state, and from there on the states
        ``(time, state)`` and the exogenous inputs; None for a model without induced velocities.
    """

    step: float
    states: Array
    inputs: Array
    first: IntArray
    record: Array
    rest: Array
    held: NDArray[np.bool_] | None
    record_ends: Array | None
    before: int
    along: tuple[Array, Array] | None


def _windows(record: Record, length: float | None, *, wakes: bool) -> _Windows:
    steps = len(record.states) - 1
    each = steps if length is None else min(steps, round(length / record.step))
    first = np.arange(0, steps - each + 1, each)
    begin = 2 * (first + record.before)
    driving, ends = record.driving()
    return _Windows(
        record.step,
        np.stack([record.states[i : i + each + 1] for i in first]),
        np.stack([record.inputs[i : i + 2 * each + 1] for i in begin]),
        first + record.before,
        driving,
        record.rest,
        record.held,
        ends,
        record.before,
        (record.states, record.inputs[2 * record.before :: 2]) if wakes else None,
    )


@dataclass(frozen=True)
class ErrorWeights:
    """What errors count.

    Attributes
    ----------
    states
        Weights of the observed states' squared errors, shape ``(state,)``.
    correlation
        ρ between the errors of runs with the same disturbances, at least 0 and less than 1.
    decay
        Weight of the parameters' squared deviations.
    """

    states: Array
    correlation: float = 0.0
    decay: float = 0.0

    def whitening(self, runs: int) -> tuple[float, float]:
        """Factors of Σ |rᵢ|² and -|Σ rᵢ|², for so many runs with the same disturbances."""
        if runs == 1:
            return 1.0, 0.0
        own = 1 / (1 - self.correlation)
        return own, own * self.correlation / (1 + (runs - 1) * self.correlation)


class RolloutError:
    """Squared errors of rollouts over windows, with JᵀJ and Jᵀr by forward sensitivities.

    Parameters
    ----------
    parameters
        What may change.
    groups
        Runs to follow; those of one group have the same disturbances at the same times.
    length
        Of the windows in s; None takes whole runs.
    counts
        See `ErrorWeights`.
    kept
        What else adds to the cost.
    """

    def __init__(
        self,
        parameters: Parametrization,
        groups: Sequence[Sequence[Record]],
        length: float | None,
        counts: ErrorWeights,
        kept: StabilityKept | None = None,
    ) -> None:
        self._parameters, self._counts, self._kept = parameters, counts, kept
        wakes = parameters.model.signals.induced > 0
        self._groups = [tuple(_windows(r, length, wakes=wakes) for r in group) for group in groups]
        overall = np.concatenate([r.states for group in groups for r in group]).std(axis=0)
        self._scales = []
        for group in groups:
            spread = np.sqrt(np.mean([r.states.var(axis=0) for r in group], axis=0))
            # A state that hardly moves in one run must not outweigh all others.
            self._scales.append(np.sqrt(counts.states) / np.maximum(spread, 0.1 * overall))
        self._count = sum(w.states[:, 1:].size for group in self._groups for w in group)

    def _over_groups(self, function: Callable[..., Any], weights: Array) -> list[Any]:
        w = from_host(weights)

        def one(group: tuple[_Windows, ...], scale: Array) -> Any:
            factors = self._counts.whitening(len(group))
            return function(self._parameters, w, group, scale, factors)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return list(pool.map(one, self._groups, self._scales))

    def cost(self, weights: Array) -> float:
        """All that is to be made small, infinite where a rollout is not finite."""
        extra = 0.0 if self._kept is None else self._kept.cost(weights)
        if not np.isfinite(extra):
            return np.inf
        decay = self._counts.decay * float(weights @ weights)
        return self.relative(weights) * self._count + decay + extra

    def relative(self, weights: Array) -> float:
        """Mean square of r: 1 is as wrong as a constant; infinite where one is not finite."""
        total = sum(self._over_groups(_square, weights))
        return total / self._count if np.isfinite(total) else np.inf

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ and Jᵀr of all of it."""
        parts = self._over_groups(_products, weights)
        JtJ, Jtr = (reduce(np.add, [p[k] for p in parts]) for k in (0, 1))
        if self._kept is not None:
            kept = self._kept.normal_equations(weights)
            JtJ, Jtr = (a + b for a, b in zip((JtJ, Jtr), kept, strict=True))
        decay = self._counts.decay
        return JtJ + decay * np.eye(len(Jtr)), Jtr + decay * weights


def _square(
    parameters: Parametrization,
    w: jax.Array,
    group: Sequence[_Windows],
    scale: Array,
    factors: tuple[float, float],
) -> float:
    """What the errors over the windows of one group count, by the factors of `whitening`."""
    each = [np.asarray(_errors(parameters, w, windows, scale)) for windows in group]
    own, shared = factors
    return float(own * np.sum(np.square(each)) - shared * np.sum(np.sum(each, axis=0) ** 2))


@eqx.filter_jit
def _errors(
    parameters: Parametrization, w: jax.Array, windows: _Windows, scale: Array
) -> jax.Array:
    """Errors over the windows of one run, scaled, ``(window, time, state)``."""
    model = parameters.at(w).prepared()
    h = jnp.full(windows.states.shape[1] - 1, windows.step)
    follow = jax.vmap(lambda x0, v: rk4(model, x0, h, stages(v, windows.held), FAR))
    xs = follow(_starts(model, windows), jnp.asarray(windows.inputs))
    return (xs[:, 1:, : len(scale)] - windows.states[:, 1:]) * scale


def _products(
    parameters: Parametrization,
    w: jax.Array,
    group: Sequence[_Windows],
    scale: Array,
    factors: tuple[float, float],
) -> tuple[Array, Array]:
    """JᵀJ, nearly, and Jᵀr over the windows of one group; `factors` as in `_square`."""
    own, shared = factors
    errors = [np.asarray(_errors(parameters, w, windows, scale)) for windows in group]
    total = np.sum(errors, axis=0)
    JtJ, Jtr, J_sum = 0.0, 0.0, 0.0
    for windows, r in zip(group, errors, strict=True):
        J, slope = _slopes(parameters, w, windows, scale, own * r - shared * total)
        J = np.asarray(J)
        # NumPy computes one half of this product only, and other threads go on meanwhile.
        JtJ, Jtr = JtJ + own * (J.T @ J), Jtr + np.asarray(slope)
        if shared:
            J_sum = np.add(J_sum, J)
    if shared:
        J_sum = np.asarray(J_sum)
        JtJ = JtJ - shared * (J_sum.T @ J_sum)
    return np.asarray(JtJ), np.asarray(Jtr)


@eqx.filter_jit
def _slopes(
    parameters: Parametrization, w: jax.Array, windows: _Windows, scale: Array, errors: Array
) -> tuple[jax.Array, jax.Array]:
    """Rows of J that stand for all over the windows of one run, and Jᵀ times errors."""
    starts = _starts(parameters.at(w), windows)
    slopes = _start_slopes(parameters, w, windows), _wake_slopes(parameters, w, windows)
    steps = errors.shape[1]
    every = max(1, min(_EVERY, steps // _FEWEST))
    follow = partial(sensitivities, parameters, w, windows.step, every=every)
    along = jax.vmap(lambda v: stages(v, windows.held))(jnp.asarray(windows.inputs))
    each = (starts, slopes, along, jnp.asarray(errors * scale))
    S, totals = jax.lax.map(lambda one: follow(*one), each)
    _, counts = spread_steps(steps, every)
    J = S * (np.sqrt(counts)[:, None] * scale)[..., None]
    return J.reshape(-1, w.size), totals.sum(axis=0)


def _start_slopes(parameters: Parametrization, w: jax.Array, windows: _Windows) -> jax.Array:
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


def _wake_slopes(parameters: Parametrization, w: jax.Array, windows: _Windows) -> jax.Array:
    """Slopes of the marched states at the starts, ``(window, state, parameter)``.

    Those that are measured have none.
    """
    s = parameters.model.signals
    observed = len(s.observed)

    def wakes(w: jax.Array) -> jax.Array:
        return _starts(parameters.at(w), windows)[:, observed : s.marched]

    none = jnp.zeros((len(windows.first), observed, w.size))
    return jnp.concatenate([none, jax.jacrev(wakes)(w)], axis=1) if s.induced else none


def _starts(model: DFSM, windows: _Windows) -> jax.Array:
    """States at the start of every window; latent ones follow from the inputs before it."""
    measured, first = jnp.asarray(windows.states[:, 0]), windows.first
    if not model.signals.latents:
        return measured
    record = jnp.asarray(windows.record)
    h = jnp.full(len(record) - 1, windows.step)
    ends = None if windows.record_ends is None else jnp.asarray(windows.record_ends)
    path = as_states(evolve(poles(model), h, record, jnp.asarray(windows.rest), ends))
    if windows.along is None:
        return jnp.concatenate([measured, path[first]], axis=1)
    before, (states, inputs) = windows.before, map(jnp.asarray, windows.along)
    wakes = wakes_along(model, windows.step, states, inputs, path[before:])
    return jnp.concatenate([measured, wakes[first - before], path[first]], axis=1)

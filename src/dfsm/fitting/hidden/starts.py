"""Starts that lead somewhere: linear systems by subspaces and rollouts, then units at random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_continuous_lyapunov

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.sensors import Sensed
from dfsm.fitting.hidden.windows import Standard, Windows
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Step
from dfsm.numerics.subspace import Observability, observability, outputs_first, rate_of

# Samples that a subspace is found from.
_SUBSPACE = 20_000
_RIDGE = 1e-9
# Half-ranges of the recorded outputs within which those under other inputs are expected.
_BEYOND = 1.6
# Times that the weight of parameters follows the errors in the course of a search.
_STAGES = 3


@dataclass(frozen=True)
class Candidate:
    """A form, its weights, their mean squared error on data left out, and the steps they took."""

    form: Form
    weights: Array
    error: float
    steps: int

    @property
    def parameters(self) -> Array:
        """Without the states at the starts of windows."""
        return self.weights[: self.form.size]


def subspace(records: Sequence[Trajectory], standard: Standard, states: int) -> Observability:
    """What outputs tell of up to so many states."""
    ny = len(standard.outputs[0])
    mean, scale = (
        np.concatenate(pair) for pair in zip(standard.outputs, standard.inputs, strict=True)
    )
    pairs, seen = [], 0
    for record in records:
        if seen >= _SUBSPACE:
            break
        steps = round(record.duration / standard.step)
        mesh = record.time[0] + standard.step * np.arange(min(steps + 1, _SUBSPACE - seen))
        even = record if np.allclose(np.diff(record.time), standard.step, rtol=1e-3) else None
        table = (
            record.resample(mesh[mesh <= record.time[-1]]).values
            if even is None
            else record.values[:_SUBSPACE]
        )
        z = (table - mean) / scale
        pairs.append((z[:, ny:], z[:, :ny]))
        seen += len(z)
    return observability(pairs, states)


def behind_sensors(start: Candidate, sensed: Sensed, windows: Windows) -> Candidate:
    """A linear system of what instruments see, from one of what would be seen without them."""
    form, p = replace(start.form, sensors=sensed.sensors), start.form.size
    weights = np.concatenate([start.weights[:p], sensed.levels, start.weights[p:]])
    return improved(form, windows, weights, 0.0, 20)


def linear_start(found: Observability, form: Form, windows: Windows) -> Candidate:
    """A linear system with states of spread one: dynamics by subspaces, inputs by least squares."""
    n = form.states
    A, C = found.system(min(n, found.matrix.shape[1]))
    if len(A) < n:
        more = n - len(A)
        A = np.block(
            [[A, np.zeros((len(A), more))], [np.zeros((more, len(A))), 0.5 * np.eye(more)]]
        )
        C = np.pad(C, ((0, 0), (0, more)))
    A = rate_of(outputs_first(A, C), 1.0)
    error = HiddenError(form, windows)
    weights = np.zeros(error.size)
    L = np.zeros((n, form.width + 1))
    L[:, :n] = A
    weights[: form.size] = L.ravel()
    free = np.ones(error.size, dtype=bool)
    free[: form.size] = np.pad(
        np.zeros((n, n), bool), ((0, 0), (0, form.width + 1 - n)), constant_values=True
    ).ravel()
    weights = _solved(error, weights, free)
    weights = rescaled(form, weights, error.paths(weights))
    return improved(form, windows, weights, 0.0, 20)


def _solved(error: HiddenError, weights: Array, free: NDArray[np.bool_]) -> Array:
    """The best of some weights in which the errors are linear."""
    JtJ, Jtr = error.normal_equations(weights)
    JtJ, Jtr = JtJ[np.ix_(free, free)], Jtr[free]
    ridge = _RIDGE * np.trace(JtJ) / len(Jtr) * np.eye(len(Jtr))
    weights = weights.copy()
    weights[free] -= np.linalg.solve(JtJ + ridge, Jtr)
    return weights


def rescaled(form: Form, weights: Array, paths: Array) -> Array:
    """The same linear system with hidden states of mean zero and spread one."""
    n, ny = form.states, form.outputs
    flat = paths.reshape(-1, n)
    mean, scale = flat.mean(axis=0), flat.std(axis=0)
    mean[:ny], scale[:ny] = 0.0, 1.0
    scale = np.where(np.isfinite(scale) & (scale > 1e-9), scale, 1.0)
    mean = np.where(np.isfinite(mean), mean, 0.0)
    L = weights[: form.size].reshape(n, -1).copy()
    L[:, -1] += L[:, :n] @ mean
    L[:, :n] *= scale
    L /= scale[:, None]
    starts = (weights[form.size :].reshape(-1, n) - mean) / scale
    return np.concatenate([L.ravel(), starts.ravel()])


def improved(form: Form, windows: Windows, weights: Array, decay: float, limit: int) -> Candidate:
    """Step so many times, and take those of the second half that meets data left out best.

    Data left out judge, and do not end a search early: in a short record they hold events that no
    other part of it does, and errors there rise before they fall.
    """
    error = HiddenError(form, windows)
    judged = bool(windows.left_out.any())

    def on_left_out(weights: Array) -> float:
        return error.left_out(weights) if judged else error.trained(weights)

    best, least, taken, last = weights, np.inf, 0, weights
    stage, count = -(-limit // _STAGES), 0
    for _ in range(_STAGES):
        # What the errors are decides what a parameter of one may cost.
        trained = error.trained(last)
        weighed = HiddenError(form, windows, decay * trained * form.weighed)
        for step in islice(LevenbergMarquardt(weighed, Step(last), 0.0), stage):
            count, last = count + 1, step.weights
            if 2 * count >= limit and (now := on_left_out(last)) <= least:
                best, least, taken = last, now, count
    if not np.isfinite(least):
        best, least = last, on_left_out(last)
    return Candidate(form, best, least, taken)


def runs_away(candidate: Candidate, windows: Windows) -> bool:
    """Whether outputs go where none was recorded, under recorded inputs in the opposite order."""
    outputs = HiddenError(candidate.form, windows.reversed()).outputs(candidate.weights)
    recorded = windows.y[(windows.used + windows.left_out) > 0]
    middle = (recorded.max(axis=0) + recorded.min(axis=0)) / 2
    half = np.maximum(np.ptp(recorded, axis=0) / 2, 1e-12)
    return not bool(np.all(np.abs(outputs - middle) <= _BEYOND * half))


def nonlinear_start(linear: Candidate, form: Form, seed: int) -> Array:
    """Weights of a form that does what a linear candidate does, with units drawn at random."""
    rng = np.random.default_rng(seed)
    levels = form.outputs if form.sensors else 0
    parts = [linear.parameters[: linear.form.size - levels]]
    if form.kind == "polynomial":
        parts.append(np.zeros(form.states * len(form.factors)))
    elif form.kind == "tanh":
        directions = rng.standard_normal((form.units, form.width)) / np.sqrt(form.width)
        middles = rng.uniform(-1, 1, (form.units, 1))
        parts += [np.concatenate([directions, middles], axis=1).ravel()]
        parts += [np.zeros(form.states * form.units)]
    return np.concatenate([*parts, linear.weights[linear.form.size - levels :]])


def contracting(linear: Candidate, margin: float) -> Candidate:
    """A linear candidate in the parameters of a form whose rollouts come together.

    The metric is block-diagonal in measured and hidden states, from Lyapunov's equation, after the
    hidden states have been turned so that it is; P of the measured ones stays as it is.
    """
    form, n, ny = linear.form, linear.form.states, linear.form.outputs
    count = form.states * (form.width + 1)
    L, levels = linear.parameters[:count].reshape(n, -1).copy(), linear.parameters[count:]
    starts = linear.weights[form.size :].reshape(-1, n)
    A = L[:, :n]
    growth = np.linalg.eigvals(A).real.max()
    A -= max(0.0, growth + 2 * margin) * np.eye(n)
    P = solve_continuous_lyapunov((A + 1.5 * margin * np.eye(n)).T, -2 * 0.1 * np.eye(n))
    P /= np.trace(P) / n
    T = np.eye(n)
    if n > ny:
        low = cholesky(P[ny:, ny:])
        T[ny:] = np.concatenate([low @ np.linalg.solve(P[ny:, ny:], P[ny:, :ny]), low], axis=1)
    inverse = np.linalg.inv(T)
    P = inverse.T @ P @ inverse
    P = (P + P.T) / 2
    A, rest, starts = T @ A @ inverse, T @ L[:, n:], starts @ T.T
    symmetric = -(P @ A + (P @ A).T) / 2 - margin * P
    values, vectors = np.linalg.eigh(symmetric)
    R = cholesky((vectors * np.maximum(values, 1e-6)) @ vectors.T, lower=True)
    skew = (P @ A - (P @ A).T) / 2
    M = np.tril(R) + np.triu(skew, 1)
    stable = replace(form, metric=tuple(map(tuple, P.tolist())), margin=margin, room=0)
    linear_part = np.concatenate([M, rest], axis=1).ravel()
    weights = np.concatenate([linear_part, levels, starts.ravel()])
    return Candidate(stable, weights, linear.error, linear.steps)

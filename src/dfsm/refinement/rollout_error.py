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
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.refinement.growth import StabilityKept
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import Record
from dfsm.refinement.slopes import FAR, path_of, sensitivities, slope_of_sum, spread_steps
from dfsm.refinement.windows import Windows, start_slopes, starts, windows_of
from dfsm.simulation.integrate import rk4, stages

# JᵀJ is summed over the middle one of every four steps, and over more where windows have few:
# products of the matrices of slopes would be most of the time.
_EVERY, _FEWEST = 4, 10


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
    """Squared errors of rollouts over windows, with Jᵀr exactly and JᵀJ nearly, see `slopes.py`.

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
        self._groups = [
            tuple(windows_of(r, length, wakes=wakes) for r in group) for group in groups
        ]
        overall = np.concatenate([r.states for group in groups for r in group]).std(axis=0)
        self._scales = []
        for group in groups:
            spread = np.sqrt(np.mean([r.states.var(axis=0) for r in group], axis=0))
            # A state that hardly moves in one run must not outweigh all others.
            self._scales.append(np.sqrt(counts.states) / np.maximum(spread, 0.1 * overall))
        self._count = sum(w.states[:, 1:].size for group in self._groups for w in group)

    def _over_groups(self, function: Callable[..., Any], weights: Array) -> list[Any]:
        w = from_host(weights)

        def one(group: tuple[Windows, ...], scale: Array) -> Any:
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
        """JᵀJ, nearly, and Jᵀr of all of it."""
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
    group: Sequence[Windows],
    scale: Array,
    factors: tuple[float, float],
) -> float:
    """What the errors over the windows of one group count, by the factors of `whitening`."""
    each = [np.asarray(_errors(parameters, w, windows, scale)) for windows in group]
    own, shared = factors
    return float(own * np.sum(np.square(each)) - shared * np.sum(np.sum(each, axis=0) ** 2))


@eqx.filter_jit
def _errors(parameters: Parametrization, w: jax.Array, windows: Windows, scale: Array) -> jax.Array:
    """Errors over the windows of one run, scaled, ``(window, time, state)``."""
    model = parameters.at(w).prepared()
    h = jnp.full(windows.states.shape[1] - 1, windows.step)
    follow = jax.vmap(lambda x0, v: rk4(model, x0, h, stages(v, windows.held), FAR))
    xs = follow(starts(model, windows), jnp.asarray(windows.inputs))
    return (xs[:, 1:, : len(scale)] - windows.states[:, 1:]) * scale


def _products(
    parameters: Parametrization,
    w: jax.Array,
    group: Sequence[Windows],
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
    parameters: Parametrization, w: jax.Array, windows: Windows, scale: Array, errors: Array
) -> tuple[jax.Array, jax.Array]:
    """Rows of J that stand for all over the windows of one run, and Jᵀ times errors."""
    model = parameters.at(w).prepared()
    start, back = jax.vjp(lambda w: starts(parameters.at(w), windows), w)
    slopes = start_slopes(parameters, w, windows)
    steps = errors.shape[1]
    every = max(1, min(_EVERY, steps // _FEWEST))

    def follow(
        x0: jax.Array, slopes0: tuple[jax.Array, jax.Array], v: jax.Array, e: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        path = path_of(model, windows.step, x0, stages(v, windows.held))
        S = sensitivities(parameters, w, windows.step, path, slopes0, every)
        return S, *slope_of_sum(parameters, w, windows.step, path, e)

    each = (start, slopes, jnp.asarray(windows.inputs), jnp.asarray(errors * scale))
    S, at_start, totals = jax.lax.map(lambda one: follow(*one), each)
    _, counts = spread_steps(steps, every)
    J = S * (np.sqrt(counts)[:, None] * scale)[..., None]
    return J.reshape(-1, w.size), totals.sum(axis=0) + back(at_start)[0]

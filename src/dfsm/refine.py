"""Rollout refinement: from the derivative fit as the start, minimise the simulation error.

A derivative fit answers what the state does next; a user asks where it is in ten minutes. Small
errors of the derivative that always point the same way, such as missing damping, cost little in the
first and everything in the second. Here the coefficients change until rollouts over windows of the
training runs follow the record,

    min_w  Σ_windows Σ_t |(ξ̂(t; w) - ξ(t)) / σ|² ,

with exact forward sensitivities through the integrator and Levenberg-Marquardt. Windows grow stage
by stage: over short ones a poor start does no harm, over long ones slow errors show. Runs held out
of the training decide when to stop, and a model that is no better on them is not handed out.
"""

from __future__ import annotations

import os
import time as clock
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.corrective.levenberg_marquardt import Step, levenberg_marquardt
from dfsm.derivatives import differentiate
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.filters import moving_average
from dfsm.integrate import rk4
from dfsm.model import DFSM
from dfsm.parametrise import Parametrisation
from dfsm.progress import track
from dfsm.settings import require, settings
from dfsm.signals import Provenance, with_computed
from dfsm.trajectory import Dataset, Trajectory
from dfsm.types import Array

# Steps without progress on the validation runs after which a stage ends.
_PATIENCE = 6
# Damping at the start of a stage, relative to the mean curvature.
_DAMPING = 1e-3
# A rollout that leaves the training range this many half-ranges from its middle is cut off there:
# the error stays finite and still has a slope.
_FAR = 30.0


@settings
class RefineSettings:
    """How a model is refined on rollouts.

    Attributes
    ----------
    windows
        Lengths of the rollouts in s, one stage after the other; None is a whole run.
    step
        Integration step in s; inputs are averaged over it.
    iterations
        Largest number of Levenberg-Marquardt steps per stage.
    hold_out
        Share of the runs that only decide when to stop, at least one.
    weights
        Weight of a state's squared error, by name; 1 where nothing is given.
    seconds
        No further step is begun after this time; None sets no limit.
    """

    windows: tuple[float | None, ...] = (20.0, 100.0, None)
    step: float = 0.25
    iterations: int = 20
    hold_out: float = 0.2
    weights: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None

    def __post_init__(self) -> None:
        require(bool(self.windows), "refine.windows", self.windows, "at least one length")
        for length in self.windows:
            good = length is None or length > self.step
            require(good, "refine.windows", length, "lengths in s, longer than refine.step")
        require(self.step > 0, "refine.step", self.step, "more than 0 s")
        require(self.iterations >= 1, "refine.iterations", self.iterations, "at least 1")
        require(0 < self.hold_out < 1, "refine.hold_out", self.hold_out, "a share between 0 and 1")
        for name, weight in self.weights.items():
            require(weight >= 0, f"refine.weights.{name}", weight, "0 or more")


@dataclass(frozen=True)
class RefineResult:
    """What `refine` returns.

    Attributes
    ----------
    model
        The refined model, or the one given where refinement did not help.
    improved
        Whether it is the refined one.
    before, after
        Mean squared error of the validation rollouts relative to each state's variance, over
        the last of the windows; `after` is that of the best refined model.
    history
        One entry per step: stage, training and validation error.
    message
        The outcome in one sentence.
    """

    model: DFSM
    improved: bool
    before: float
    after: float
    history: tuple[dict[str, float], ...]
    message: str


def refine(
    model: DFSM,
    runs: Iterable[Trajectory],
    choices: RefineSettings | None = None,
    *,
    start: float | None = None,
    stop: float | None = None,
    seed: int = 0,
) -> RefineResult:
    """Refine a model on rollouts over training runs.

    Parameters
    ----------
    model
        Where to start: all coefficients of its derivative function may change, linear and
        corrective ones; kinematic rows and outputs stay.
    runs
        Training runs; some of them are held out to decide when to stop.
    choices
        See `RefineSettings`; None takes the defaults.
    start, stop
        Time window in s, as in the fit.
    seed
        Decides which runs are held out.

    Returns
    -------
    RefineResult
        A refined model is never worse on the runs held out than its start.

    Raises
    ------
    DfsmError
        Fewer than two runs, runs too short for the windows, or an unknown state in the weights.

    Warns
    -----
    DfsmWarning
        Refinement did not help and the model given is returned.
    """
    choices = choices or RefineSettings()
    training, validation = Dataset(runs).split(choices.hold_out, seed)
    weights = _weights(model, choices)
    train = [_record(model, run, choices.step, start, stop) for run in training]
    held = [_record(model, run, choices.step, start, stop) for run in validation]
    spread = np.sqrt(np.mean([np.mean(r.slopes**2, axis=0) for r in train], axis=0))
    parameters = Parametrisation.of(model, spread)
    began = clock.perf_counter()

    def late() -> bool:
        return choices.seconds is not None and clock.perf_counter() - began > choices.seconds

    final = _RolloutError(parameters, held, choices.windows[-1], weights)
    before = final.relative(np.zeros(parameters.size))
    best, after = np.zeros(parameters.size), before
    history: list[dict[str, float]] = []
    at = best
    for stage, length in enumerate(choices.windows):
        problem = _RolloutError(parameters, train, length, weights)
        check = _RolloutError(parameters, held, length, weights)
        at, found = _stage(problem, check, at, choices.iterations, late)
        history += [{"stage": stage, **entry} for entry in found]
        error = final.relative(at)
        if error < after:
            best, after = at, error
    names = {"training": [r.name for r in training], "validation": [r.name for r in validation]}
    return _result(model, parameters, best, (before, after), history, names)


# -- records ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Record:
    """One run on the mesh of the refinement: states and slopes at steps, inputs also between."""

    step: float
    states: Array
    slopes: Array
    inputs: Array


def _record(
    model: DFSM, run: Trajectory, step: float, start: float | None, stop: float | None
) -> _Record:
    s = model.signals
    run = with_computed(run, s.hub_height, s.features)
    found = differentiate(run, s.specs, s.derivatives)
    window = run.window(start, stop)
    count = int((window.time[-1] - window.time[0]) / step * (1 + 1e-9))
    mesh = window.time[0] + step / 2 * np.arange(2 * count + 1)
    run.select(s.exogenous).require_finite()
    dense = run.time_step is not None and run.time_step < step / 2
    inputs = [
        np.interp(mesh, run.time, moving_average(run.time, run[n], step) if dense else run[n])
        for n in s.exogenous
    ]
    states = found.trajectory.select(found.names)
    at = mesh[::2]
    slopes = [np.interp(at, run.time, d) for d in found.derivatives.T]
    return _Record(
        step, states.resample(at).values, np.stack(slopes, axis=1), np.stack(inputs, axis=1)
    )


def _weights(model: DFSM, choices: RefineSettings) -> Array:
    names = model.signals.names("states")
    unknown = [n for n in choices.weights if n not in names]
    if unknown:
        raise DfsmError(
            f"refine.weights names '{unknown[0]}', which is no state: choose among "
            f"{', '.join(names)}"
        )
    return np.array([choices.weights.get(n, 1.0) for n in names])


# -- rollout errors and their slopes ------------------------------------------------------------


class _RolloutError:
    """|r|² of rollouts over windows, with JᵀJ and Jᵀr by forward sensitivities, run by run."""

    def __init__(
        self,
        parameters: Parametrisation,
        records: Sequence[_Record],
        length: float | None,
        weights: Array,
    ) -> None:
        self._batches = [_windows(r, length) for r in records]
        overall = np.concatenate([r.states for r in records]).std(axis=0)
        self._scales = [
            # A state that hardly moves in one run must not outweigh all others.
            np.sqrt(weights) / np.maximum(r.states.std(axis=0), 0.1 * overall)
            for r in records
        ]
        self._count = sum(states[:, 1:].size for _, states, _ in self._batches)

        def residual(w: jax.Array, h: float, states: Array, inputs: Array, scale: Array):
            model = parameters.at(w).prepared()
            steps = jnp.full(states.shape[1] - 1, h)
            xs = jax.vmap(lambda x0, v: rk4(model, x0, steps, v, _FAR))(states[:, 0], inputs)
            return ((xs - states)[:, 1:] * scale).ravel()

        def sums(w: jax.Array, *record: Any) -> tuple[jax.Array, jax.Array]:
            r, slopes = jax.linearize(lambda w: residual(w, *record), w)
            J = jax.vmap(slopes)(jnp.eye(w.size))
            return J @ J.T, J @ r

        self._sums = jax.jit(sums)
        self._square = jax.jit(lambda w, *record: jnp.sum(residual(w, *record) ** 2))

    def _over_runs(self, function: Callable[..., Any], weights: Array) -> list[Any]:
        w = jnp.asarray(weights)

        def one(k: int) -> Any:
            return jax.block_until_ready(function(w, *self._batches[k], self._scales[k]))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return list(pool.map(one, range(len(self._batches))))

    def cost(self, weights: Array) -> float:
        """|r|², infinite where a rollout is not finite."""
        total = float(np.sum([float(v) for v in self._over_runs(self._square, weights)]))
        return total if np.isfinite(total) else np.inf

    def relative(self, weights: Array) -> float:
        """Mean square of r: 1 is as wrong as a constant."""
        return self.cost(weights) / self._count

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ and Jᵀr."""
        parts = self._over_runs(self._sums, weights)
        JtJ, Jtr = (np.sum([np.asarray(p[k]) for p in parts], axis=0) for k in (0, 1))
        return JtJ, Jtr


def _windows(record: _Record, length: float | None) -> tuple[float, Array, Array]:
    """Step, states ``(window, time, state)`` and inputs ``(window, 2 time - 1, input)``."""
    steps = len(record.states) - 1
    each = steps if length is None else min(steps, round(length / record.step))
    first = np.arange(0, steps - each + 1, each)
    states = np.stack([record.states[i : i + each + 1] for i in first])
    inputs = np.stack([record.inputs[2 * i : 2 * (i + each) + 1] for i in first])
    return record.step, states, inputs


# -- stages -------------------------------------------------------------------------------------


def _stage(
    problem: _RolloutError,
    check: _RolloutError,
    start: Array,
    limit: int,
    late: Callable[[], bool],
) -> tuple[Array, list[dict[str, float]]]:
    """Step until the validation windows no longer improve; the best weights and the history."""
    if not np.isfinite(problem.cost(start)):
        return start, []
    curvature = np.trace(problem.normal_equations(start)[0]) / len(start)
    best, error, taken = start, check.relative(start), 0
    history: list[dict[str, float]] = []
    steps = levenberg_marquardt(problem, Step(start, _DAMPING * curvature), 0.0)
    for count, step in enumerate(track(islice(steps, limit), "refining", limit), start=1):
        now = check.relative(step.weights)
        history.append({"training": problem.relative(step.weights), "validation": now})
        if now < error:
            best, error, taken = step.weights, now, count
        if count - taken >= _PATIENCE or late():
            break
    return best, history


def _result(
    model: DFSM,
    parameters: Parametrisation,
    best: Array,
    errors: tuple[float, float],
    history: Sequence[dict[str, float]],
    names: Mapping[str, list[str]],
) -> RefineResult:
    before, after = errors
    improved = after < before
    figures = f"{np.sqrt(before):.3g} to {np.sqrt(after):.3g}"
    if improved:
        message = (
            f"refined on {len(names['training'])} runs: the error of rollouts over those held out "
            f"({', '.join(names['validation'])}) went from {figures} standard deviations"
        )
        record = dict(model.provenance.record)
        record["refinement"] = {**names, "before": before, "after": after, "message": message}
        model = replace(parameters.at(jnp.asarray(best)), provenance=Provenance(record))
    else:
        message = (
            "refinement did not lower the error of rollouts over the runs held out, so the model "
            "it started from is returned: use more runs, or shorter refine.windows"
        )
        warnings.warn(message, DfsmWarning, stacklevel=3)
    return RefineResult(model, improved, before, after, tuple(history), message)

"""Hidden states in use: told by a window of past inputs and outputs, by least squares.

The state at the beginning of the window is the one whose rollout meets the recorded outputs best;
where hardly anything tells a hidden state, it stays near what it was on average in training.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.completion import completed
from dfsm.models.dfsm import DFSM
from dfsm.models.inputs import GROUPS
from dfsm.models.latents import latent_path, latent_state
from dfsm.models.recorded import recorded_states
from dfsm.models.terms.sensor import Sensor, SensorTerm
from dfsm.models.wakes import settled_wakes, wakes_along
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Step
from dfsm.simulation.integrate import Stages, mesh_of, rk4, stages_of

# Weight of a hidden state's deviation from its mean, relative to its spread, beside an output's.
_PRIOR = 1e-2
_ITERATIONS = 30
# A window may be shorter than asked for by this share, where a record begins late.
_SHORTER = 0.5
# Training half-ranges within which a rollout of a trial stays.
_BOUND = 20.0


# Inputs at the start, the middle and the end of every step.
_Drive = tuple[Array, Array, Array]


def _stages(drive: _Drive) -> Stages:
    begin, middle, end = drive
    return jnp.asarray(begin), jnp.asarray(middle), jnp.asarray(end)


def pairs_from_past(model: DFSM, run: Trajectory, start: float) -> Array:
    """Latent states at a time in s, but for induced velocities, of what was recorded up to it."""
    if not model.signals.startup:
        return latent_state(model, run, start)
    return told_state(model, run, start)[len(model.signals.observed) :]


def latents_from_past(model: DFSM, run: Trajectory, start: float, observed: Array) -> Array:
    """Latent states at a time in s, ``(latent,)``, of what was recorded up to it.

    Induced velocities are those that `observed`, the other states ``(state,)``, lead to.
    """
    s, pairs = model.signals, pairs_from_past(model, run, start)
    if not s.induced:
        return pairs
    now = max(0, int(np.searchsorted(run.time, start, side="right")) - 1)
    exogenous = s.order.split_exogenous(jnp.asarray([run[n][now] for n in s.exogenous]))
    states = np.concatenate([observed, np.zeros(s.induced), pairs])
    inputs = settled_wakes(model, model.join(states, *exogenous))
    return np.asarray(inputs[s.latent_columns])


def latents_along(model: DFSM, run: Trajectory) -> Array:
    """Latent states along a record, ``(time, latent)``: those of a rollout, for hidden ones."""
    s = model.signals
    if not s.startup:
        pairs = latent_path(model, run)
        return np.concatenate([_wakes_along(model, run, pairs), pairs], axis=1)
    run = completed(run, s)
    start = told_state(model, run, float(run.time[0]))
    states = _Past.of(model, run, measured=False).rollout(model, start)
    return states[:, len(model.signals.observed) :]


def _wakes_along(model: DFSM, run: Trajectory, pairs: Array) -> Array:
    """Induced velocities along a record, ``(time, induced velocity)``."""
    s = model.signals
    if not s.induced:
        return np.zeros((len(run), 0))
    states = recorded_states(model, run).at(run.time)
    seen = (states, run.select(s.exogenous).values, pairs)
    steps = jnp.asarray(np.diff(run.time))
    return np.asarray(wakes_along(model, steps, *map(jnp.asarray, seen)))


def told_state(model: DFSM, run: Trajectory, start: float) -> Array:
    """All states at a time in s, measured ones too, ``(state,)``.

    Parameters
    ----------
    model
        With `SignalTable.startup`.
    run
        Holds its inputs and measured states for that long before `start`; where the record begins
        there, the same time after it.

    Raises
    ------
    DfsmError
        The record is shorter than that.
    """
    s = model.signals
    run = completed(run, s)
    span, step = s.startup * (1 + 1e-9), np.diff(run.time).max()
    if run.duration + step < s.startup:
        raise DfsmError(
            f"{run.where} lasts {run.duration:g} s, less than the {s.startup:g} s from which the "
            "model tells its hidden states: give a longer record, or initial states"
        )
    past = start - run.time[0] >= _SHORTER * s.startup
    window = run.window(start - span, start) if past else run.window(start, start + span)
    told = _Past.of(model, window, measured=True)
    states = told.rollout(model, told.solved(model))
    return states[-1 if past else 0]


@dataclass(frozen=True)
class _Past:
    """A window of a record: steps, inputs along them, and what was measured at every so many.

    Measured states come first, then outputs that tell hidden ones.
    """

    h: Array
    drive: tuple[Array, Array, Array]
    every: int
    measured: Array

    @classmethod
    def of(cls, model: DFSM, window: Trajectory, *, measured: bool) -> _Past:
        s = model.signals
        driven = window.select(s.exogenous).require_finite()
        every = mesh_of(driven, s.step, s.between_samples()).every
        begin, middle, end = (
            part.reshape(int(np.prod(part.shape[:-1])), part.shape[-1])
            for part in stages_of(driven, s.between_samples(), every)
        )
        names = (*s.names("observed"), *s.telling)
        y = window.select(names).require_finite().values if measured else np.empty((0, len(names)))
        h = np.repeat(np.diff(driven.time) / every, every)
        return cls(h, (begin, middle, end), every, y)

    def rollout(self, model: DFSM, start: Array) -> Array:
        """States at the samples, ``(time, state)``."""
        return np.asarray(_follow(model, from_host(start), self.h, self.drive))[:: self.every]

    def solved(self, model: DFSM) -> Array:
        """The state at the beginning that meets what was measured best."""
        problem = _StartError(model, self)
        found = []
        for best in problem.firsts:
            for step in islice(LevenbergMarquardt(problem, Step(best), 0.0), _ITERATIONS):
                best = step.weights
            found.append(best)
        # Where an instrument loses a sign, both are tried.
        return problem.state(found[0] if len(found) == 1 else min(found, key=problem.cost))


class _Seen(NamedTuple):
    """What is measured of states: some as they are, and outputs gain · φ + offset of others."""

    states: int
    sensors: tuple[Sensor, ...]
    columns: list[int]
    gains: Array
    offsets: Array
    std: Array

    @classmethod
    def of(cls, model: DFSM) -> _Seen:
        s, terms = model.signals, model.terms
        if terms is None or model.g is None or not s.telling:
            none = np.zeros(0)
            return cls(len(s.observed), (), [], none, none, none)
        rows = [s.names("outputs").index(n) for n in s.telling]
        parts = [part for part in terms.parts if isinstance(part, SensorTerm)]
        gains = np.asarray(model.g.coefficients)[0, rows, len(s.inputs) + np.arange(len(rows))]
        return cls(
            len(s.observed),
            tuple(part.sensor for part in parts),
            [part.columns[0] - s.state_columns.start for part in parts],
            gains,
            np.asarray(model.g.offsets)[0, rows],
            np.asarray(terms.std),
        )


class _StartError:
    """Errors of a rollout over the window, by the state at its beginning in training spreads."""

    def __init__(self, model: DFSM, past: _Past) -> None:
        self._model, self._past = model, past
        columns, region = model.signals.state_columns, model.region
        self._mean = np.asarray(region.mean)[columns]
        self._scale = np.asarray(region.scale)[columns]
        seen = _Seen.of(model)
        self._spread = np.concatenate([self._scale[: seen.states], seen.gains * seen.std])
        states = np.tile(self._mean, (2, 1))
        states[:, : seen.states] = past.measured[0, : seen.states]
        for k, (sensor, column) in enumerate(zip(seen.sensors, seen.columns, strict=True)):
            value = (past.measured[0, seen.states + k] - seen.offsets[k]) / seen.gains[k]
            states[:, column] = sensor.behind(value)
        first, other = (states - self._mean) / self._scale
        self.firsts = [first] if np.array_equal(first, other) else [first, other]

    def state(self, weights: Array) -> Array:
        return self._mean + self._scale * weights

    def cost(self, weights: Array) -> float:
        r = self._residuals(from_host(weights))
        total = float(np.sum(np.square(r)))
        return total if np.isfinite(total) else np.inf

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        w = from_host(weights)
        r, J = np.asarray(self._residuals(w)), np.asarray(self._slopes(w))
        return J.T @ J, J.T @ r

    def _residuals(self, weights: jax.Array) -> jax.Array:
        return _start_errors(self._model, weights, *self._given)

    def _slopes(self, weights: jax.Array) -> jax.Array:
        return _start_slopes(self._model, weights, *self._given)

    @property
    def _given(self) -> tuple[Any, ...]:
        p = self._past
        return self._mean, self._scale, self._spread, p.h, p.drive, p.measured


@eqx.filter_jit
def _follow(model: DFSM, start: jax.Array, h: Array, drive: _Drive) -> jax.Array:
    along = _stages(drive)
    return rk4(model.prepared(), start, jnp.asarray(h), along, _BOUND)


def _errors(
    model: DFSM,
    w: jax.Array,
    mean: Array,
    scale: Array,
    spread: Array,
    h: Array,
    drive: _Drive,
    y: Array,
) -> jax.Array:
    observed, every = len(model.signals.observed), len(h) // max(1, len(y) - 1)
    along = _stages(drive)
    xs = rk4(model.prepared(), jnp.asarray(mean + scale * w), jnp.asarray(h), along, _BOUND)[
        ::every
    ]
    seen = xs[:, :observed]
    if model.signals.telling:
        # Instruments see states alone.
        none = [jnp.zeros(len(model.signals.names(g))) for g in GROUPS if g != "states"]
        at = [model.signals.names("outputs").index(n) for n in model.signals.telling]
        outputs = model.output(xs, *none)[:, jnp.array(at)]
        seen = jnp.concatenate([seen, outputs], axis=1)
    r = (seen - y) / spread
    return jnp.concatenate([r.ravel(), _PRIOR * w[observed:]])


_start_errors = eqx.filter_jit(_errors)


@eqx.filter_jit
def _start_slopes(model: DFSM, w: jax.Array, *given: Any) -> jax.Array:
    return jax.jacfwd(partial(_errors, model))(w, *given)

"""A recorded run as refinement takes it: states, their slopes and inputs on an equidistant mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.models.completion import completed
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import Poles, as_states, evolve, poles
from dfsm.models.past import with_past
from dfsm.models.recorded import recorded_states
from dfsm.models.wakes import wakes_along
from dfsm.numerics.filters import moving_average
from dfsm.simulation.integrate import stages


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

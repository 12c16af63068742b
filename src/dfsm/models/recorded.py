"""A recorded run as a model sees it where inputs jump: rates, slopes and means that it implies.

Splines through samples know nothing of jumps of the inputs; a model does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array
from dfsm.data.between import kinks, polynomials
from dfsm.data.derivatives import Differentiated, differentiate, lead_in
from dfsm.data.steps import Steps
from dfsm.data.trajectory import Trajectory
from dfsm.models.dfsm import DFSM


class Recorded(NamedTuple):
    """States of a run and their derivatives.

    Attributes
    ----------
    found
        By splines, between the jumps of the inputs.
    steps, slopes
        By the model, at the ends of all intervals; None where derivatives need no model, or where
        it has latent states.
    """

    found: Differentiated
    steps: Steps | None
    slopes: tuple[Array, Array] | None

    @property
    def trajectory(self) -> Trajectory:
        """The run with these states in it."""
        run = self.found.trajectory
        if self.steps is None:
            return run
        values = run.values.copy()
        values[:, run.columns(self.found.names)] = self.steps.states
        return replace(run, values=values)

    def at(self, time: Array) -> Array:
        """The same at other times in s within the run."""
        if self.steps is None or self.slopes is None:
            return self.found.trajectory.select(self.found.names).resample(time).values
        return self.steps.between(self.slopes, time)

    def mean_rows(self, inside: NDArray[np.bool_]) -> tuple[Array, Array, Array] | None:
        """Mean inputs, mean derivatives and lengths in s of intervals, where these are needed.

        `inside` tells the samples of the time window, one after the other.
        """
        if self.steps is None or self.slopes is None or not self.steps.open.any():
            return None
        part = self.steps.window(inside)
        pairs = inside[:-1] & inside[1:]
        begin, end = (side[pairs] for side in self.slopes)
        *rows, _ = part.rows((begin, end))
        return rows[0], rows[1], rows[2]


def recorded_states(model: DFSM, run: Trajectory, start: float | None = None) -> Recorded:
    """Find the states of a run with a model's help where inputs jump.

    Parameters
    ----------
    model
        The surrogate.
    run
        Holds its states, controls, disturbances and parameters.
    start
        First time in s at which states are wanted; what lies well before has no say, see `lead_in`.
    """
    s = model.signals
    if not s.specs:
        # All states are hidden.
        none = np.zeros((len(run), 0))
        return Recorded(Differentiated(run, (), none, (), (), (), np.zeros(0, bool)), None, None)
    run = lead_in(run, start, s.derivatives)
    kinds = s.between_samples()
    breaks = kinks(run, s.driving, kinds[: len(s.driving)])
    found = differentiate(run, s.specs, s.derivatives, breaks)
    if found.direct.all() or s.latents:
        return Recorded(found, None, None)
    inputs = polynomials(run.time, run.select(s.exogenous).values, kinds)
    steps = Steps.of(found, np.ones(len(run), bool), inputs, s.specs, len(s.driving))

    def slopes(inputs: Array) -> Array:
        return np.asarray(model.derivative(*model.split(inputs)))

    return Recorded(found, *steps.settled(slopes))

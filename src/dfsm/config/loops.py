"""What files of closed loops share: model, controller, runs that drive it, their weights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from dfsm.config.parse import Strict
from dfsm.data.trajectory import Trajectory
from dfsm.loops.load_cases import weibull_weights
from dfsm.simulation.loop_cases import ClosedLoopSettings


class Weibull(Strict):
    """Shares of the time by the wind that each run stands for.

    Attributes
    ----------
    mean, shape
        Of the Weibull distribution, in m/s.
    wind
        Channel of the wind; its mean, rounded to whole m/s, is a run's.
    """

    mean: float
    shape: float = 2.0
    wind: str = "RotWind"

    def weights(self, runs: Sequence[Trajectory]) -> list[float]:
        """Share of every run."""
        winds = [float(np.round(run[self.wind].mean())) for run in runs]
        return weibull_weights(winds, self.mean, self.shape)


class LoopsConfig(Strict):
    """Keys that `dfsm tune` and `dfsm sweep` have in common.

    Attributes
    ----------
    model
        Folder that `dfsm fit` made; files are relative to the configuration.
    controller
        ROSCO's DISCON.IN, or file.py:name of a controller of your own.
    runs
        Result files or patterns: what drives the loops.
    weights
        Share of the time of every run (of a scatter table, say), or a Weibull distribution; default
        equal.
    interval
        Seconds between two calls of ROSCO; default the runs' samples. A controller of your own has
        one of its own.
    measure
        Signal of the model by measurement of the controller.
    start, stop, start_up
        Scored time in s, and how long before the loop begins.
    """

    model: str
    controller: str
    runs: str | list[str]
    weights: list[float] | Weibull | None = None
    interval: float | None = None
    measure: dict[str, str] = Field(default_factory=dict)
    start: float | None = None
    stop: float | None = None
    start_up: float = ClosedLoopSettings.start_up

    def shares(self, runs: Sequence[Trajectory]) -> list[float] | None:
        """Weight of every run; None for equal ones.

        Raises
        ------
        DfsmError
            A run lacks the wind that its weight follows.
        """
        return self.weights.weights(runs) if isinstance(self.weights, Weibull) else self.weights

    @property
    def loop(self) -> ClosedLoopSettings:
        """How loops are closed."""
        return ClosedLoopSettings(start_up=self.start_up)

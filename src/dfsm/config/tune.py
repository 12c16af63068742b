"""The file of `dfsm tune`: what to tune, for what, within which limits, over which runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from pydantic import Field

from dfsm.config.parse import Strict, parse_file
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.loops.load_cases import weibull_weights
from dfsm.loops.tuning_problem import Goal, Limit, TuneSettings, TuningProblem
from dfsm.simulation.loop_cases import ClosedLoopSettings

ADVICE = "write one, docs/tuning.md shows how"


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
        return weibull_weights(
            [float(np.round(run[self.wind].mean())) for run in runs], self.mean, self.shape
        )


class TuneConfig(Strict):
    """A whole file of `dfsm tune`.

    Attributes
    ----------
    model
        Folder that `dfsm fit` made; files are relative to the configuration.
    controller
        ROSCO's DISCON.IN, or file.py:name of a controller of your own.
    runs
        Result files or patterns: what drives the loops.
    parameters
        Lowest and highest value by name.
    objective, constraints
        See `Goal` and `Limit`.
    weights
        One number per run, or a Weibull distribution; default equal.
    interval
        Seconds between two calls of ROSCO; default the runs' samples.
    measure
        Signal of the model by measurement of the controller.
    start, stop, start_up
        Scored time in s, and how long before the loop begins.
    starts, seed, iterations, tolerance, pareto
        See `TuneSettings`.
    """

    model: str
    controller: str
    runs: str | list[str]
    parameters: dict[str, tuple[float, float]]
    objective: list[Goal]
    constraints: list[Limit] = Field(default_factory=list)
    weights: list[float] | Weibull | None = None
    interval: float | None = None
    measure: dict[str, str] = Field(default_factory=dict)
    start: float | None = None
    stop: float | None = None
    start_up: float = ClosedLoopSettings.start_up
    starts: int = TuneSettings.starts
    seed: int = TuneSettings.seed
    iterations: int = TuneSettings.iterations
    tolerance: float = TuneSettings.tolerance
    pareto: int = TuneSettings.pareto

    def problem(self, runs: Sequence[Trajectory]) -> TuningProblem:
        """What is asked, over these runs.

        Raises
        ------
        DfsmError
            What `TuningProblem` refuses, or a run without the wind that its weight follows.
        """
        weights = self.weights.weights(runs) if isinstance(self.weights, Weibull) else self.weights
        return TuningProblem(
            parameters=self.parameters,
            objective=self.objective,
            constraints=self.constraints,
            weights=weights,
        )

    def settings(self, start: float | None) -> TuneSettings:
        """How to tune; `start` is that of the fit, where the file names none."""
        own = {f.name for f in fields(TuneSettings)} - {"loop", "start"}
        return TuneSettings(
            **{name: getattr(self, name) for name in own},
            start=start if self.start is None else self.start,
            loop=ClosedLoopSettings(start_up=self.start_up),
        )


def load_tuning(path: Path) -> TuneConfig:
    """Read a file of `dfsm tune`.

    Raises
    ------
    DfsmError
        It is missing or not YAML, or a key is unknown, missing or wrong.
    """
    config = parse_file(path, TuneConfig, ADVICE)
    if not config.objective:
        raise DfsmError(f"{path}: 'objective' has no terms: list what to make small")
    return config

"""The file of `dfsm tune`: what to tune, for what, within which limits, over which runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from pydantic import Field

from dfsm.config.loops import LoopsConfig
from dfsm.config.parse import Strict, parse_file
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.loops.trust_region import TrustSettings
from dfsm.loops.tuning_problem import Goal, Limit, TuneSettings, TuningProblem

ADVICE = "write one as the documentation shows under 'Tuning'"


class Flown(Strict):
    """Where runs of the true system are, or will be.

    Attributes
    ----------
    folder
        See `FlownRuns`.
    flights, tolerance, radius
        See `TrustSettings`.
    """

    folder: str
    flights: int = TrustSettings.flights
    tolerance: float = TrustSettings.tolerance
    radius: float = TrustSettings.radius

    def settings(self) -> TrustSettings:
        """When to stop."""
        return TrustSettings(flights=self.flights, tolerance=self.tolerance, radius=self.radius)


class TuneConfig(LoopsConfig):
    """A whole file of `dfsm tune`.

    Attributes
    ----------
    parameters
        Lowest and highest value by name.
    objective, constraints
        See `Goal` and `Limit`.
    starts, seed, iterations, tolerance, pareto
        See `TuneSettings`.
    truth
        Confirm by runs that you fly, see `Flown`.
    """

    parameters: dict[str, tuple[float, float]]
    objective: list[Goal]
    constraints: list[Limit] = Field(default_factory=list)
    starts: int = TuneSettings.starts
    seed: int = TuneSettings.seed
    iterations: int = TuneSettings.iterations
    tolerance: float = TuneSettings.tolerance
    pareto: int = TuneSettings.pareto
    truth: Flown | None = None

    def problem(self, runs: Sequence[Trajectory]) -> TuningProblem:
        """What is asked, over these runs.

        Raises
        ------
        DfsmError
            What `TuningProblem` refuses, or a run without the wind that its weight follows.
        """
        return TuningProblem(
            parameters=self.parameters,
            objective=self.objective,
            constraints=self.constraints,
            weights=self.shares(runs),
        )

    def settings(self, start: float | None) -> TuneSettings:
        """How to tune; `start` is that of the fit, where the file names none."""
        own = {f.name for f in fields(TuneSettings)} - {"loop", "start"}
        return TuneSettings(
            **{name: getattr(self, name) for name in own},
            start=start if self.start is None else self.start,
            loop=self.loop,
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

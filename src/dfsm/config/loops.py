"""What files of closed loops share: model, controller, runs that drive it, their weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag

from dfsm.config.parse import Strict
from dfsm.core.settings import require_number
from dfsm.core.units import factor, known
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, near_matches
from dfsm.loops.load_cases import weibull_weights
from dfsm.numerics.time_mesh import mean_over, weights_over_time
from dfsm.simulation.loop_cases import ClosedLoopSettings


class Weibull(Strict):
    """Shares of the time by the wind that each run stands for.

    Attributes
    ----------
    mean, shape
        Of the Weibull distribution, in m/s.
    wind
        Channel of the wind; its mean, rounded to multiples of `step`, is a run's.
    step
        In m/s; runs of one rounded mean are seeds of one wind.
    """

    mean: float
    shape: float = 2.0
    wind: str = "RotWind"
    step: float = 1.0

    def winds(self, runs: Sequence[Trajectory]) -> list[float]:
        """Mean wind of every run in m/s.

        Raises
        ------
        DfsmError
            A run without the channel, or one that is no speed; or a step that is not above 0.
        """
        require_number("step of the winds", self.step, "m/s, more than 0", above=0)
        return [self.step * math.floor(self._mean(run) / self.step + 0.5) for run in runs]

    def _mean(self, run: Trajectory) -> float:
        mean = float(mean_over(run[self.wind], weights_over_time([run.time])))
        unit = run.channel(self.wind).unit
        scale = factor(unit, "m/s") if known(unit) else 1.0
        if scale is None:
            raise DfsmError(
                f"{run.where}: weights follow '{self.wind}', which is in '{unit}', expected a "
                "speed: name another channel as their wind"
            )
        return scale * mean

    def weights(self, runs: Sequence[Trajectory]) -> list[float]:
        """Share of every run."""
        return weibull_weights(self.winds(runs), self.mean, self.shape)


def _form(given: Any) -> str:
    """In which form weights stand: one key of a distribution says that it is one."""
    if isinstance(given, Weibull) or (
        isinstance(given, dict) and {*given} & {*Weibull.model_fields}
    ):
        return "distribution"
    return "by name" if isinstance(given, dict) else "in order"


_Weights = Annotated[
    Annotated[list[float], Tag("in order")]
    | Annotated[Weibull, Tag("distribution")]
    | Annotated[dict[str, float], Tag("by name")],
    Discriminator(_form),
]


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
        Share of the time of every run (of a scatter table, say), in their order or by name, or a
        Weibull distribution; default equal.
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
    weights: _Weights | None = None
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
            A run lacks the wind that its weight follows, or names are not those of the runs.
        """
        if isinstance(self.weights, Weibull):
            return self.weights.weights(runs)
        return by_name(self.weights, runs) if isinstance(self.weights, dict) else self.weights

    @property
    def loop(self) -> ClosedLoopSettings:
        """How loops are closed."""
        return ClosedLoopSettings(start_up=self.start_up)


def by_name(weights: Mapping[str, float], runs: Sequence[Trajectory]) -> list[float]:
    """Weights of runs in their order, of those by name.

    Raises
    ------
    DfsmError
        A name is that of no run, or of two, or a run has none.
    """
    names = [run.name for run in runs]
    if lost := [name for name in weights if name not in names]:
        raise DfsmError(
            f"weights: there is no run '{lost[0]}'; {near_matches(lost[0], names)}; a distribution "
            "is written as {mean: 9.5, shape: 2}"
        )
    if without := [name for name in names if name not in weights]:
        raise DfsmError(f"weights: the run '{without[0]}' has none: add one, or leave the run out")
    if twice := [name for name in names if names.count(name) > 1]:
        raise DfsmError(f"weights: two runs are called '{twice[0]}': rename one of them")
    return [weights[name] for name in names]

"""The file of `dfsm sweep`: which gains, over which runs, and what is told of them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from pathlib import Path

from pydantic import Field

from dfsm.config.loops import LoopsConfig, Weibull
from dfsm.config.parse import parse_file
from dfsm.data.trajectory import Trajectory
from dfsm.loops.load_cases import require_counted
from dfsm.loops.sweep import SweepSettings

_ADVICE = "write one as the documentation shows under 'Tuning'"


class SweepConfig(LoopsConfig):
    """A whole file of `dfsm sweep`.

    Attributes
    ----------
    gains
        Values by name, as for the parameters of `dfsm tune`; every combination is tried, beside the
        controller as it is.
    power, speed, rated_speed, extremes, block, years
        See `SweepSettings`.
    exponent
        Wöhler exponent of the loads in tables.
    conditions
        What each run is a case of, as for `sweep`; default the winds that weights follow, or every
        run a condition of its own.
    """

    gains: dict[str, list[float]] = Field(default_factory=dict)
    power: str | None = None
    speed: str | None = None
    rated_speed: float | None = None
    extremes: list[str] = Field(default_factory=list)
    block: float = SweepSettings.block
    years: float = SweepSettings.years
    exponent: float = 4.0
    conditions: list[float | str] | None = None

    def alike(self, runs: Sequence[Trajectory]) -> Sequence[Hashable] | None:
        """The condition of every run; None where nobody told."""
        if self.conditions is None and isinstance(self.weights, Weibull):
            return self.weights.winds(runs)
        return self.conditions

    def settings(self, start: float | None) -> SweepSettings:
        """What is told; `start` is that of the fit, where the file names none.

        Raises
        ------
        DfsmError
            An exponent for which no loads are counted, or what `SweepSettings` refuses.
        """
        require_counted(self.exponent)
        return SweepSettings(
            start=start if self.start is None else self.start,
            stop=self.stop,
            loop=self.loop,
            power=self.power,
            speed=self.speed,
            rated_speed=self.rated_speed,
            extremes=tuple(self.extremes),
            block=self.block,
            years=self.years,
        )


def load_sweep(path: Path) -> SweepConfig:
    """Read a file of `dfsm sweep`.

    Raises
    ------
    DfsmError
        It is missing or not YAML, or a key is unknown, missing or wrong.
    """
    return parse_file(path, SweepConfig, _ADVICE)

"""Closed loops on a model against records of the same loop, beside the open-loop replay.

What a controller is chosen by are statistics: standard deviations of speed, platform and blade
pitch and power, and damage-equivalent loads. A closed loop that reproduces these may well drift in
phase, so errors at equal times stand beside them, not in their place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dfsm.controllers.controller import Controller
from dfsm.core.drawing import DrawnByRun
from dfsm.core.files import json_value
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import hushed
from dfsm.models.completion import all_completed
from dfsm.models.dfsm import DFSM
from dfsm.models.recorded import recorded_states
from dfsm.numerics.time_mesh import weights_over_time
from dfsm.simulation.closed_loop import ClosedLoopRun, LoopStatus, closed_loop
from dfsm.simulation.loop_cases import ClosedLoopSettings, checked_loops
from dfsm.simulation.simulate import Simulation, Status, simulate
from dfsm.validation.results import ChannelError, ChannelStatistics
from dfsm.validation.validate import all_statistics, frequency_bands, recorded_channels

if TYPE_CHECKING:
    import pandas as pd

# Wöhler exponent of the one damage-equivalent load in tables.
SHOWN_EXPONENT = "4"


@dataclass(frozen=True)
class ClosedLoopComparison:
    """One run: the record, the closed loop and the open-loop replay.

    Attributes
    ----------
    recorded
        States, outputs and controls over the scored time.
    loop, replay
        The closed loop, and the rollout along the recorded controls.
    statistics, loop_statistics, replay_statistics
        By channel; empty for what ended early, and the replay has no controls of its own.
    loop_errors, replay_errors
        Errors at equal times by channel; empty likewise.
    """

    recorded: Trajectory
    loop: ClosedLoopRun
    replay: Simulation
    statistics: Mapping[str, ChannelStatistics]
    loop_statistics: Mapping[str, ChannelStatistics]
    replay_statistics: Mapping[str, ChannelStatistics]
    loop_errors: Mapping[str, ChannelError]
    replay_errors: Mapping[str, ChannelError]


@dataclass(frozen=True)
class Row:
    """One channel over all runs: means, and ratios of what is simulated to what was recorded.

    Attributes
    ----------
    mean, recorded_mean
        Mean of the closed loop and of the record, over all runs.
    std_ratio, std_worst
        Standard deviation of the closed loop over the record's: mean of the runs, and that of the
        run farthest from 1.
    replay_std_ratio
        Likewise of the replay, mean of the runs; None for controls.
    damage_ratio, damage_worst, replay_damage_ratio
        Likewise of damage-equivalent loads; None for states and controls.
    nrmse, replay_nrmse
        Errors at equal times, mean of the runs.
    """

    mean: float
    recorded_mean: float
    std_ratio: float
    std_worst: float
    replay_std_ratio: float | None
    damage_ratio: float | None
    damage_worst: float | None
    replay_damage_ratio: float | None
    nrmse: float
    replay_nrmse: float | None


@dataclass(frozen=True)
class ClosedLoopValidation(DrawnByRun):
    """Closed loops against records.

    Attributes
    ----------
    channels
        States, controls and outputs, in the order shown.
    runs
        In the caller's order.
    """

    channels: tuple[Channel, ...]
    runs: tuple[ClosedLoopComparison, ...]

    def __repr__(self) -> str:
        loops = f"{len(self.runs)} closed loop{'s' * (len(self.runs) != 1)}"
        return (
            f"<ClosedLoopValidation: {self.completed} of {loops} completed, "
            f"{len(self.channels)} channels; to_pandas() compares them with the records>"
        )

    @property
    def completed(self) -> int:
        """Number of closed loops that came to their end."""
        return sum(r.loop.status is LoopStatus.COMPLETED for r in self.runs)

    def endings(self) -> list[str]:
        """One sentence per closed loop that ended early."""
        return [
            f"{r.recorded.name}: {r.loop.message}"
            for r in self.runs
            if r.loop.status is not LoopStatus.COMPLETED
        ]

    def row(self, channel: str) -> Row | None:
        """Figures of one channel over the runs whose loop completed; None without any."""
        runs = [r for r in self.runs if channel in r.loop_statistics]
        if not runs:
            return None
        true = [r.statistics[channel] for r in runs]
        ours = [r.loop_statistics[channel] for r in runs]
        replays = [
            (r.replay_statistics[channel], r.statistics[channel])
            for r in runs
            if channel in r.replay_statistics
        ]
        errors = [r.replay_errors[channel].nrmse for r in runs if channel in r.replay_errors]
        pairs = list(zip(ours, true, strict=True))
        stds = [_ratio(a.std, b.std) for a, b in pairs]
        damages = [_damage_ratio(a, b) for a, b in pairs]
        loads = [d for d in damages if d is not None]
        replayed = [d for a, b in replays if (d := _damage_ratio(a, b)) is not None]
        return Row(
            mean=float(np.mean([s.mean for s in ours])),
            recorded_mean=float(np.mean([s.mean for s in true])),
            std_ratio=float(np.mean(stds)),
            std_worst=_farthest(stds),
            replay_std_ratio=_mean([_ratio(a.std, b.std) for a, b in replays]),
            damage_ratio=_mean(loads),
            damage_worst=_farthest(loads) if loads else None,
            replay_damage_ratio=_mean(replayed),
            nrmse=float(np.mean([r.loop_errors[channel].nrmse for r in runs])),
            replay_nrmse=_mean(errors),
        )

    def to_pandas(self) -> pd.DataFrame:
        """Return a table of one line per channel: means and ratios over the runs, as `row`."""
        import pandas as pd

        rows = {c.name: row for c in self.channels if (row := self.row(c.name)) is not None}
        lines = {name: asdict(row) for name, row in rows.items()}
        return pd.DataFrame.from_dict(lines, orient="index")

    def to_dict(self) -> dict[str, Any]:
        """JSON values: all figures, without time series and spectra; None where not finite."""
        rows = {c.name: self.row(c.name) for c in self.channels}
        values = {
            "format": 1,
            "channels": [{"name": c.name, "unit": c.unit, "role": c.role} for c in self.channels],
            "over_all": {name: None if row is None else vars(row) for name, row in rows.items()},
            "runs": [_run_dict(r) for r in self.runs],
        }
        return dict(json_value(values))


def validate_closed_loop(
    model: DFSM,
    runs: Sequence[Trajectory],
    controller: Controller,
    *,
    start: float | None = None,
    stop: float | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
) -> ClosedLoopValidation:
    """Compare closed loops with records of the same controller on the true system.

    Parameters
    ----------
    model, controller, start, stop, measurements, settings
        As for `closed_loop`.
    runs
        Records in closed loop, with all channels of the model, outputs included.

    Returns
    -------
    ClosedLoopValidation

    Raises
    ------
    DfsmError
        As `closed_loop`, or a run lacks a channel to compare with.
    """
    runs = checked_loops(model, runs, [controller], measurements, settings)
    s = model.signals
    runs = all_completed(runs, s)
    for run in runs:
        run.columns(s.recorded)
    with hushed():
        loops = closed_loop(
            model,
            runs,
            controller,
            start=start,
            stop=stop,
            measurements=measurements,
            settings=settings,
        )
    compared = [
        _compare(model, run, loop, (start, stop)) for run, loop in zip(runs, loops, strict=True)
    ]
    channels = (*s.observed, *s.controls, *s.outputs)
    return ClosedLoopValidation(channels, tuple(compared))


def _compare(
    model: DFSM, run: Trajectory, loop: ClosedLoopRun, window: tuple[float | None, float | None]
) -> ClosedLoopComparison:
    s = model.signals
    done = loop.status is LoopStatus.COMPLETED
    first = float(loop.trajectory.time[0]) if done else window[0]
    last = float(loop.trajectory.time[-1]) if done else window[1]
    part = run.window(first, last)
    rates = recorded_states(model, run, first).trajectory.window(first, last)
    recorded = recorded_channels(model, part, rates)
    recorded = recorded.with_channels(s.controls, part.select(s.names("controls")).values)
    with hushed():
        replay = simulate(model, run, start=first, stop=last)
    bands, loads = frequency_bands(model, recorded), s.names("outputs")
    names = [c.name for c in recorded.channels]
    ours = loop.trajectory.select(names) if done else None
    states = [n for n in names if n not in s.names("controls")]
    kept = replay.trajectory.select(states) if replay.status is Status.COMPLETED else None
    return ClosedLoopComparison(
        recorded=recorded,
        loop=loop,
        replay=replay,
        statistics=all_statistics(recorded, bands, loads),
        loop_statistics={} if ours is None else all_statistics(ours, bands, loads),
        replay_statistics={} if kept is None else all_statistics(kept, bands, loads),
        loop_errors=_errors(ours, recorded),
        replay_errors=_errors(kept, recorded),
    )


def _errors(ours: Trajectory | None, recorded: Trajectory) -> dict[str, ChannelError]:
    if ours is None:
        return {}
    weights = weights_over_time([ours.time])
    return {n: ChannelError.of(ours[n], recorded[n], weights) for n in ours.names}


def _ratio(ours: float, true: float) -> float:
    return ours / true if true else float("nan")


def _damage_ratio(ours: ChannelStatistics, true: ChannelStatistics) -> float | None:
    if SHOWN_EXPONENT not in true.damage:
        return None
    return _ratio(ours.damage[SHOWN_EXPONENT], true.damage[SHOWN_EXPONENT])


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _farthest(ratios: Sequence[float]) -> float:
    return float(max(ratios, key=lambda ratio: abs(ratio - 1)))


def _run_dict(run: ClosedLoopComparison) -> dict[str, Any]:
    def figures(
        statistics: Mapping[str, ChannelStatistics], errors: Mapping[str, ChannelError]
    ) -> dict[str, Any]:
        return {
            name: {
                "min": s.minimum,
                "mean": s.mean,
                "max": s.maximum,
                "std": s.std,
                "band_power": dict(s.power),
                "del_1hz": dict(s.damage),
                **({"nrmse": errors[name].nrmse} if name in errors else {}),
            }
            for name, s in statistics.items()
        }

    return {
        "name": run.recorded.name,
        "status": run.loop.status.name.lower(),
        "message": run.loop.message,
        "ended_s": run.loop.ended,
        "outside": run.loop.outside,
        "wall_time_s": run.loop.wall_time,
        "recorded": figures(run.statistics, {}),
        "closed_loop": figures(run.loop_statistics, run.loop_errors),
        "replay": figures(run.replay_statistics, run.replay_errors),
    }

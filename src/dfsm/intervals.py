"""Intervals around rollouts, calibrated on runs that the model never saw.

How wrong a rollout is depends on the wind: half-widths follow the schedule. At every operating
point they are a multiple of the root mean square error there; the multiple is the quantile of the
errors of each calibration run relative to what the other runs give, so that no run is judged by a
scale that it set itself (conformal prediction with one run left out; Barber et al. 2021).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.errors import DfsmError
from dfsm.model import DFSM
from dfsm.settings import require
from dfsm.simulate import Simulation, SimulationSettings, Status
from dfsm.trajectory import Trajectory
from dfsm.types import Array
from dfsm.validate import validate

# Calibration runs below which a quantile over runs means nothing.
_FEWEST = 3


@dataclass(frozen=True)
class Intervals:
    """Half-widths of prediction intervals along the schedule.

    Attributes
    ----------
    channels
        States and outputs.
    schedule
        Channel that the half-widths depend on; None for an LTI model.
    grid
        Schedule values, shape ``(point,)``; between them half-widths are interpolated.
    half_width
        Shape ``(point, channel)``, in the channels' units.
    level
        Share of the time that the record of a new run is expected inside.
    runs
        Names of the calibration runs.
    """

    channels: tuple[str, ...]
    schedule: str | None
    grid: Array
    half_width: Array
    level: float
    runs: tuple[str, ...]

    def around(self, rollout: Simulation, run: Trajectory) -> tuple[Trajectory, Trajectory]:
        """Lower and upper ends around a rollout.

        Parameters
        ----------
        rollout
            Of the model that was calibrated.
        run
            What drove it; holds the schedule.
        """
        middle = rollout.trajectory.select(self.channels)
        half = _interpolated(self.grid, self.half_width, _schedule(self.schedule, run, middle))
        low, high = (
            Trajectory(middle.time, middle.values + sign * half, middle.channels, name=run.name)
            for sign in (-1, 1)
        )
        return low, high

    def coverage(self, rollout: Simulation, run: Trajectory, recorded: Trajectory) -> Array:
        """Share of the samples whose recorded value lies inside, shape ``(channel,)``."""
        low, high = (part.values for part in self.around(rollout, run))
        truth = recorded.select(self.channels).values[: len(low)]
        return ((truth >= low) & (truth <= high)).mean(axis=0)


def calibrate(
    model: DFSM,
    runs: Iterable[Trajectory],
    *,
    level: float = 0.9,
    start: float | None = None,
    stop: float | None = None,
    options: SimulationSettings | None = None,
) -> Intervals:
    """Find intervals that hold the record of a new run for a given share of the time.

    Parameters
    ----------
    model
        The surrogate.
    runs
        Runs that had no part in its fit, with all its channels; at least three.
    level
        Share of the time.
    start, stop
        Window in s, as for `validate`.
    options
        How the model is simulated.

    Returns
    -------
    Intervals

    Raises
    ------
    DfsmError
        Too few runs, a rollout that ended early, or a level outside (0, 1).
    """
    require(0 < level < 1, "level", level, "a share between 0 and 1")
    runs = list(runs)
    if len(runs) < _FEWEST:
        raise DfsmError(
            f"intervals are calibrated on at least {_FEWEST} runs, {len(runs)} were given"
        )
    found = validate({"model": model}, runs, start=start, stop=stop, options=options)
    errors, schedules = [], []
    for run, compared in zip(runs, found.runs, strict=True):
        rollout = compared.models["model"].simulation
        if rollout.status is not Status.COMPLETED:
            raise DfsmError(f"{run.where}: {rollout.message}; no interval holds such a rollout")
        names = [c.name for c in found.channels]
        truth = compared.recorded.select(names).values
        errors.append(rollout.trajectory.select(names).values - truth)
        schedules.append(_schedule(model.schedule, run, rollout.trajectory))
    grid = np.asarray(model.region.grid)
    squares = [_sums(grid, s, e**2) for s, e in zip(schedules, errors, strict=True)]
    scores = []
    for k, (s, e) in enumerate(zip(schedules, errors, strict=True)):
        scale = _scale([q for j, q in enumerate(squares) if j != k])
        scores.append(np.abs(e) / _interpolated(grid, scale, s))
    multiple = np.quantile(np.concatenate(scores), level, axis=0)
    return Intervals(
        channels=tuple(c.name for c in found.channels),
        schedule=model.schedule,
        grid=grid,
        half_width=multiple * _scale(squares),
        level=level,
        runs=tuple(r.name for r in runs),
    )


def _schedule(name: str | None, run: Trajectory, on: Trajectory) -> Array:
    """The schedule at the times of a rollout; zeros without one."""
    return np.zeros(len(on)) if name is None else np.interp(on.time, run.time, run[name])


def _interpolated(grid: Array, values: Array, at: Array) -> Array:
    """Columns of ``(point, channel)`` values at schedule values, ends held."""
    return np.stack([np.interp(at, grid, column) for column in values.T], axis=1)


def _sums(grid: Array, schedule: Array, squares: Array) -> tuple[Array, Array]:
    """Weight ``(point,)`` and weighted sum of squared errors ``(point, channel)`` of one run."""
    hats = np.stack([np.interp(schedule, grid, row) for row in np.eye(len(grid))])
    return hats.sum(axis=1), hats @ squares


def _scale(sums: Sequence[tuple[Array, Array]]) -> Array:
    """Root mean square error at every point; that of all where no run has been."""
    weight, total = (np.sum([s[k] for s in sums], axis=0) for k in (0, 1))
    overall = total.sum(axis=0) / weight.sum()
    # As good as a sample of the overall error: a point that was hardly visited leans on the rest.
    return np.sqrt((total + overall) / (weight + 1)[:, None])

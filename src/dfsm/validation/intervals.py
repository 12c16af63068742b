"""Prediction intervals around rollouts, and the readable file that keeps them.

How wrong a rollout is depends on the wind: half-widths follow the schedule. `calibrate` finds them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from dfsm.core.bundle import is_as_written, signed
from dfsm.core.files import check_format, existing_file, write_json
from dfsm.core.types import Array
from dfsm.core.units import agree
from dfsm.core.version import __version__
from dfsm.data.conversion import in_units_of
from dfsm.data.trajectory import Channel, Trajectory, labels
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM
from dfsm.numerics.time_mesh import mean_over, weights_over_time
from dfsm.simulation.simulate import Simulation
from dfsm.validation.growth import Growth

# Those of format 1 may lack the checksum.
_FORMAT = 2
_UNSIGNED = ("format", "dfsm", "level", "schedule", "grid", "channels", "runs", "warnings")
_AGAIN = "make it again with dfsm calibrate"


@dataclass(frozen=True)
class Intervals:
    """Half-widths of prediction intervals: along the schedule, and how they grow.

    Attributes
    ----------
    channels, units
        Names and units of states and outputs.
    schedule
        Channel that the half-widths depend on; None for an LTI model.
    grid
        Schedule values, shape ``(point,)``; between them half-widths are interpolated.
    half_width
        Shape ``(point, channel)``, in the channels' units: after the longest rollout that was left
        out, as far from the training data as is usual.
    level
        Share of the time that the record of a new run is expected inside.
    runs, digests
        Names of the calibration runs, and SHA-256 of what the model reads of them.
    warnings
        What a reader should know before trusting them.
    schedule_unit
        Unit of the schedule; none in files that say nothing of it.
    growth
        How half-widths depend on the time since the start and on the distance from the training
        data; None where they do not, as in files of version 0.1.
    """

    channels: tuple[str, ...]
    units: tuple[str, ...]
    schedule: str | None
    grid: Array
    half_width: Array
    level: float
    runs: tuple[str, ...]
    digests: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    schedule_unit: str = ""
    growth: Growth | None = None

    def check(self, model: DFSM) -> None:
        """Refuse to stand around rollouts of another model.

        Raises
        ------
        DfsmError
            The model has other channels, units or schedule points.
        """
        s, named = model.signals, zip(self.channels, self.units, strict=True)
        ours, theirs = tuple(Channel(*c) for c in named), (*s.observed, *s.outputs)
        grid = np.asarray(model.region.grid)
        if not _same_channels(ours, theirs):
            what, ours, theirs = "channels are", labels(ours), labels(theirs)
        elif self.schedule != model.schedule:
            what, ours, theirs = "schedule is", self.schedule or "none", model.schedule or "none"
        elif not np.array_equal(self.grid, grid):
            what, ours, theirs = "schedule points are", _points(self.grid), _points(grid)
        else:
            return
        raise DfsmError(
            f"the intervals are of another model: their {what} {ours}, the model's {theirs}; "
            "make them for this one with dfsm calibrate"
        )

    def around(self, rollout: Simulation, run: Trajectory) -> tuple[Trajectory, Trajectory]:
        """Lower and upper ends around a rollout.

        Parameters
        ----------
        rollout
            Of the model that was calibrated.
        run
            What drove it; holds the schedule.
        """
        if self.schedule is not None:
            run = in_units_of(run, [Channel(self.schedule, self.schedule_unit)])
        middle = rollout.trajectory.select(self.channels)
        half = interpolated(self.grid, self.half_width, schedule_along(self.schedule, run, middle))
        if self.growth is not None:
            half = half * self.growth.factor(middle.time - middle.time[0], rollout.distance)
        low, high = (
            Trajectory(middle.time, middle.values + sign * half, middle.channels, name=run.name)
            for sign in (-1, 1)
        )
        return low, high

    def beside(self, rollout: Simulation, run: Trajectory) -> Trajectory:
        """The rollout and its ends, as channels ``<channel>_low`` and ``<channel>_high``.

        Parameters
        ----------
        rollout, run
            As for `around`.
        """
        low, high = self.around(rollout, run)
        ends = [Channel(f"{c.name}_{e}", c.unit) for c in low.channels for e in ("low", "high")]
        values = np.stack([low.values, high.values], axis=2).reshape(len(low), -1)
        return rollout.trajectory.with_channels(ends, values)

    def coverage(self, rollout: Simulation, run: Trajectory, recorded: Trajectory) -> Array:
        """Share of the time in which the recorded value lies inside, shape ``(channel,)``."""
        low, high = (part.values for part in self.around(rollout, run))
        truth = recorded.select(self.channels).values[: len(low)]
        weights = weights_over_time([recorded.time[: len(low)]])
        return mean_over((truth >= low) & (truth <= high), weights)

    def save(self, path: str | Path) -> None:
        """Write a JSON file; an existing one is replaced when the new one is complete.

        Raises
        ------
        DfsmError
            The file cannot be written.
        """
        named = zip(self.channels, self.units, self.half_width.T.tolist(), strict=True)
        runs = zip(self.runs, self.digests, strict=True)
        content = {
            "format": _FORMAT,
            "dfsm": __version__,
            "level": self.level,
            "schedule": self.schedule,
            "schedule_unit": self.schedule_unit,
            "grid": self.grid.tolist(),
            "channels": [{"name": n, "unit": u, "half_width": h} for n, u, h in named],
            "runs": [{"name": name, "sha256": digest} for name, digest in runs],
            "warnings": self.warnings,
        }
        if self.growth is not None:
            content["growth"] = {k: np.asarray(v).tolist() for k, v in vars(self.growth).items()}
        write_json(path, signed(content))


class _Channel(BaseModel):
    name: str
    unit: str
    half_width: list[Annotated[float, Field(ge=0, allow_inf_nan=False)]]


class _Run(BaseModel):
    name: str
    sha256: str


class _Growth(BaseModel):
    lag: Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=2)]
    along: list[list[Annotated[float, Field(ge=0, allow_inf_nan=False)]]]
    power: list[Annotated[float, Field(ge=0, allow_inf_nan=False)]]
    knee: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    memory: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    farthest: Annotated[float, Field(ge=0, allow_inf_nan=False)]


class _File(BaseModel):
    """What `Intervals.save` writes."""

    level: Annotated[float, Field(gt=0, lt=1)]
    schedule: str | None
    schedule_unit: str = ""
    grid: Annotated[list[Annotated[float, Field(allow_inf_nan=False)]], Field(min_length=1)]
    channels: Annotated[list[_Channel], Field(min_length=1)]
    runs: list[_Run]
    warnings: list[str]
    growth: _Growth | None = None


def load_intervals(path: str | Path) -> Intervals:
    """Read intervals that `Intervals.save` or ``dfsm calibrate`` wrote.

    Parameters
    ----------
    path
        JSON file.

    Returns
    -------
    Intervals

    Raises
    ------
    DfsmError
        The file is missing, holds something else, or was written by a newer version.
    """
    path = existing_file(path)
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        raise _foreign(path, "not JSON") from None
    version = raw.get("format") if isinstance(raw, dict) else None
    if isinstance(version, int):
        check_format(path, version, _FORMAT)
    try:
        content = _File.model_validate(raw)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise _foreign(path, f"{where or 'all of it'}: {first['msg'].lower()}") from None
    if not (np.diff(content.grid) > 0).all():
        raise _foreign(path, "its grid does not increase")
    points = len(content.grid)
    if any(len(c.half_width) != points for c in content.channels):
        raise _foreign(path, f"a channel has not one half-width for each of {points} grid points")
    if not is_as_written(raw, _UNSIGNED):
        raise DfsmError(f"{path} is damaged, it is not as it was written: {_AGAIN}")
    return Intervals(
        channels=tuple(c.name for c in content.channels),
        units=tuple(c.unit for c in content.channels),
        schedule=content.schedule,
        grid=np.array(content.grid),
        half_width=np.array([c.half_width for c in content.channels]).T,
        level=content.level,
        runs=tuple(r.name for r in content.runs),
        digests=tuple(r.sha256 for r in content.runs),
        warnings=tuple(content.warnings),
        schedule_unit=content.schedule_unit,
        growth=_growth(path, content),
    )


def _growth(path: Path, content: _File) -> Growth | None:
    """How half-widths grow, of the shape that its channels ask for."""
    told = content.growth
    if told is None:
        return None
    shape = (len(told.lag), len(content.channels))
    shaped = len(told.along) == shape[0] and {len(row) for row in told.along} == {shape[1]}
    if not shaped or len(told.power) != shape[1] or not (np.diff(told.lag) > 0).all():
        raise _foreign(path, "its growth is not that of its channels")
    lag, along, power = map(np.array, (told.lag, told.along, told.power))
    return Growth(lag, along, power, told.knee, told.memory, told.farthest)


def _same_channels(ours: Sequence[Channel], theirs: Sequence[Channel]) -> bool:
    return len(ours) == len(theirs) and all(
        a.name == b.name and agree(a.unit, b.unit) for a, b in zip(ours, theirs, strict=True)
    )


def _foreign(path: Path, what: str) -> DfsmError:
    return DfsmError(f"{path} is no file of prediction intervals ({what}): {_AGAIN}")


def _points(grid: Array) -> str:
    return ", ".join(f"{value:.4g}" for value in grid)


def schedule_along(name: str | None, run: Trajectory, on: Trajectory) -> Array:
    """The schedule at the times of a rollout; zeros without one."""
    if name is None:
        return np.zeros(len(on))
    # A state may schedule, and be one that no channel of the run holds.
    return on[name] if name in on else np.interp(on.time, run.time, run[name])


def interpolated(grid: Array, values: Array, at: Array) -> Array:
    """Columns of ``(point, channel)`` values at schedule values, ends held."""
    return np.stack([np.interp(at, grid, column) for column in values.T], axis=1)

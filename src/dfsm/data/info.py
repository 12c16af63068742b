"""What `dfsm info` tells about a run: each channel's range and sampling, and what looks wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.numerics.time_mesh import mean_over, std_over, weights_over_time


@dataclass(frozen=True)
class ChannelInfo:
    """Statistics of one channel over its finite samples, in the channel's unit.

    Attributes
    ----------
    name, unit
        As in the file.
    min, max, mean, std
        Over the finite samples; NaN where there is none. `mean` and `std` are those over time,
        whatever the mesh; on an equidistant one `std` divides by the sample count.
    step
        Quantisation step, None where the file states none.
    """

    name: str
    unit: str
    min: float
    max: float
    mean: float
    std: float
    step: float | None


@dataclass(frozen=True)
class RunInfo:
    """Description of one run.

    Attributes
    ----------
    name, source
        Name of the run and the file it came from.
    samples
        Number of samples.
    start, stop
        First and last time in s.
    interval
        Sampling interval in s, None where the mesh is irregular.
    min_interval, max_interval
        Shortest and longest interval in s.
    wall_time
        Seconds the simulator took, if known.
    channels
        One entry per channel, in file order.
    warnings
        One sentence each: constant, NaN or infinite and duplicate channels, and what the reader
        left out or renamed.
    """

    name: str
    source: str | None
    samples: int
    start: float
    stop: float
    interval: float | None
    min_interval: float
    max_interval: float
    wall_time: float | None
    channels: tuple[ChannelInfo, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain types for JSON: no NaN (None instead), ``interval`` may be "irregular"."""
        plain = asdict(self)
        plain["interval"] = "irregular" if self.interval is None else self.interval
        plain["channels"] = [_without_nan(c) for c in plain["channels"]]
        plain["warnings"] = list(self.warnings)
        return plain


def describe(trajectory: Trajectory) -> RunInfo:
    """Describe a run: sampling, range of every channel, and what deserves a warning.

    Parameters
    ----------
    trajectory
        Any run; NaN and infinite samples are counted and left out of the statistics.

    Returns
    -------
    RunInfo
        Times in s, the rest in the channels' units.
    """
    steps = np.diff(trajectory.time)
    return RunInfo(
        name=trajectory.name,
        source=trajectory.source,
        samples=len(trajectory),
        start=float(trajectory.time[0]),
        stop=float(trajectory.time[-1]),
        interval=trajectory.time_step,
        min_interval=float(steps.min()),
        max_interval=float(steps.max()),
        wall_time=trajectory.wall_time,
        channels=tuple(
            _channel_info(c, v, trajectory.time)
            for c, v in zip(trajectory.channels, trajectory.values.T, strict=True)
        ),
        warnings=tuple(_warnings(trajectory)),
    )


def _channel_info(channel: Channel, values: Array, time: Array) -> ChannelInfo:
    finite = np.isfinite(values)
    good, time = values[finite], time[finite]
    weights = weights_over_time([time]) if len(time) > 1 else None
    if not len(good):
        nan = math.nan
        return ChannelInfo(channel.name, channel.unit, nan, nan, nan, nan, channel.step)
    return ChannelInfo(
        channel.name,
        channel.unit,
        float(good.min()),
        float(good.max()),
        float(mean_over(good, weights)),
        float(std_over(good, weights)),
        channel.step,
    )


# Steps this many times the usual one are a hole in the record, not an adaptive mesh.
_GAP = 20.0


def gap_warning(trajectory: Trajectory) -> str | None:
    """Say where the time mesh has its longest hole, if it has one.

    Parameters
    ----------
    trajectory
        Any run, or the part of one that is used.

    Returns
    -------
    str | None
        One sentence that does not name the run; None where no step is a hole.
    """
    steps = np.diff(trajectory.time)
    gap = int(np.argmax(steps))
    others = np.sort(np.delete(steps, gap))
    if not len(others):
        return None
    # The usual step is that of half the time, not of half the samples: an adaptive solver may put
    # most of these where it starts.
    usual = others[np.searchsorted(np.cumsum(others), others.sum() / 2)]
    if steps[gap] <= _GAP * usual:
        return None
    return (
        f"there is a gap of {steps[gap]:g} s after {trajectory.time[gap]:g} s, which a fit bridges "
        "with a spline: split the run there, or choose a time window without it"
    )


def _warnings(trajectory: Trajectory) -> list[str]:
    sentences = []
    if gap := gap_warning(trajectory):
        sentences.append(gap)
    seen: dict[bytes, str] = {}
    for name, values in zip(trajectory.names, trajectory.values.T, strict=True):
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            sentences.append(
                f"'{name}' has {len(bad)} NaN or infinite samples, the first at "
                f"{trajectory.time[bad[0]]:g} s"
            )
        elif values.min() == values.max():
            # Two constants often agree by chance: that they are constant says enough.
            sentences.append(f"'{name}' is constant ({values[0]:g})")
            continue
        data = values.tobytes()
        if data in seen:
            sentences.append(f"'{name}' holds the same data as '{seen[data]}'")
        else:
            seen[data] = name
    return [*sentences, *trajectory.notes]


def _without_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}

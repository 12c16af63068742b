"""What `dfsm info` tells about a run: each channel's range and sampling, and what looks wrong."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dfsm.core.types import Array
from dfsm.data.signs import held_interval, jumps_at_first, transient_end, wrapping
from dfsm.data.slower import slower_warning
from dfsm.data.stuck import stuck_notes
from dfsm.data.suspects import stray_rows, strays_told
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind import wind_warning
from dfsm.numerics.time_mesh import mean_over, std_over, weights_over_time

if TYPE_CHECKING:
    from dfsm.data.readers.long_run import LongRun

# What differs from run to run in sentences that say the same: lists of channels, and numbers.
_CHANNELS = re.compile(r"\bin '[^']*'(?:, '[^']*')*(?: and \d+ more channels)?")
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


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


def describe(trajectory: Trajectory | LongRun) -> RunInfo:
    """Describe a run: sampling, range of every channel, and what deserves a warning.

    Parameters
    ----------
    trajectory
        Any run; NaN and infinite samples are counted and left out of the statistics. One channel
        is looked at after the other.

    Returns
    -------
    RunInfo
        Times in s, the rest in the channels' units.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # squares of strays, which are told
        return _described(trajectory)


def _described(run: Trajectory | LongRun) -> RunInfo:
    steps = np.diff(run.time)
    shortest, longest = float(steps.min()), float(steps.max())
    del steps
    channels, sentences = list[ChannelInfo](), list[str]()
    jumping, ends = list[str](), dict[str, float]()
    seen: dict[bytes, str] = {}
    for channel in run.channels:
        name, values = channel.name, run[channel.name]
        channels.append(_channel_info(channel, values, run))
        if jumps_at_first(values):
            jumping.append(name)
        if (end := transient_end(run.time, values)) is not None:
            ends[name] = end
        sentences += _warnings(channel, values, run.time, seen)
    sentences += stuck_notes(run)
    gap = gap_warning(run)
    return RunInfo(
        name=run.name,
        source=run.source,
        samples=len(run),
        start=float(run.time[0]),
        stop=float(run.time[-1]),
        interval=run.time_step,
        min_interval=shortest,
        max_interval=longest,
        wall_time=run.wall_time,
        channels=tuple(channels),
        warnings=(*([gap] if gap else []), *_starts(jumping, ends), *sentences, *run.notes),
    )


def _channel_info(channel: Channel, values: Array, run: Trajectory | LongRun) -> ChannelInfo:
    finite, time = np.isfinite(values), run.time
    # On an equidistant mesh a sample stands for a step, whatever is missing beside it.
    apart = run.time_step is None
    if len(values) > _BLOCK and finite.all() and not apart:
        return _long_channel_info(channel, values)
    good = values[finite]
    weights = weights_over_time([time[finite]]) if apart and len(good) > 1 else None
    if not len(good):
        nan = math.nan
        return ChannelInfo(channel.name, channel.unit, nan, nan, nan, nan, channel.step)
    mean, std = float(mean_over(good, weights)), float(std_over(good, weights))
    least, most = float(good.min()), float(good.max())
    return ChannelInfo(channel.name, channel.unit, least, most, mean, std, channel.step)


# Samples of a channel that are looked at together: a long run is not copied for its statistics.
_BLOCK = 1_000_000


def _long_channel_info(channel: Channel, values: Array) -> ChannelInfo:
    """The same part by part; mean and standard deviation differ in their last digits."""
    low = min(float(part.min()) for part in _parts(values))
    high = max(float(part.max()) for part in _parts(values))
    mean = sum(float(part.sum()) for part in _parts(values)) / len(values)
    squares = sum(float(np.sum((part - mean) ** 2)) for part in _parts(values))
    std = math.sqrt(squares / len(values))
    return ChannelInfo(channel.name, channel.unit, low, high, mean, std, channel.step)


def _parts(values: Array) -> Iterator[Array]:
    for first in range(0, len(values), _BLOCK):
        yield np.ascontiguousarray(values[first : first + _BLOCK])


# Steps this many times the usual one are a hole in the record, not an adaptive mesh.
_GAP = 20.0


def gap_warning(trajectory: Trajectory | LongRun) -> str | None:
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
    if steps[gap] <= _GAP * steps.min():
        return None
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


def _warnings(channel: Channel, values: Array, time: Array, seen: dict[bytes, str]) -> list[str]:
    """What deserves a warning about one channel; `seen` are the digests of those before it."""
    name, bad = channel.name, np.flatnonzero(~np.isfinite(values))
    sentences = []
    if slower := slower_warning(time, values, name):
        sentences.append(slower)
    elif len(bad):
        sentences.append(
            f"'{name}' has {len(bad)} NaN or infinite samples, the first at {time[bad[0]]:g} s"
        )
    elif values.min() == values.max():
        # Two constants often agree by chance: that they are constant says enough.
        return [f"'{name}' is constant ({values[0]:g})"]
    h = hashlib.sha256()
    for part in _parts(values):
        h.update(part.data)
    data = h.digest()
    if data in seen:
        return [*sentences, f"'{name}' holds the same data as '{seen[data]}'"]
    seen[data] = name
    return [*sentences, *_looks(channel, values, time)]


def _looks(channel: Channel, values: Array, time: Array) -> list[str]:
    """What a channel is, from its name and its samples."""
    sentences, name, unit = [], channel.name, channel.unit
    if len(strays := stray_rows(values)):
        sentences.append(
            f"{strays_told(name, time, values, strays)}, far beyond all its other samples: correct "
            "it, or set data.outliers to drop"
        )
    if wrap := wrapping(time, values, unit):
        sentences.append(
            f"'{name}' wraps at {wrap.period:.4g}{f' {unit}' if unit else ''}, {wrap.times} times, "
            f"first at {wrap.first:g} s: as a state it must go on (numpy.unwrap)"
        )
    if interval := held_interval(time, values):
        sentences.append(
            f"'{name}' changes every {interval:g} s only and stays as it was in between: a slower "
            "record, or a held command"
        )
    if text := wind_warning(name):
        sentences.append(text)
    return sentences


def _starts(jumping: Sequence[str], ends: Mapping[str, float]) -> list[str]:
    """What is wrong with the beginning of a run, in the channels concerned."""
    sentences = []
    if jumping:
        sentences.append(
            f"the first sample has nothing to do with the next in {_some(jumping)}: leave it out "
            "with data.start"
        )
    if ends:
        sentences.append(
            f"a transient, until {max(ends.values()):.4g} s in {_some(list(ends))}, is far from "
            "all that follows: start behind it with data.start, unless it is what matters"
        )
    return sentences


def _some(names: Sequence[str], most: int = 4) -> str:
    """The first names, and how many there are beside them."""
    shown = ", ".join(f"'{n}'" for n in names[:most])
    return shown + (f" and {len(names) - most} more channels" if len(names) > most else "")


def counted(told: Iterable[tuple[str, Iterable[str]]]) -> list[str]:
    """Sentences about several runs, each once: where first, and how often.

    Parameters
    ----------
    told
        Run and its sentences. Those that differ in numbers or lists of channels count as one.

    Returns
    -------
    list[str]
        ``"a.outb: 'x' is constant (7) (and 3 more runs)"``, in the order of their first occurrence.
    """
    found: dict[str, tuple[str, set[str]]] = {}
    for where, sentences in told:
        for sentence in sentences:
            parts = _CHANNELS.sub("in them", sentence).split("'")
            parts[::2] = [_NUMBER.sub("#", part) for part in parts[::2]]
            _, runs = found.setdefault("'".join(parts), (f"{where}: {sentence}", set()))
            runs.add(where)
    return [
        first + (f" (and {len(runs) - 1} more run{'s' * (len(runs) > 2)})" if len(runs) > 1 else "")
        for first, runs in found.values()
    ]


@dataclass(frozen=True)
class MergedChannel:
    """One channel over several runs.

    Attributes
    ----------
    name, units
        As in the files; several units where runs do not agree.
    min, max
        Over the finite samples of all runs, in the channel's unit; NaN where there is none.
    runs
        How many runs have it.
    steps
        Smallest and largest quantisation step; None where no run states one.
    """

    name: str
    units: tuple[str, ...]
    min: float
    max: float
    runs: int
    steps: tuple[float, float] | None


def merged(runs: Sequence[RunInfo]) -> list[MergedChannel]:
    """Describe every channel over all runs, in the order of their first occurrence."""
    channels: dict[str, list[ChannelInfo]] = {}
    for run in runs:
        for channel in run.channels:
            channels.setdefault(channel.name, []).append(channel)
    result = []
    for name, parts in channels.items():
        steps = [c.step for c in parts if c.step is not None]
        known = [c for c in parts if not math.isnan(c.min)]
        result.append(
            MergedChannel(
                name,
                tuple(dict.fromkeys(c.unit for c in parts)),
                min((c.min for c in known), default=math.nan),
                max((c.max for c in known), default=math.nan),
                len(parts),
                (min(steps), max(steps)) if steps else None,
            )
        )
    return result


def _without_nan(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()
    }

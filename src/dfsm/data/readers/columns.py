"""Columns of a table: which one is time, and the unit that a header holds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import factor, known
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError

# The name, one separator at most, and the unit in brackets at the end.
HEADER = re.compile(r"(.+?)[_ ]?(?:\[([^\[\]]*)\]|\(([^()]*)\))")
TIME_NAMES = ("time", "t")
# Names that count where no column has one of these: other spellings, and other languages.
ALSO_TIME = (
    *("time_s", "time_sec", "elapsed time", "elapsed_time", "elapsed", "zeit", "temps", "tiempo"),
    *("tempo", "tijd", "tid"),
)
# What pandas calls a column that it saved or read without a name, and a name left blank.
INDEX = re.compile(r"|unnamed: \d+|__index_level_\d+__", re.IGNORECASE)
SECONDS = ("", "s", "sec", "second", "seconds")
# Sampling interval in s, or rate in Hz, of a record without a time.
INTERVAL_NAMES = ("ts", "dt", "t_s", "step", "sampling_time", "sampling_interval")
RATE_NAMES = ("fs", "f_s", "sampling_rate", "sampling_frequency", "samplerate", "sample_rate")
_PER_SECOND = ("samples/s", "samples/sec", "sample/s", "s/s", "sa/s", "sps")
# Numbers of time since 1970 in 2001 and in 2100, in s, and what times them there may count.
_SINCE_1970, _COUNTS = (1e9, 4.1e9), {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


def split_header(text: str) -> tuple[str, str]:
    """Split ``Name [unit]``, ``Name (unit)`` or ``Name_[unit]`` into name and unit ("" if none)."""
    text = text.strip()
    match = HEADER.fullmatch(text)
    if match is None:
        return text, ""
    return match[1], (match[2] if match[2] is not None else match[3]).strip()


def kept_columns(
    path: Path, channels: Sequence[Channel], columns: Sequence[Array], time: int | None
) -> tuple[list[int], list[str]]:
    """Columns that hold signals, and what there is to tell about the others.

    A table saved with its row numbers (the index of pandas) and a separator at the end of every
    line give columns that nobody asked for: these are left out.

    Parameters
    ----------
    path
        The file.
    channels, columns
        Header and samples of every column.
    time
        Which of them is the time, if one is.

    Raises
    ------
    DfsmError
        A column without a name holds something else.
    """
    keep: list[int] = []
    notes: list[str] = []
    for i, (channel, values) in enumerate(zip(channels, columns, strict=True)):
        if i == time:
            continue
        if not INDEX.fullmatch(channel.name):
            keep.append(i)
        elif _numbers_rows(values):
            notes.append(f"column {i + 1} left out: it numbers the rows, as a saved index does")
        elif channel.name:
            keep.append(i)
        elif np.isnan(values).all():
            notes.append(f"column {i + 1} left out: it has no name and no values")
        else:
            raise DfsmError(
                f"{path}: column {i + 1} has no name: give it one in the header, or remove it"
            )
    return keep, notes


def _numbers_rows(values: Array) -> bool:
    """Whether samples are whole numbers that increase: rows that were dropped leave holes."""
    whole = np.isfinite(values).all() and np.array_equal(values, np.floor(values))
    return bool(whole and (np.diff(values) > 0).all())


def time_column(
    path: Path,
    channels: list[Channel],
    names: tuple[str, ...] = TIME_NAMES,
    converts: bool = False,
) -> int:
    """Return the column that holds the time.

    Parameters
    ----------
    path
        The file.
    channels
        Of all columns.
    names
        What a time is called, in small letters.
    converts
        Whether the reader takes a time in another unit to s, see `seconds_per`.

    Raises
    ------
    DfsmError
        There is none, or its unit is not s and none that is converted.
    """
    called = [channel.name.lower() for channel in channels]
    at = next((i for kind in (names, ALSO_TIME) for i, n in enumerate(called) if n in kind), None)
    if at is None:
        raise no_time(path, channels)
    if not (converts and seconds_per(channels[at].unit)) and (
        channels[at].unit.lower() not in SECONDS
    ):
        raise DfsmError(
            f"{path}: its time '{channels[at].name}' is in '{channels[at].unit}', expected s: "
            "convert it"
        )
    return at


def seconds_per(unit: str) -> float | None:
    """What a unit of time is in s; None for one of something else."""
    return 1.0 if unit.lower() in SECONDS else factor(unit, "s")


def no_time(path: Path, channels: Sequence[Channel]) -> DfsmError:
    """What to say of a file without a time and without a rate."""
    shown = ", ".join(c.name or "(no name)" for c in channels[:12])
    shown += ", …" if len(channels) > 12 else ""
    return DfsmError(
        f"{path}: no time column, expected one called Time, time or t (in s), found: "
        f"{shown[:400] or 'nothing'}: add it, or tell the interval of samples at a fixed rate "
        "(--step of the command, data.step in a configuration, fs, Ts or dt beside the signals)"
    )


def rate_step(name: str, value: float, unit: str = "") -> float | None:
    """Sampling interval in s that a number called ``fs``, ``Ts`` or ``dt`` tells; None for others.

    Parameters
    ----------
    name
        As in the file, in any case, with blanks or underscores.
    value
        In Hz for a rate, in s for an interval, unless there is a unit.
    unit
        What stands beside it; a unit of something else makes it another number.
    """
    called = "_".join(name.lower().split())
    rate = called in RATE_NAMES
    if not (np.isfinite(value) and value > 0) or not (rate or called in INTERVAL_NAMES):
        return None
    unit = "Hz" if unit.lower() in _PER_SECOND else unit
    scale = factor(unit, "Hz" if rate else "s") if known(unit) else 1.0
    if scale is None:
        return None
    return 1 / (value * scale) if rate else value * scale


def since_1970(time: Array, *, seconds: bool) -> tuple[Array, str] | None:
    """Seconds since the first of times that count from 1970, and what they count.

    Parameters
    ----------
    time
        As they stand in a file that names no unit, shape ``(time,)``.
    seconds
        Whether times in seconds are looked for as well: by themselves they are right as they are.

    Returns
    -------
    tuple or None
        None where their size is that of other times.
    """
    low, high = _SINCE_1970
    if not len(time) or not np.isfinite(time).all():
        return None
    for word, count in (({"seconds": 1.0} if seconds else {}) | _COUNTS).items():
        if low * count <= time.min() and time.max() < high * count:
            return (time - time[0]) / count, word
    return None


def uniform_times(path: Path, count: int, step: float) -> Array:
    """Times in s of samples at a fixed interval, from 0, shape ``(count,)``.

    Raises
    ------
    DfsmError
        The interval is no positive number.
    """
    if not (np.isfinite(step) and step > 0):
        raise DfsmError(
            f"{path}: the interval between samples is {step:g} s, expected a positive number: "
            "correct it"
        )
    return step * np.arange(count)

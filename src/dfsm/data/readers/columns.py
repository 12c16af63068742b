"""Columns of a table: which one is time, and the unit that a header holds."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import factor, known
from dfsm.data.readers.times import CAPITAL, SAME_STEP, SECONDS, time_rank
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError

# The name, one separator at most, and the unit in brackets at the end.
HEADER = re.compile(r"(.+?)[_ ]?(?:\[([^\[\]]*)\]|\(([^()]*)\))")
# What pandas calls a column that it saved or read without a name, and a name left blank.
INDEX = re.compile(r"|unnamed: \d+|__index_level_\d+__", re.IGNORECASE)
# Sampling interval in s, or rate in Hz, of a record without a time.
INTERVAL_NAMES = ("ts", "dt", "t_s", "step", "sampling_time", "sampling_interval")
RATE_NAMES = ("fs", "f_s", "sampling_rate", "sampling_frequency", "samplerate", "sample_rate")
_PER_SECOND = ("samples/s", "samples/sec", "sample/s", "s/s", "sa/s", "sps")


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


def named_time(
    path: Path, channels: Sequence[Channel], rising: Callable[[int], bool] | None = None
) -> int | None:
    """Return the column that is called a time; None where there is none.

    A capital T is one where nothing else is, its unit is s, or it has none, and it increases.

    Parameters
    ----------
    path
        The file, for messages.
    channels
        Header of every column.
    rising
        Whether the samples of a column increase; without it a T needs the unit.

    Raises
    ------
    DfsmError
        Its unit is none of time.
    """
    ranks = {i: rank for i, c in enumerate(channels) if (rank := time_rank(c.name)) is not None}
    for at in sorted(ranks, key=lambda i: ranks[i]):
        unit = channels[at].unit
        if ranks[at] == CAPITAL:
            other = known(unit) and factor(unit, "s") is None
            if other or (not unit and rising is None) or (rising is not None and not rising(at)):
                continue
        check_seconds(path, channels[at].name, unit)
        return at
    return None


def check_seconds(path: Path, name: str, unit: str) -> None:
    """Refuse a time whose unit is none of time; `seconds_of` converts what is.

    Raises
    ------
    DfsmError
        It is in something else.
    """
    if unit.lower() not in SECONDS and factor(unit, "s") is None:
        raise DfsmError(f"{path}: its time '{name}' is in '{unit}', expected s: convert it")


def time_column(
    path: Path, channels: Sequence[Channel], rising: Callable[[int], bool] | None = None
) -> int:
    """Return the column that holds the time, see `named_time`.

    Raises
    ------
    DfsmError
        There is none, or its unit is none of time.
    """
    at = named_time(path, channels, rising)
    if at is None:
        raise no_time(path, channels)
    return at


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
    called = _one_word(name)
    rate = called in RATE_NAMES
    if not (np.isfinite(value) and value > 0) or not (rate or called in INTERVAL_NAMES):
        return None
    unit = "Hz" if unit.lower() in _PER_SECOND else unit
    scale = factor(unit, "Hz" if rate else "s") if known(unit) else 1.0
    if scale is None:
        return None
    return 1 / (value * scale) if rate else value * scale


@dataclass(frozen=True)
class ToldStep:
    """An interval between samples in s that a file tells, the name it has there, and where."""

    step: float
    name: str
    source: str


def agreed_step(path: Path, told: Sequence[ToldStep]) -> tuple[ToldStep, str]:
    """The interval between samples that a file tells, and a note on others that it seems to tell.

    ``Ts`` and the like are other quantities as well, the period of waves for one, so that a rate
    counts where both are told and differ.

    Raises
    ------
    DfsmError
        Two differ, and none or several are rates.
    """
    by_rate = [t for t in told if _one_word(t.name.rsplit(".", 1)[-1]) in RATE_NAMES]
    others = [t for t in told if abs(t.step - told[0].step) > SAME_STEP * told[0].step]
    if not others:
        return told[0], ""
    apart = [t for t in by_rate if abs(t.step - by_rate[0].step) > SAME_STEP * by_rate[0].step]
    if not by_rate or apart:
        raise DfsmError(
            f"{path}: samples are every {told[0].step:g} s by '{told[0].name}' and every "
            f"{others[0].step:g} s by '{others[0].name}': remove the one that is none, or tell the "
            "interval (--step of the command, data.step in a configuration)"
        )
    names = dict.fromkeys(t.name for t in told if t not in by_rate)
    which = " and ".join(f"'{name}'" for name in names)
    tell = "tells" if len(names) == 1 else "tell"
    return by_rate[0], f"{which} beside '{by_rate[0].name}' {tell} no interval between samples"


def _one_word(name: str) -> str:
    return "_".join(name.lower().split())


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

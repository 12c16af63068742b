"""Which column of a text table tells its times, by the names and by what stands in the cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.columns import INDEX, named_time
from dfsm.data.readers.stamps import day_of, is_clock, tells_time, time_of_day
from dfsm.data.readers.text import Row, number
from dfsm.data.readers.times import CAPITAL, counts_from_a_date, is_date_name, rises, time_rank
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError

_CLOCK_NAMES = (
    *("clock", "clock time", "time of day", "time_of_day", "timeofday", "hour", "uhrzeit"),
    *("utc", "local time", "heure", "hora"),
)


@dataclass(frozen=True)
class TimeColumn:
    """The column of the time, None where there is none, and the rows to read.

    Where dates and times of day stand in two columns, `at` holds both and `date` is the other one.
    """

    at: int | None
    rows: list[Row]
    date: int | None = None


def find_time(
    path: Path, channels: Sequence[Channel], rows: list[Row], steps: Sequence[float]
) -> TimeColumn:
    """The column of the time: of stamps or durations, of numbers by its name, of dates.

    Parameters
    ----------
    path
        The file, for messages.
    channels
        What the header says.
    rows
        Of cells with decimal points.
    steps
        Intervals between samples in s that are told: a T that does not agree is no time.

    Raises
    ------
    DfsmError
        The unit of the time is not s, or dates beside times of day are not understood.
    """
    first = rows[0].cells if rows else []
    told = {i for i, cell in enumerate(first[: len(channels)]) if tells_time(cell)}
    if (joined := _dates_and_clocks(channels, rows)) is not None:
        return joined
    ranks = {i: rank for i, c in enumerate(channels) if (rank := time_rank(c.name)) is not None}
    for i in sorted(ranks, key=lambda i: ranks[i]):
        if i in told:
            _refuse_other_dates(path, channels, rows, i)
            return TimeColumn(i, rows)
    named = any(rank != CAPITAL for rank in ranks.values())
    for i in sorted(told & {i for i, c in enumerate(channels) if is_date_name(c.name)}):
        # Dates that stay the same, beside a time in numbers, are no times.
        if not (named and len(rows) > 1 and _cell(rows[1], i) == first[i]):
            return TimeColumn(i, rows)
    if named:
        return TimeColumn(named_time(path, channels), rows)
    for i, channel in enumerate(channels):
        if is_date_name(channel.name) and counts_from_a_date(channel.name, _numbers(rows, i)):
            return TimeColumn(i, rows)
    for i, channel in enumerate(channels):
        # The times that pandas writes before the columns, without a name.
        if i in told and INDEX.fullmatch(channel.name):
            return TimeColumn(i, rows)
    if ranks:
        at = named_time(path, channels, lambda i: rises(_numbers(rows, i), steps))
        return TimeColumn(at, rows)
    return TimeColumn(None, rows)


def _cell(row: Row, column: int) -> str:
    return row.cells[column] if column < len(row.cells) else ""


def _numbers(rows: Sequence[Row], column: int) -> Array:
    found = [number(_cell(row, column)) for row in rows]
    return np.array([np.nan if f is None else f for f in found])


def _dates_and_clocks(channels: Sequence[Channel], rows: list[Row]) -> TimeColumn | None:
    """Dates and times of day in two columns as one; None where there are none.

    One date for all of a table tells nothing besides times of day that are known by themselves.
    """
    dates = [i for i, c in enumerate(channels) if is_date_name(c.name)]
    if not rows or not dates:
        return None
    whole = [row for row in rows if len(row.cells) == len(channels)]
    at = next((i for i in dates if whole and day_of(whole[0].cells[i])), None)
    if at is None:
        return None
    days = [day_of(row.cells[at]) for row in whole]
    named = [i for i, c in enumerate(channels) if i != at and _is_clock_name(c.name)]
    beside = [i for i in (at + 1, at - 1) if 0 <= i < len(channels) and ":" in whole[0].cells[i]]
    for i in (*named, *beside):
        clocks = [time_of_day(row.cells[i]) for row in whole]
        # Digits alone are times of day where all of them are.
        if clocks[0] is None or (":" not in whole[0].cells[i] and None in clocks):
            continue
        if len(set(days)) == 1 and is_clock(whole[0].cells[i]):
            return TimeColumn(i, rows)
        stamps = {
            row.line: f"{day} {clock}"
            for row, day, clock in zip(whole, days, clocks, strict=True)
            if day is not None and clock is not None
        }
        return TimeColumn(i, [_with_cell(row, i, stamps.get(row.line)) for row in rows], at)
    return _day_numbers(channels, rows, at)


def _refuse_other_dates(
    path: Path, channels: Sequence[Channel], rows: Sequence[Row], time: int
) -> None:
    """Refuse times of day beside dates that nobody understands, unless these stay the same.

    Raises
    ------
    DfsmError
        There are some.
    """
    if not is_clock(rows[0].cells[time]):
        return
    for i, channel in enumerate(channels):
        if i == time or not is_date_name(channel.name):
            continue
        cells = [cell for row in rows if (cell := _cell(row, i).strip())]
        if len(set(cells)) > 1 and not tells_time(cells[0]):
            raise DfsmError(
                f"{path}: '{channels[time].name}' holds times of day, and {cells[0][:24]!r} in "
                f"'{channel.name}' is no date of a form that is known: write dates as 2016-01-31"
            )


def _is_clock_name(name: str) -> bool:
    return time_rank(name) is not None or name.lower() in _CLOCK_NAMES


def _with_cell(row: Row, column: int, text: str | None) -> Row:
    if text is None:
        return row
    return Row(row.line, [*row.cells[:column], text, *row.cells[column + 1 :]])


def _day_numbers(channels: Sequence[Channel], rows: list[Row], date: int) -> TimeColumn | None:
    """Numbers of days in one column and parts of days in another, as spreadsheets keep both."""
    days = _numbers(rows, date)
    if not counts_from_a_date(channels[date].name, days) or (days != np.floor(days)).any():
        return None
    for i, channel in enumerate(channels):
        part = _numbers(rows, i)
        if i == date or channel.unit or not _is_clock_name(channel.name):
            continue
        if (part >= 0).all() and (part < 1).all() and part.any():
            both = (days + part).tolist()
            tidy = [_with_cell(r, date, repr(v)) for r, v in zip(rows, both, strict=True)]
            return TimeColumn(date, tidy, i)
    return None

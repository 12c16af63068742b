"""Time stamps: dates and times of day as seconds since the first of them; durations in s."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import factor
from dfsm.data.readers.times import SPREADSHEET_DAYS
from dfsm.errors import DfsmError

_DAY_TEXT = (
    r"(\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4}|\d{1,2}-[A-Za-z]{3}-\d{4})"
)
_STAMP = re.compile(
    rf"\s*(?:{_DAY_TEXT}|\d{{8}}(?=T))"
    r"([T ]+\d{1,2}:?\d{2}(:?\d{2}([.,]\d+)?)?\s*(Z|[AaPp][Mm]|[-+]\d{2}:?\d{2})?)?\s*"
    r"|\s*\d{1,2}:\d{2}:\d{2}([.,]\d+)?\s*"
)
# Days and times of day in columns of their own, where both may be written without separators.
_DAY_ALONE = re.compile(rf"\s*{_DAY_TEXT}\s*")
_DAY_DIGITS = re.compile(r"\s*((?:19|20)\d{2})(0[1-9]|1[0-2])([0-3]\d)\s*")
_SHORT_YEAR = re.compile(r"(\d{1,2}\.\d{1,2}\.|\d{1,2}/\d{1,2}/)(\d{2})")
# Days as spreadsheets number them, and which of them is 0.
_DAY_NUMBER, _DAY_0 = re.compile(r"\d{5}"), date(1899, 12, 30)
_TIME_ALONE = re.compile(r"\s*\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?(\s*[AaPp][Mm])?\s*")
_TIME_DIGITS = re.compile(r"\s*([01]\d|2[0-3])([0-5]\d)([0-5]\d(?:[.,]\d+)?)\s*")
# "0.05 sec" as MATLAB writes durations, "0 days 00:00:00.050000" as pandas does.
_DURATION = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z]+)\s*")
_DAYS_AND_CLOCK = re.compile(r"\s*(-?\d+) days?,? \+?(\d{1,2}:\d{2}:\d{2}(?:\.\d+)?)\s*")
_CLOCK = re.compile(r"\s*(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)\s*")
# Whether the day or the month comes first shows in no date below the thirteenth.
_ORDERS = (
    "%Y-%m-%d",
    "%Y/%m/%d",
    "%Y.%m.%d",
    "%d.%m.%Y",
    "%d/%m/%Y",
    "%m/%d/%Y",
    "%d-%m-%Y",
    "%m-%d-%Y",
    "%d-%b-%Y",
)
_TIMES = ("", " %H:%M", " %H:%M:%S", " %H:%M:%S.%f", " %I:%M:%S %p", " %I:%M %p")
_DAY = 86400.0


@dataclass(frozen=True, eq=False)
class Stamps:
    """Times in s since the first stamp, shape ``(time,)``, and that stamp as it stands there.

    Durations are times in s by themselves.
    """

    seconds: Array
    first: str
    durations: bool = False

    def note(self, *names: str) -> str:
        """What a user should know, by the names of the columns that hold them."""
        held = " and ".join(f"'{name}'" if name else "a column without a name" for name in names)
        held += " hold" if len(names) > 1 else " holds"
        if self.durations:
            return f"{held} durations ('{self.first}'): read in s"
        return f"{held} time stamps: times are seconds since the first, {self.first}"


def is_stamp(text: str) -> bool:
    """Whether a text looks like a date, a date with a time, or a time of day."""
    return _STAMP.fullmatch(text) is not None


def is_clock(text: str) -> bool:
    """Whether a text is a time of day with seconds, which says by itself what it is."""
    return _CLOCK.fullmatch(text) is not None


def day_of(text: str) -> str | None:
    """A date without a time of day, in a column of dates; None for other texts."""
    text = text.strip()
    if _DAY_NUMBER.fullmatch(text) and int(text) in range(*SPREADSHEET_DAYS):
        return str(_DAY_0 + timedelta(days=int(text)))
    if match := _SHORT_YEAR.fullmatch(text):
        return f"{match[1]}20{match[2]}"
    if match := _DAY_DIGITS.fullmatch(text):
        return f"{match[1]}-{match[2]}-{match[3]}"
    return text if _DAY_ALONE.fullmatch(text) else None


def time_of_day(text: str) -> str | None:
    """A time of day that stands beside a date, None for other texts."""
    if match := _TIME_DIGITS.fullmatch(text):
        return f"{match[1]}:{match[2]}:{match[3]}"
    return text.strip() if _TIME_ALONE.fullmatch(text) else None


def duration(text: str) -> float | None:
    """Seconds of a number with a unit of time, or of days and a clock; None for other texts."""
    if match := _DAYS_AND_CLOCK.fullmatch(text):
        return _DAY * int(match[1]) + (_of_day(match[2]) or 0.0)
    match = _DURATION.fullmatch(text.replace(",", "."))
    scale = factor(match[2], "s") if match else None
    return float(match[1]) * scale if match and scale is not None else None


def tells_time(text: str) -> bool:
    """Whether a text is a time stamp or a duration."""
    return is_stamp(text) or duration(text) is not None


def read_stamps(path: Path, name: str, cells: Sequence[str]) -> Stamps:
    """Turn a column of time stamps into seconds since the first, one of durations into seconds.

    Raises
    ------
    DfsmError
        A cell is none, or the order of day and month is open and matters.
    """
    if not is_stamp(cells[0]):
        spans = [duration(cell) for cell in cells]
        if None in spans:
            wrong = cells[spans.index(None)].strip()[:24]
            raise DfsmError(
                f"{path}: {wrong!r} in '{name}' is no duration as the first is: correct it, or "
                "give the time in s from the start of the run"
            )
        seconds = np.array(spans, dtype=np.float64)
        return Stamps(seconds, cells[0].strip(), durations=True)
    for cell in cells:
        if not is_stamp(cell):
            raise DfsmError(
                f"{path}: {cell.strip()[:24]!r} in '{name}' is no time stamp as the first is: "
                "correct it, or give the time in s from the start of the run"
            )
    if _CLOCK.fullmatch(cells[0]):
        seconds = [_of_day(cell) for cell in cells]
        if None in seconds:
            raise _not_one(path, name)
        turned = np.array(seconds, dtype=np.float64)
        # Past midnight the clock begins again.
        days = np.cumsum(np.diff(turned, prepend=turned[0]) < -_DAY / 2)
        turned += _DAY * days
        return Stamps(turned - turned[0], cells[0].strip())
    return Stamps(_elapsed(path, name, cells), cells[0].strip())


def _of_day(cell: str) -> float | None:
    match = _CLOCK.fullmatch(cell)
    if match is None:
        return None
    return 3600 * int(match[1]) + 60 * int(match[2]) + float(match[3].replace(",", "."))


def _elapsed(path: Path, name: str, cells: Sequence[str]) -> Array:
    import pandas as pd

    tidy = [cell.strip().replace(",", ".") for cell in cells]
    try:
        return since_first(pd.to_datetime(tidy, format="ISO8601", utc=True).as_unit("ns").asi8)
    except ValueError:
        pass
    results: list[Array] = []
    for order in _ORDERS:
        for clock in _TIMES:
            try:
                stamps = pd.to_datetime(tidy, format=order + clock, utc=True)
            except ValueError:
                continue
            results.append(since_first(stamps.as_unit("ns").asi8))
    if not results:
        raise _not_one(path, name)
    # An order that makes time go back is not the one that was meant.
    ahead = [r for r in results if (np.diff(r) > 0).all()] or results
    if any(not np.array_equal(ahead[0], other) for other in ahead[1:]):
        raise DfsmError(
            f"{path}: whether {tidy[0]!r} in '{name}' begins with the day or the month is open, "
            "and both make sense: write it as 2016-01-31T12:00:00"
        )
    return ahead[0]


def since_first(nanoseconds: np.ndarray) -> Array:
    """Seconds since the first of some times in ns."""
    return (nanoseconds - nanoseconds[0]) / 1e9


def _not_one(path: Path, name: str) -> DfsmError:
    return DfsmError(
        f"{path}: the time stamps in '{name}' have no form that is known, or several: write them "
        "as 2016-01-31T12:00:00, or give the time in s from the start of the run"
    )

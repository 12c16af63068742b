"""Time stamps: dates and times of day as seconds since the first of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.errors import DfsmError

_STAMP = re.compile(
    r"\s*(\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4}|\d{8}(?=T)|"
    r"\d{1,2}-[A-Za-z]{3}-\d{4})"
    r"([T ]+\d{1,2}:?\d{2}(:?\d{2}([.,]\d+)?)?\s*(Z|[AaPp][Mm]|[-+]\d{2}:?\d{2})?)?\s*"
    r"|\s*\d{1,2}:\d{2}:\d{2}([.,]\d+)?\s*"
)
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
    """Times in s since the first stamp, shape ``(time,)``, and that stamp as it stands there."""

    seconds: Array
    first: str

    def note(self, name: str) -> str:
        """What a user should know."""
        return f"'{name}' holds time stamps: times are seconds since the first, {self.first}"


def is_stamp(text: str) -> bool:
    """Whether a text looks like a date, a date with a time, or a time of day."""
    return _STAMP.fullmatch(text) is not None


def read_stamps(path: Path, name: str, cells: Sequence[str]) -> Stamps:
    """Turn a column of time stamps into seconds since the first.

    Raises
    ------
    DfsmError
        A cell is none, or the order of day and month is open and matters.
    """
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

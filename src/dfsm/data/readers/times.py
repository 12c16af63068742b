"""What a time is called in a file, and what its numbers count: the one place for all formats.

A time is in seconds unless its unit says otherwise. Without a unit it may also count from 1970 (in
milliseconds and finer; in seconds where its name says so), or number days, as spreadsheets (from
1900) and MATLAB (from year 0) do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import factor

# How a time is called, first those that come first: a capital T is a temperature, a thrust, a
# tension or a period as often, so that it is the last.
_TIME, SMALL, OTHER_NAMED, CAPITAL = range(4)
_OTHER_NAMES = (
    *("time_s", "time_sec", "elapsed time", "elapsed_time", "elapsed", "zeit", "temps", "tiempo"),
    *("tempo", "tijd", "tid"),
)
# Names of columns that hold dates and time stamps, or numbers that count from a date.
_DATES = (
    *("timestamp", "time stamp", "time_stamp", "datetime", "date", "date time", "date_time"),
    *("date/time", "datum", "zeitstempel", "unixtime", "unix time", "unix_time", "unix timestamp"),
    *("unix_timestamp", "epoch", "epoch time", "epoch_time", "posixtime", "posix_time"),
    "datenum",
)
SECONDS = ("", "s", "s.", "sec", "sec.", "secs", "secs.", "second", "seconds")
# Share by which two intervals may differ that are one, written in few digits.
SAME_STEP = 0.02
# Numbers of time since 1970 in 2001 and in 2100, in s, and what times them there may count.
_SINCE_1970, _COUNTS = (1e9, 4.1e9), {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
# Numbers of the days of 2000 to 2050.
SPREADSHEET_DAYS = (36526, 54790)
_DAYS = {"spreadsheets do": SPREADSHEET_DAYS, "MATLAB does": (730486, 748750)}
_DAY, _HOUR = 86400.0, 3600.0
_MINUTES = (60.0, 120.0, 300.0, 600.0, 900.0, 1800.0)
# A step in days that is one of samples at 10 kHz, were it one in seconds.
_FAST = 1e-4
# Share of a step within which it is another one, and how far, in units of the last decimal, times
# lie off a mesh: both ends and the time between may be half a unit off.
_SLACK, _ENDS = 1e-3, 1.1
_MOST_DECIMALS = 10


def time_rank(name: str) -> int | None:
    """Which place a name has among those of a time, the lowest first; None for other names."""
    called = name.strip()
    if called == "T":
        return CAPITAL
    if called == "t":
        return SMALL
    if called.lower() == "time":
        return _TIME
    return OTHER_NAMED if called.lower() in _OTHER_NAMES else None


def is_date_name(name: str) -> bool:
    """Whether a name is that of dates, time stamps, or numbers that count from a date."""
    return name.strip().lower() in _DATES


def rises(values: Array, steps: Sequence[float] = ()) -> bool:
    """Whether samples are finite and increase, as those of a time do.

    Parameters
    ----------
    values
        Shape ``(time,)``.
    steps
        Intervals between samples in s that are told otherwise: a time agrees with one of them.
    """
    if len(values) < 2 or not np.isfinite(values).all() or not (np.diff(values) > 0).all():
        return False
    step = float((values[-1] - values[0]) / (len(values) - 1))
    return not steps or any(abs(step - told) <= SAME_STEP * told for told in steps)


def capital_note(name: str, unit: str) -> str:
    """What to tell where a capital T without a unit is the time; "" for other names."""
    if time_rank(name) != CAPITAL or unit:
        return ""
    return f"'{name}' is taken for the time, in s: it increases, and nothing else is called a time"


def seconds_of(name: str, unit: str, time: Array) -> tuple[Array, str]:
    """Times in s of what a time column holds, and what there is to tell ("" for nothing).

    Parameters
    ----------
    name, unit
        Of the column; a unit of time that the file states is believed, others say nothing of it.
    time
        As they stand there, shape ``(time,)``.

    Returns
    -------
    tuple
        Seconds since the first where they count from 1970 or number days, converted where they are
        in another unit; else as they are.
    """
    finite = bool(len(time)) and bool(np.isfinite(time).all())
    dated = is_date_name(name)
    low, high = _SINCE_1970
    size = 1.0 if unit.lower() in SECONDS else factor(unit, "s")
    if size is None:
        unit = ""  # a time zone, say, behind the name of dates
    elif unit and finite and (dated or size < 1) and low <= size * time.min() < high:
        # Doubles of this size tell no more than microseconds.
        since = np.round(size * (time - time[0]), 6)
        return since, f"'{name}' counts {unit} since 1970: times are seconds since the first"
    elif size != 1.0:
        for whose, (first, last) in _DAYS.items() if size == _DAY and finite else ():
            if first <= time.min() and time.max() < last:
                return _of_days(name, whose, time, dated=True)
        return size * time, f"'{name}' is in {unit}: times are converted to s"
    if unit or not finite:
        return time, ""
    # By themselves seconds are right as they are.
    for word, count in (({"seconds": 1.0} if dated else {}) | _COUNTS).items():
        if low * count <= time.min() and time.max() < high * count:
            note = f"'{name}' counts {word} since 1970: times are seconds since the first"
            return np.round((time - time[0]) / count, 6), note
    for whose, (first, last) in _DAYS.items():
        if first <= time.min() and time.max() < last:
            return _of_days(name, whose, time, dated=dated)
    return time, ""


def counts_from_a_date(name: str, time: Array) -> bool:
    """Whether numbers in a column with the name of dates are times; as in `seconds_of`."""
    return is_date_name(name) and bool(seconds_of(name, "", time)[1])


def _of_days(name: str, whose: str, time: Array, *, dated: bool) -> tuple[Array, str]:
    """Seconds of what may number days: whether it does shows in the steps."""
    unit = max(_rounding(time), 4 * float(np.spacing(time[-1])))
    step, at = _steps(time, unit)
    days = dated
    if not days and step > 0:
        exact = np.ptp(np.diff(time)) <= 8 * np.spacing(time[-1])
        slack = max(_SLACK, 2 * unit / float(time[-1] - time[0]))
        if step < _FAST:
            # Samples at 10 kHz and more, hours after the time began, have even steps.
            days = not (exact and _is_round(step, _SLACK))
        elif not _is_round(step, _SLACK):
            days = at is not None and unit < _FAST and _is_clock(step * _DAY, slack)
    if not days:
        # Whole hours are whole steps in s as well: nothing tells which.
        hours = 24 * step
        whole = hours > 1 - _SLACK and abs(hours - round(hours)) < _SLACK
        rounded = _is_round(step, _SLACK) or (unit >= _FAST and not _is_clock(step * _DAY, _SLACK))
        if step <= 0 or (rounded and not whole):
            return time, ""
        return time, (
            f"'{name}' runs from {time[0]:.10g} to {time[-1]:.10g}: read as s; if it numbers days, "
            f"as {whose}, convert it"
        )
    note = f"'{name}' numbers days as {whose}: times are seconds since the first"
    if at is not None:
        meant = at * _digits(step * _DAY, 3)
        if np.abs(time - time[0] - meant / _DAY).max() <= _ENDS * unit:
            return meant, note
    return (time - time[0]) * _DAY, note


def _steps(time: Array, unit: float) -> tuple[float, Array | None]:
    """The step of a mesh that may lack rows, and the number of steps from the first time.

    Parameters
    ----------
    time
        Shape ``(time,)``.
    unit
        What they are rounded to.

    Returns
    -------
    tuple
        The usual step and None where they lie on no mesh; 0 where they do not increase.
    """
    gaps = np.diff(time)
    usual = float(np.median(gaps)) if len(gaps) else 0.0
    if usual <= 0 or time[-1] <= time[0]:
        return 0.0, None
    at = np.arange(len(time), dtype=np.float64)
    step = float((time[-1] - time[0]) / at[-1])
    if np.abs(time - time[0] - step * at).max() <= _ENDS * unit:
        return step, at
    counts = np.rint(gaps / usual)
    at = np.concatenate([[0.0], np.cumsum(counts)])
    step = float((time[-1] - time[0]) / at[-1])
    even = (counts >= 1).all() and np.abs(time - time[0] - step * at).max() <= _ENDS * unit
    return (step, at) if even else (usual, None)


def _rounding(time: Array) -> float:
    """Last decimal that any of some times has; 0 where they have more than are looked for."""
    for decimals in range(_MOST_DECIMALS + 1):
        scaled = time * 10.0**decimals
        if np.abs(scaled - np.rint(scaled)).max() <= 4 * np.spacing(np.abs(scaled).max()):
            return 10.0**-decimals
    return 0.0


def _digits(value: float, count: int) -> float:
    return float(f"{value:.{count - 1}e}")


def _is_round(value: float, slack: float) -> bool:
    """Whether a step has two digits, within a share of it."""
    return value > 0 and abs(value - _digits(value, 2)) <= slack * value


def _is_clock(seconds: float, slack: float) -> bool:
    """Whether a step is one that clocks have: below a minute of two digits, else whole minutes."""
    if seconds < _MINUTES[0] * (1 - slack):
        return _is_round(seconds, slack)
    hours = seconds / _HOUR
    close = min(_MINUTES, key=lambda m: abs(m - seconds))
    return abs(close - seconds) <= slack * close or (
        round(hours) > 0 and math.isclose(hours, round(hours), rel_tol=slack)
    )

"""Rows at either end of a table that were never recorded: zeros, or the same row again and again.

A system at rest looks alike at first: all its rows are the same until an input steps. Then only the
input jumps, and the rest starts from where it stood. Rows that were not recorded end where (almost)
all channels jump at once; a record that freezes stops (almost) all of them in mid-motion, or lets
them go on from there, as what is filled up with the first sample does. Where
much follows an input without delay, few channels tell rest from nothing: a state that starts from
where it stood, closer than by chance, is enough.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array

# Fewer equal rows than this happen by chance in quantised files.
_FEWEST = 3
# Share of the channels that vary which must jump, or stop moving, at the same time.
_ALMOST_ALL = 0.7
# What is a jump and what a standstill, in changes from row to row beside it, and the share of the
# usual change (RMS over the run) that counts as motion.
_JUMP, _MOTION = 3.0, 0.3
# Rows beside the boundary that tell how channels move there; one may be at a turn for a while.
_BESIDE, _WHILE = 4, 20
# Times the longest row of equal rows inside that those at the end must be: some files round a lot.
_LONGER = 3
# How probable it may be that channels start so close to where they stood by chance.
_CHANCE = 0.05


def recorded_rows(time: Array, values: Array) -> tuple[slice, list[str]]:
    """Find the rows that were recorded.

    Parameters
    ----------
    time
        In s, shape ``(time,)``.
    values
        Shape ``(time, channel)``.

    Returns
    -------
    tuple[slice, list[str]]
        The rows to keep, and one sentence per end that is left out, or nearly was.
    """
    count, notes = len(values), list[str]()
    head, tail = _equal_rows(values), _equal_rows(values[::-1])
    if max(head, tail) > count - 2 * _BESIDE:
        return slice(0, count), notes
    start, stop = 0, count
    if head and _jumps(values[head - 1 :]):
        said = _told("first", values[:head], time[:head])
        if _starts_where_it_stood(values[head - 1 :]):
            notes.append(
                f"{said}; most jump then, but some start from where they stood, as where a system "
                "at rest is stepped: kept, set a start behind them if nothing was recorded there"
            )
        else:
            start = head
            notes.append(f"{said}, as where nothing was recorded: left out")
    elif head > _LONGER * _longest(values[head:]) and _moves_off(values[head - 1 :]):
        start = head - 1  # the last of the equal rows is as it was
        said = _told("first", values[:start], time[:start])
        notes.append(f"{said}, and then move off at full speed, as what was not recorded: left out")
    if tail:
        back = values[: count - tail + 1][::-1]
        if _jumps(back):
            stop = count - tail
        elif tail > _LONGER * _longest(values[: count - tail]) and _freezes(back):
            stop = count - tail + 1  # the first of the equal rows is as it was
        if stop < count:
            said = _told("last", values[stop:], time[stop:])
            notes.append(f"{said}, as where nothing was recorded: left out")
    return slice(start, stop), notes


def _equal_rows(values: Array) -> int:
    """Number of rows at the beginning in which every channel is as in the first; 0 for too few."""
    differs = np.flatnonzero((values != values[0]).any(axis=1))
    count = int(differs[0]) if len(differs) else len(values)
    return count if count >= _FEWEST else 0


def _longest(values: Array) -> int:
    """Length of the longest row of equal rows, at least 1."""
    changes = np.flatnonzero((np.diff(values, axis=0) != 0).any(axis=1))
    return int(np.diff(changes, prepend=-1, append=len(values) - 1).max())


def _varying(values: Array) -> NDArray[np.bool_]:
    """Which channels have all their samples and vary behind the second row."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(values).all(axis=0) & (np.diff(values[1:], axis=0) != 0).any(axis=0)


def _changes(values: Array, rows: int) -> tuple[Array, Array, Array]:
    """Of channels that vary: the first change, the usual one, and that in the rows beside (RMS)."""
    changes = np.diff(values[:, _varying(values)], axis=0)
    with np.errstate(over="ignore"):  # infinite is large enough to compare with
        usual = np.sqrt(np.mean(changes[1:] ** 2, axis=0))
        beside = np.sqrt(np.mean(changes[1 : 1 + rows] ** 2, axis=0))
    return np.abs(changes[0]), usual, beside


def _jumping(values: Array) -> NDArray[np.bool_]:
    """Which channels that vary jump from the first row, the last equal one, to the second."""
    first, usual, beside = _changes(values, _BESIDE)
    return first > _JUMP * np.maximum(beside, _MOTION * usual)


def _jumps(values: Array) -> bool:
    """Whether almost all channels jump from the first row, the last equal one, to the second."""
    jump = _jumping(values)
    return len(jump) > 0 and bool(jump.mean() >= _ALMOST_ALL)


def _starts_where_it_stood(values: Array) -> bool:
    """Whether channels go on from the first row, the last equal one, closer than by chance.

    A record that begins at any moment has no reason to begin there: the share of its rows that lie
    as close to the first row as the second does is how probable that is. Of many channels some are
    close by chance, for which Simes' test allows.
    """
    varies = _varying(values)
    away = np.abs(values[1:, varies] - values[0, varies])
    away = away[away.any(axis=1)]  # where all is back at rest, it says nothing
    chance = np.where(_jumping(values), 1.0, (away <= away[0]).mean(axis=0))
    allowed = _CHANCE * np.arange(1, len(chance) + 1) / len(chance)
    return bool((np.sort(chance) <= allowed).any())


def _freezes(values: Array) -> bool:
    """Whether almost all channels are in motion beside the first row, the first equal one.

    One that has settled moves less and less before.
    """
    _, usual, beside = _changes(values, _WHILE)
    moving = beside > _MOTION * usual
    return len(moving) > 0 and bool(moving.mean() >= _ALMOST_ALL)


def _moves_off(values: Array) -> bool:
    """Whether almost all channels are in motion at once behind the first row, the last equal one.

    What rests until an input moves begins slowly, and where an input jumps, that alone is fast.
    """
    first, usual, _ = _changes(values, _BESIDE)
    moving = first > _MOTION * usual
    return len(moving) > 1 and bool(moving.mean() >= _ALMOST_ALL) and not _jumping(values).any()


def _told(which: str, values: Array, time: Array) -> str:
    what = "hold the same values" if values[0].any() else "are zero"
    return f"the {which} {len(time)} rows ({time[0]:g} to {time[-1]:g} s) {what} in every channel"

"""Rows of words between the names of a table's columns and its first record, as loggers write them.

Campbell's TOA5 has units and a kind of processing there, HBM's catman what it knows of every
channel, imc and Dewesoft units. Times are named in their own ways, too.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import listed
from dfsm.data.readers.columns import split_header
from dfsm.data.readers.stamps import is_stamp
from dfsm.data.readers.text import Row, number
from dfsm.data.readers.times import SECONDS, time_rank
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError

# Names of the time that number it: "Time  1 - default sample rate" of catman.
_NUMBERED_TIME = re.compile(r"(?:time|zeit)\s+\d+\b.*", re.IGNORECASE)
_BLANK_SEPARATED = re.compile(r"\([^()]*\)|\[[^\[\]]*\]|\S+")
_BRACKETED = re.compile(r"\s*(\(.*\)|\[.*\])\s*")
# How a file of Campbell's loggers begins, and what stands there for the units of stamps and counts.
_TOA5, _NO_UNITS = re.compile(r'"?TOA5"?,'), ("TS", "RN")
_MOST = 60
# Blanks of other widths, and the one that breaks no line.
_SPACES = re.compile(r"[\u00a0\u2000-\u200a\u202f\u3000]")


def named_channels(cells: Sequence[str]) -> list[Channel]:
    """Channels by the cells of a header, ``Name [unit]``; ``Name(1)``, ``Name(2)`` are no units."""
    cells = [_SPACES.sub(" ", cell) for cell in cells]
    channels = [Channel(*split_header(cell)) for cell in cells]
    names = [c.name for c in channels]
    return [
        Channel("Time", c.unit)
        if _NUMBERED_TIME.fullmatch(c.name)
        else Channel(cell.strip(), "")
        if c.unit.isdigit() and names.count(c.name) > 1
        else c
        for c, cell in zip(channels, cells, strict=True)
    ]


def count_labels(rows: Sequence[Row]) -> int:
    """How many rows at the head of a table hold words alone; 0 where all do."""
    for count, row in enumerate(rows[: _MOST + 1]):
        if any(c.strip() and (number(c) is not None or is_stamp(c)) for c in row.cells):
            return count
    return 0


def label_rows(
    labels: Sequence[Row],
    lines: Sequence[str],
    header: int,
    channels: Sequence[Channel],
    blanks: bool,
) -> tuple[list[str] | None, str]:
    """Units that stand below the names, and what to tell of other rows of words.

    Parameters
    ----------
    labels
        The rows, see `count_labels`.
    lines
        Of the file.
    header
        Which of them holds the names, from 0.
    channels
        What the header says.
    blanks
        Whether blanks separate cells, so that units in brackets may hold some.

    Returns
    -------
    tuple
        None without a row of units: nobody knows then what these rows are.
    """
    found = None
    for row in labels:
        cells = _BLANK_SEPARATED.findall(lines[row.line - 1]) if blanks else row.cells
        if len(cells) == len(channels) and _are_units(cells, channels):
            found = row, [_bare(cell) for cell in cells]
            break
    if labels and header and _TOA5.match(lines[header - 1].lstrip("\ufeff")):
        units = ["" if cell.strip() in _NO_UNITS else cell.strip() for cell in labels[0].cells]
        found = (labels[0], units) if len(units) == len(channels) else found
    if found is None:
        return None, ""
    others = [row for row in labels if row is not found[0]]
    if not others:
        return found[1], ""
    first, last = others[0].line, others[-1].line
    where = f"line {first} holds" if first == last else f"lines {first} to {last} hold"
    return found[1], f"{where} words about the columns: passed over"


def _are_units(cells: Sequence[str], channels: Sequence[Channel]) -> bool:
    """Texts in brackets, or the time's unit in its place, or units that are known."""
    if any(_BRACKETED.fullmatch(cell) for cell in cells):
        return True
    times = [time_rank(c.name) is not None for c in channels]
    if any(t and u.strip().lower() in SECONDS[1:] for t, u in zip(times, cells, strict=True)):
        return True
    texts = [cell for cell in cells if cell.strip()]
    return 0 < len(texts) <= 2 * sum(map(listed, texts))


def _bare(unit: str) -> str:
    return unit.strip().strip("()[]").strip()


def without_more_times(
    path: Path,
    channels: Sequence[Channel],
    columns: Sequence[Array],
    time: int,
    kept: tuple[list[int], list[str]],
) -> tuple[list[int], list[str]]:
    """Leave out what repeats the time, as where every channel is exported with its own.

    Parameters
    ----------
    path
        The file.
    channels, columns
        Header and samples of every column.
    time
        The column of the time.
    kept
        Columns that are kept, and what there is to tell.

    Raises
    ------
    DfsmError
        Another time differs: the channels beside it were sampled at that one.
    """
    keep, notes = kept
    name, rank = channels[time].name.lower(), time_rank(channels[time].name)
    again = [j for j in keep if channels[j].name.lower() == name]
    # A T beside a t that holds something else is no time.
    again = [
        j
        for j in again
        if time_rank(channels[j].name) == rank or np.array_equal(columns[j], columns[time])
    ]
    for j in again:
        there = np.isfinite(columns[j])
        if not np.array_equal(columns[j][there], columns[time][there]):
            raise DfsmError(
                f"{path}: columns {time + 1} and {j + 1} are both called '{channels[time].name}' "
                "and hold other times, so channels were sampled apart: save those of one sampling "
                "in a file of their own"
            )
    if again:
        which = ", ".join(str(j + 1) for j in again)
        notes = [*notes, f"column{'s' * (len(again) > 1)} {which} left out: the time once more"]
    return [j for j in keep if j not in again], notes

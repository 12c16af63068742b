"""Tables in text: CSV, and columns separated by semicolons, tabs or blanks.

The header is the first line that names a time; lines above it may say anything, and lines that
begin with ``#``, ``%`` or ``!`` are comments (NumPy's ``savetxt`` writes the header as one). Units
stand in the header as ``PtfmPitch [deg]``, or in a row of their own below it. Without a time there
may be a column, a comment or a line above that tells the rate: ``fs = 50``, ``Ts``, ``dt [ms]``.
Numbers may have decimal commas, see `dfsm.data.readers.decimals`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import (
    ToldStep,
    agreed_step,
    kept_columns,
    no_time,
    rate_step,
    uniform_times,
)
from dfsm.data.readers.decimals import (
    split_thousands,
    thousands_in_columns,
    with_points,
    without_percent,
)
from dfsm.data.readers.guard import unguarded
from dfsm.data.readers.headers import (
    BLANKS,
    RATE,
    find_header,
    is_comment,
    rate_of,
    rows_below,
    without_empty_ends,
    without_repeats,
)
from dfsm.data.readers.labels import (
    count_labels,
    label_rows,
    named_channels,
    without_more_times,
)
from dfsm.data.readers.lvm import TITLE, read_lvm
from dfsm.data.readers.text import Layout, Row, decode, number, read_rows
from dfsm.data.readers.text_times import find_time
from dfsm.data.readers.times import capital_note, seconds_of
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError


def read_delimited(path: Path, step: float | None = None) -> Trajectory:
    """Read a run from an existing text table, see `dfsm.data.readers.tables.read_table`.

    Raises
    ------
    DfsmError
        No table, no time and no rate, or rows that do not fit.
    """
    text = decode(path, "a CSV table")
    if text.startswith(TITLE):
        return read_lvm(path, text)
    lines = text.split("\n")
    header = find_header(path, lines)
    if header is None:
        raise DfsmError(f"{path} holds blank lines only: check that it is the right file")
    names, rows = without_empty_ends(header.names, rows_below(path, lines, header))
    channels = named_channels([unguarded(cell) for cell in names])
    rows, percent = without_percent(rows, channels)
    rows, commas = with_points(path, rows, header.separator)
    labels = rows[: count_labels(rows)]
    units, words = label_rows(labels, lines, header.at, channels, header.separator == BLANKS)
    if units:
        channels = [Channel(c.name, c.unit or u) for c, u in zip(channels, units, strict=True)]
        rows = rows[len(labels) :]
    heads = [row.cells for row in labels] if units else []
    rows, repeats = without_repeats(rows, names, heads)
    channels = [
        Channel(c.name, c.unit or "%") if j in percent else c for j, c in enumerate(channels)
    ]
    rates = [] if step is None else [ToldStep(step, "", "was told")]
    if not rates:
        rates = _told_steps(lines[: header.at], channels, rows)
    found = find_time(path, channels, rows, [rate.step for rate in rates])
    rows, time = found.rows, found.at
    layout = Layout(
        path=path,
        names=[c.name for c in channels],
        time=time,
        ended=text.endswith("\n"),
        columns="columns",
        ragged=lambda row: _cure(row.cells, len(channels), header.separator),
        wrong=lambda _: "correct it",
    )
    table = read_rows(rows, layout)
    columns = list(table.values.T)
    channels = [Channel(c.name, c.unit, s) for c, s in zip(channels, table.steps, strict=True)]
    notes: list[str] = []
    if time is None:
        told, rate, notes = _uniform(path, channels, rates, len(table.values))
    elif table.stamps is not None:
        told, rate = columns[time], time
        stamped = [time] if found.date is None else [found.date, time]
        notes = [table.stamps.note(*(channels[j].name for j in stamped))]
    else:
        rate, channel = time, channels[time]
        told, note = seconds_of(channel.name, channel.unit, columns[time])
        notes = [note, capital_note(channel.name, channel.unit)]
    if header.separator == BLANKS:
        notes.append(thousands_in_columns([c.name for c in channels], rows))
    keep, left_out = kept_columns(path, channels, columns, rate)
    if time is not None:
        keep, left_out = without_more_times(path, channels, columns, time, (keep, left_out))
    keep = [j for j in keep if j != found.date]
    for j in table.words:
        if j in keep and rows:
            keep.remove(j)
            example = rows[0].cells[j].strip()[:24]
            left_out.append(f"column '{channels[j].name}' left out: it holds words ('{example}')")
    notes = [note for note in (*left_out, *notes, commas, words, repeats) if note]
    values = np.stack([columns[i] for i in keep], axis=1) if keep else np.empty((len(told), 0))
    return assemble(path, told, values, [channels[i] for i in keep], notes=(*table.notes, *notes))


# -- rate ---------------------------------------------------------------------------------------


def _told_steps(
    above: Sequence[str], channels: Sequence[Channel], rows: Sequence[Row]
) -> list[ToldStep]:
    """Intervals between samples that columns of one number, comments or lines above tell."""
    told: list[ToldStep] = []
    for j, channel in enumerate(channels):
        if rate_step(channel.name, 1.0, channel.unit) is None:
            continue
        found = [number(row.cells[j]) for row in rows if len(row.cells) == len(channels)]
        finite = {value for value in found if value is not None and np.isfinite(value)}
        step = rate_step(channel.name, finite.pop(), channel.unit) if len(finite) == 1 else None
        if step is not None:
            told.append(ToldStep(step, channel.name, f"stands in column '{channel.name}'"))
    for line in above:
        source = "stands in a comment" if is_comment(line) else "stands above the table"
        for match in RATE.finditer(line):
            if rate := rate_of(match):
                told.append(ToldStep(*rate, source))
    return told


def _uniform(
    path: Path, channels: Sequence[Channel], rates: Sequence[ToldStep], count: int
) -> tuple[Array, int | None, list[str]]:
    """Times of a record without any, the column that holds its rate, and what to tell."""
    if not rates:
        raise no_time(path, channels)
    rate, others = agreed_step(path, rates)
    at = next(
        (j for j, c in enumerate(channels) if rate.source == f"stands in column '{c.name}'"), None
    )
    note = f"there is no time column: samples every {rate.step:g} s, which {rate.source}"
    return uniform_times(path, count, rate.step), at, [note, others]


# -- what to do ---------------------------------------------------------------------------------


def _cure(row: list[str], columns: int, separator: str) -> str:
    # A comma between digits that was meant as a decimal point makes two cells of one.
    whole = all(re.fullmatch(r"\s*[-+]?\d+\s*", cell) for cell in row)
    if separator == "," and whole and columns < len(row) <= 2 * columns:
        return "if its decimals have commas, save it with points; else correct or remove the line"
    if separator == BLANKS and columns < len(row) and (number := split_thousands(row)):
        return (
            f"if a blank sets thousands apart in it, as in {number}, save the table without, or "
            "with semicolons between its columns; else correct or remove the line"
        )
    return "correct or remove the line"

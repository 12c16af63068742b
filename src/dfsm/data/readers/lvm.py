"""LabVIEW measurement files (`.lvm`): text in segments, each with a header of its own.

Layout: National Instruments, Specification for the LabVIEW Measurement File. A header is lines of a
tag and its values, up to ``***End_of_Header***``; that of the file tells how cells are separated,
which sign stands before decimals and whether rows begin with the time (``X_Columns``); those of the
segments tell channels, units, the first time (``X0``), the interval (``Delta_X``), and when the
segment was begun. How many samples a segment says it has is not always true, so rows are counted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import uniform_times
from dfsm.data.readers.decimals import with_points
from dfsm.data.readers.stamps import read_stamps
from dfsm.data.readers.text import Layout, Row, Table, number, read_rows
from dfsm.data.readers.times import SECONDS
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

TITLE = "LabVIEW Measurement"
_END, _TIME, _COMMENT = "***End_of_Header***", "X_Value", "Comment"
_SPECIAL = "***Start_Special***", "***End_Special***"
_SEPARATORS = {"tab": "\t", "comma": ","}
_TIMED = ("no", "one", "multi")
# Seconds from which times count from 1904, as absolute ones do.
_ABSOLUTE = 1e8
# Share of a step within which a segment follows on the one before.
_FOLLOWS = 0.5

_Tags = Mapping[str, Sequence[str]]


@dataclass(frozen=True)
class _File:
    """What the header of the file says: `timed` is its ``X_Columns``."""

    path: Path
    separator: str
    decimal: str | None
    timed: str


@dataclass
class _Segment:
    """Tags of a header with their values, names of the columns, and rows below."""

    tags: _Tags
    names: Sequence[str] = ()
    rows: list[Row] = field(default_factory=list)

    @property
    def line(self) -> int:
        return self.rows[0].line

    def told(self, tag: str, count: int) -> list[str]:
        """One value per channel, "" where the header does not say."""
        values = list(self.tags.get(tag, ()))[:count]
        return values + [""] * (count - len(values))


def read_lvm(path: Path, text: str) -> Trajectory:
    """Read a run from the text of a LabVIEW measurement file.

    Segments are one run: their times go on by themselves, or by the dates in their headers.

    Raises
    ------
    DfsmError
        No segment with rows; segments with other channels than the first; channels that are sampled
        at times of their own; an axis that is no time; rows that do not fit.
    """
    lines = text.split("\n")
    file, below = _file(path, lines)
    segments = [s for s in _segments(lines, below, file.separator) if s.rows]
    if not segments:
        raise DfsmError(f"{path}: no samples below its headers: check that it is the right file")
    names = _names(segments[0], file)
    units = _units(file, segments, names)
    table, note = _table(file, segments, names, ended=text.endswith("\n"))
    values, times = _columns(file, segments, names, table.values)
    time, notes = _joined(path, segments, times)
    first = {"no": 0, "one": 1, "multi": 1}[file.timed]
    steps = table.steps[first :: 2 if file.timed == "multi" else 1]
    channels = [Channel(*c) for c in zip(names, units, steps, strict=True)]
    notes = [*table.notes, *([note] if note else []), *notes]
    return assemble(path, time, values, channels, notes=notes)


# -- text to segments ---------------------------------------------------------------------------


def _file(path: Path, lines: Sequence[str]) -> tuple[_File, int]:
    """What the first header says, and the line below it."""
    either = [(s, *_tags(lines, 0, s)) for s in _SEPARATORS.values()]
    separator, tags, below = next((e for e in either if "Separator" in e[1]), either[0])
    told = [*tags.get("Separator", ()), "Tab"][0]
    if _SEPARATORS.get(told.lower()) != separator:
        raise DfsmError(f"{path}: its Separator is '{told}', expected Tab or Comma: correct it")
    decimal = next(iter(tags.get("Decimal_Separator", ())), None)
    if separator == "," and decimal == "":  # a comma between two that separate
        raise DfsmError(
            f"{path}: commas separate its cells and stand before decimals as well, so no number "
            "is sure: save it with tabs"
        )
    timed = [*tags.get("X_Columns", ()), "One"][0]
    if timed.lower() not in _TIMED:
        raise DfsmError(
            f"{path}: its X_Columns is '{timed}', expected No, One or Multi: correct it"
        )
    return _File(path, separator, decimal, timed.lower()), below


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip() for cell in line.split(separator)]


def _tags(lines: Sequence[str], at: int, separator: str) -> tuple[_Tags, int]:
    """Tags of a header that begins at a line, and the line below it."""
    tags: dict[str, list[str]] = {}
    for i in range(at, len(lines)):
        tag, *values = _cells(lines[i], separator)
        if tag == _END:
            return tags, i + 1
        if tag:
            tags.setdefault(tag, values)
    return tags, len(lines)


def _segments(lines: Sequence[str], at: int, separator: str) -> list[_Segment]:
    found: list[_Segment] = []
    special = False
    while at < len(lines):
        cells = _cells(lines[at], separator)
        line, at = at + 1, at + 1
        ended = special and cells[0] == _SPECIAL[1]
        special = not ended and (special or cells[0] == _SPECIAL[0])
        if special or ended or not any(cells):
            continue
        if cells[0] == _TIME and found and not found[-1].names:
            found[-1].names = cells
        elif cells[0] == _TIME:  # of a segment without a header of its own
            found.append(_Segment(found[-1].tags if found else {}, cells))
        elif not _begins_row(cells) and (header := _header(lines, line - 1, separator)):
            tags, at = header
            found.append(_Segment(tags))
        elif found and found[-1].names:
            found[-1].rows.append(Row(line, cells))
    return found


def _begins_row(cells: Sequence[str]) -> bool:
    return not cells[0] or number(cells[0].replace(",", ".")) is not None


def _header(lines: Sequence[str], at: int, separator: str) -> tuple[_Tags, int] | None:
    """Tags from a line on and the line below them; None where rows are among these lines."""
    tags, below = _tags(lines, at, separator)
    cells = [_cells(line, separator) for line in lines[at:below]]
    rows = any(any(c) and _begins_row(c) for c in cells)
    return None if rows or cells[-1][0] != _END else (tags, below)


# -- what the headers say -----------------------------------------------------------------------


def _names(segment: _Segment, file: _File) -> list[str]:
    names = list(segment.names)
    while names and names[-1] in ("", _COMMENT):  # a separator may end the line
        names.pop()
    return names[1::2] if file.timed == "multi" else names[1:]


def _units(file: _File, segments: Sequence[_Segment], names: list[str]) -> list[str]:
    """Units of the channels, which must be the same in all segments, over a time in s."""
    path, count = file.path, len(names)
    units = segments[0].told("Y_Unit_Label", count)
    for segment in segments:
        if _names(segment, file) != names or segment.told("Y_Unit_Label", count) != units:
            raise DfsmError(
                f"{path}: the segment at line {segment.line} has other channels or units than the "
                "first: save every group of channels in a file of its own"
            )
        axes = {a.lower() for a in segment.told("X_Dimension", count)} - {"", "time"}
        scales = {u.lower() for u in segment.told("X_Unit_Label", count)} - set(SECONDS)
        if axes or scales:
            what = f"in '{scales.pop()}'" if scales else f"'{axes.pop()}'"
            raise DfsmError(
                f"{path}: the X axis of the segment at line {segment.line} is {what}, expected a "
                "time in s: save the record over time"
            )
    return units


def _one(path: Path, segment: _Segment, tag: str, count: int) -> float:
    """What all channels of a segment must agree in."""
    told = sorted({t.replace(",", ".") for t in segment.told(tag, count)} - {""})
    values = {number(t) for t in told}
    if len(values) > 1:
        raise DfsmError(
            f"{path}: the channels of the segment at line {segment.line} differ in {tag} "
            f"({', '.join(told)}): save those of one sampling in a file of their own"
        )
    value = values.pop() if values else None
    if value is None:
        raise DfsmError(
            f"{path}: the segment at line {segment.line} has neither times in its rows nor a "
            f"number as {tag}: add it to its header"
        )
    return value


# -- samples and times --------------------------------------------------------------------------


def _table(
    file: _File, segments: Sequence[_Segment], names: Sequence[str], *, ended: bool
) -> tuple[Table, str]:
    """Numbers of all rows, times among them, and what to tell of their decimals."""
    rows = [row for segment in segments for row in segment.rows]
    headers = list(names)
    if file.timed == "multi":
        headers = [h for name in names for h in (f"{_TIME} of {name}", name)]
    elif file.timed == "one":
        headers = [_TIME, *names]
    elif wrong := next((r for r in rows if r.cells[0] and _begins_row(r.cells)), None):
        raise DfsmError(
            f"{file.path}, line {wrong.line}: {wrong.cells[0][:24]!r} stands where X_Columns No "
            "leaves nothing: correct it or remove the line"
        )
    first = int(file.timed == "no")
    width = first + len(headers)
    # Behind the channels there may be a comment, and a separator behind that; words may follow.
    rows = [
        Row(r.line, (r.cells if any(r.cells[width + 1 :]) else r.cells[:width])[first:] or [""])
        if not r.cells[0] or file.timed != "no"
        else r
        for r in rows
    ]
    note = ""
    if file.decimal is None:
        rows, note = with_points(file.path, rows, file.separator)
    elif file.decimal == ",":
        rows = [Row(r.line, [c.replace(",", ".") for c in r.cells]) for r in rows]
    layout = Layout(
        path=file.path,
        names=headers,
        time=None if file.timed == "no" else 0,
        ended=ended,
        columns="columns",
        ragged=lambda _: "correct or remove the line",
        wrong=lambda _: "correct it",
    )
    return read_rows(rows, layout), note


def _columns(
    file: _File, segments: Sequence[_Segment], names: Sequence[str], values: Array
) -> tuple[Array, list[Array]]:
    """Samples of all channels, and the times of every segment."""
    # A footer and a record that was cut off are no rows of the last segment.
    ends = np.minimum(np.cumsum([0, *(len(s.rows) for s in segments)]), len(values)).tolist()
    parts = [slice(a, b) for a, b in pairwise(ends)]
    if file.timed == "no":
        times = []
        for segment, part in zip(segments, parts, strict=True):
            first, step = (_one(file.path, segment, t, len(names)) for t in ("X0", "Delta_X"))
            times.append(first + uniform_times(file.path, part.stop - part.start, step))
        return values, times
    if file.timed == "one":
        return values[:, 1:], [values[part, 0] for part in parts]
    apart = (values[:, ::2] != values[:, :1]).any(axis=0)
    if apart.any():
        raise DfsmError(
            f"{file.path}: '{names[int(np.argmax(apart))]}' has times of its own, others than "
            f"'{names[0]}': save channels of one sampling in a file of their own"
        )
    return values[:, 1::2], [values[part, 0] for part in parts]


def _joined(
    path: Path, segments: Sequence[_Segment], times: Sequence[Array]
) -> tuple[Array, list[str]]:
    """Times of all segments in s, and what to tell of them."""
    notes, time = list[str](), np.concatenate(times)
    if len(time) and time[0] > _ABSOLUTE:
        notes.append("its times count from 1904: seconds since the first are taken")
        times, time = [t - time[0] for t in times], time - time[0]
    kept = [k for k, part in enumerate(times) if len(part)]
    if len(kept) < 2 or (np.diff(time) > 0).all():
        return time, notes
    begun = _begun(path, [segments[k].tags for k in kept])
    joined, moved = [times[kept[0]]], False
    for k, offset in zip(kept[1:], begun[1:], strict=True):
        part, before = times[k] + offset, joined[-1]
        step = float(np.median(np.diff(part if len(part) > 1 else before)))
        late = float(part[0] - before[-1]) - step
        if abs(late) < _FOLLOWS * step:
            part, moved = part - late, True
        joined.append(part)
    time = np.concatenate(joined)
    if not (np.diff(time) > 0).all():
        raise DfsmError(
            f"{path}: its {len(kept)} segments overlap by their dates and times: save each in a "
            "file of its own"
        )
    follows = ", and on the last where these are less than half a step off" if moved else ""
    notes.append(f"{len(kept)} segments follow one another by their dates and times{follows}")
    return time, notes


def _begun(path: Path, tags: Sequence[_Tags]) -> Array:
    """When segments were begun, in s after the first."""
    stamps = []
    for told in tags:
        date, clock = (next(iter(told.get(name, ())), "") for name in ("Date", "Time"))
        if not date or not clock:
            raise DfsmError(
                f"{path}: its {len(tags)} segments begin again at the same time and have no Date "
                "and Time that tell when each was begun: save each in a file of its own"
            )
        # More decimals than nanoseconds are written.
        whole, _, decimals = clock.replace(",", ".").partition(".")
        stamps.append(f"{date.replace('/', '-')} {whole}.{(decimals or '0')[:9]}")
    return read_stamps(path, "Date and Time", stamps).seconds

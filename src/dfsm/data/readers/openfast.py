"""OpenFAST results: binary `.outb` (formats 1 to 4), text `.out`, one under the other's name.

ROSCO's own logs are such text, too: a title, names, units.

openfast-io decodes the samples but validates nothing, so a file is checked against its own header
before that library sees it. Layout of the binary formats: `ReadFASTbinary.m` of NREL's
matlab-toolbox and `WrBinFAST` in OpenFAST's NWTC library.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dfsm.core.files import existing_file
from dfsm.core.types import Array
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import check_seconds, split_header
from dfsm.data.readers.headers import NAME_AND_UNIT, without_repeats
from dfsm.data.readers.long_run import LONG, LongRun, long_run
from dfsm.data.readers.text import Layout, Row, blank_cells, decode, number, read_rows
from dfsm.data.readers.times import seconds_of
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

WITH_TIME, WITHOUT_TIME, UNCOMPRESSED, WIDE_NAMES = 1, 2, 3, 4
DEFAULT_NAME_WIDTH = 10
# OpenFAST uses 10 or 20 characters; anything far above is a corrupted header, not a name.
MAX_NAME_WIDTH = 1024
HEADER_LINES = 200
# Numbers that are decoded at once of a long file.
_BLOCK = 2**20
# ROSCO's own logs: .dbg, .dbg2, .dbg3 by LoggingLevel (`Debug` in ROSCO_IO.f90).
ROSCO_LOG = ".dbg"
# A unit in brackets, blanks and all, or a word.
BRACKETED = re.compile(r"\([^()]*\)|\[[^\[\]]*\]|\S+")


def read_openfast(path: str | Path) -> Trajectory:
    """Read one OpenFAST result file.

    Whether a file is binary or text is told from its content, not its name. Channels of the
    16-bit formats carry the quantisation step that the file's scale factors state; uncompressed
    (format 3), text and constant channels carry none.

    Parameters
    ----------
    path
        An `.outb` or `.out` file.

    Returns
    -------
    Trajectory
        All channels but time and those marked `Invalid`; values have shape ``(time, channel)``
        in the units of the file. NaN is kept as it is.

    Raises
    ------
    DfsmError
        The file is missing, foreign, truncated or does not match its header; a text row is
        ragged or holds something that is no number (the line is named); time does not increase;
        openfast-io is not installed.
    """
    path = existing_file(path)
    with path.open("rb") as stream:
        start = stream.read(4096)
    # Text never holds a zero byte; the second byte of every binary format id is one.
    if path.suffix.lower() == ".outb" or b"\0" in start:
        return _read_binary(path)
    return _read_text(path)


# -- binary -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Header:
    names: tuple[str, ...]
    units: tuple[str, ...]
    scales: tuple[float, ...] | None
    left_over: int
    offsets: tuple[float, ...] = ()
    format_id: int = UNCOMPRESSED
    samples: int = 0
    times: tuple[float, float] = (0.0, 1.0)
    begins: int = 0


def _read_binary(path: Path) -> Trajectory:
    header = _check_header(path)
    load = _library("load_binary_output")
    try:
        # A channel that was NaN throughout leaves a useless scale factor: no reason to warn here.
        with np.errstate(all="ignore"):
            data, _, packed = load(str(path))
    except (OSError, ValueError, IndexError, OverflowError, MemoryError, struct.error) as error:
        raise DfsmError(
            f"{path} could not be decoded ({error}): it may have changed meanwhile; try again"
        ) from error
    values = np.array(data[:, 1:], dtype=np.float64)
    codes = packed[:, 1:]
    notes = []
    if header.left_over:
        notes.append(_left_over(header))
    channels = []
    for i, (name, unit) in enumerate(zip(header.names, header.units, strict=True)):
        step = None
        if header.scales is not None:
            if header.scales[i] == 0 or not np.isfinite(values[:, i]).all():
                values[:, i] = np.nan
                notes.append(
                    f"channel '{name}' has no usable scale factor in the file, its samples are NaN"
                )
            else:
                step = _step(values[:, i], codes[:, i])
        channels.append(Channel(name, unit, step))
    return assemble(path, data[:, 0], values, channels, notes=notes)


def _left_over(header: _Header) -> str:
    return (
        f"{header.left_over} bytes follow the {header.samples} samples that the header announces: "
        "passed over, and the run may have gone on"
    )


def long_openfast(path: Path) -> LongRun | None:
    """A long binary run whose scale factors are usable; None for any other file.

    Samples are decoded here, block by block; openfast-io holds all of them as Python numbers.
    """
    with path.open("rb") as stream:
        if b"\0" not in stream.read(4096):
            return None
    header = _check_header(path)
    count, samples = len(header.names), header.samples
    packed = header.scales is not None
    scales = header.scales or (1.0,) * count
    offsets = header.offsets or (0.0,) * count
    usable = all(scales) and np.isfinite([*scales, *offsets]).all()
    if 8 * samples * count < LONG or not usable:
        return None
    first, second = header.times
    time, begins = first + second * np.arange(samples), header.begins
    if header.format_id == WITH_TIME:
        with path.open("rb") as stream:
            stream.seek(begins)
            time = (np.fromfile(stream, "<i4", samples) - second) / first
        begins += 4 * samples

    def stored(place: int) -> NDArray[Any]:
        kind = np.dtype("<i2" if packed else "<f8")
        found = np.empty(samples, kind)
        rows = max(1, _BLOCK // count)
        with path.open("rb") as stream:
            stream.seek(begins)
            for start in range(0, samples, rows):
                stop = min(start + rows, samples)
                block = np.fromfile(stream, kind, (stop - start) * count)
                if len(block) < (stop - start) * count:
                    raise DfsmError(f"{path} has changed while it was read: try again")
                found[start:stop] = block.reshape(-1, count)[:, place]
        return found

    def column(place: int) -> Array:
        values = stored(place).astype(np.float64, copy=False)
        if packed:
            values -= offsets[place]
            values /= scales[place]
        return values

    channels = []
    for place, (name, unit) in enumerate(zip(header.names, header.units, strict=True)):
        step = None
        if packed:
            codes = stored(place)
            ends = np.array([codes.min(), codes.max()], dtype=np.float64)
            step = _step((ends - offsets[place]) / scales[place], ends)
        channels.append(Channel(name, unit, step))
    notes = (_left_over(header),) if header.left_over else ()
    return long_run(path, time, tuple(channels), column, notes=notes)


def _step(values: Array, codes: Array) -> float | None:
    """Slope of value over code between the extremes; None for a constant channel."""
    low, high = int(codes.argmin()), int(codes.argmax())
    if codes[low] == codes[high]:
        return None
    return float(abs(values[high] - values[low]) / (codes[high] - codes[low])) or None


def _check_header(path: Path) -> _Header:
    size = path.stat().st_size
    with path.open("rb") as stream:
        take = _taker(path, stream, size)
        (format_id,) = take("<h")
        if format_id not in (WITH_TIME, WITHOUT_TIME, UNCOMPRESSED, WIDE_NAMES):
            raise DfsmError(
                f"{path} is no binary OpenFAST output: its format id is {format_id}, expected 1, "
                "2, 3 or 4; check that it is the right file and was copied in binary mode"
            )
        width = take("<h")[0] if format_id == WIDE_NAMES else DEFAULT_NAME_WIDTH
        count, samples = take("<ii")
        _check_range(path, "name width", width, 1, MAX_NAME_WIDTH)
        _check_range(path, "number of channels", count, 1)
        _check_range(path, "number of samples", samples, 2)
        times = take("<dd")
        _check_time_fields(path, format_id, *times)
        scales, offsets = None, ()
        if format_id != UNCOMPRESSED:
            scales = take(f"<{count}f")
            offsets = take(f"<{count}f")
        (description,) = take("<i")
        _check_range(path, "description length", description, 0)
        take(f"<{description}s")
        names = _texts(take(f"<{(count + 1) * width}s")[0], width)
        units = _texts(take(f"<{(count + 1) * width}s")[0], width)
        row = count * (8 if format_id == UNCOMPRESSED else 2) + 4 * (format_id == WITH_TIME)
        begins = stream.tell()
        expected = begins + samples * row
    if size < expected:
        raise DfsmError(
            f"{path} is truncated: its header announces {count} channels and {samples} samples, "
            f"which makes {expected} bytes, but it has {size}; copy it again or rerun the "
            "simulation"
        )
    told = tuple(map(_unit, units[1:]))
    more = (offsets, format_id, samples, (times[0], times[1]), begins)
    return _Header(names[1:], told, scales, size - expected, *more)


def _taker(path: Path, stream: BinaryIO, size: int) -> Callable[[str], tuple]:
    def take(layout: str) -> tuple:
        wanted = struct.calcsize(layout)
        # Asked before reading, so that a corrupted count never allocates memory.
        data = stream.read(wanted) if stream.tell() + wanted <= size else b""
        if len(data) != wanted:
            raise DfsmError(
                f"{path} is truncated or no binary OpenFAST output: its {size} bytes end inside "
                "the header; copy it again or rerun the simulation"
            )
        return struct.unpack(layout, data)

    return take


def _check_range(path: Path, what: str, value: int, low: int, high: int | None = None) -> None:
    if value < low or (high is not None and value > high):
        expected = f"at least {low}" if high is None else f"{low} to {high}"
        raise DfsmError(
            f"{path} is corrupted or no binary OpenFAST output: its header gives a {what} of "
            f"{value}, expected {expected}; copy it again or rerun the simulation"
        )


def _check_time_fields(path: Path, format_id: int, first: float, second: float) -> None:
    if format_id == WITH_TIME:
        good = math.isfinite(first) and first != 0 and math.isfinite(second)
        what = f"time scale {first:g} and offset {second:g}"
    else:
        good = math.isfinite(first) and math.isfinite(second) and second > 0
        what = f"start time {first:g} s and time step {second:g} s"
    if not good:
        raise DfsmError(
            f"{path} is corrupted or no binary OpenFAST output: its header gives a {what}, which "
            "makes no increasing time; copy it again or rerun the simulation"
        )


def _texts(raw: bytes, width: int) -> tuple[str, ...]:
    # One byte is one character there; Latin-1 is what the format's other readers take it for.
    text = raw.decode("latin-1")
    return tuple(text[i : i + width].strip(" \t\0") for i in range(0, len(text), width))


def _unit(text: str) -> str:
    # A unit wider than its field has lost its closing bracket.
    return text[1:].rstrip(")]").strip() if text[:1] in ("(", "[") else text


# -- text ---------------------------------------------------------------------------------------


def _read_text(path: Path) -> Trajectory:
    text = decode(path, "text or binary OpenFAST output")
    lines = text.split("\n")
    header = _text_header(path, lines)
    names, units, below = header.names, header.units, header.end
    rows = [
        Row(i, blank_cells(line))
        for i, line in enumerate(lines[below:], start=below + 1)
        if line.strip()
    ]
    if not rows:
        raise DfsmError(f"{path}: no samples after its header, which ends in line {below}")
    layout = Layout(
        path=path,
        names=names,
        time=0,
        ended=text.endswith("\n"),
        columns="channels",
        ragged=lambda _: (
            "the run was cut off there or a value has filled its column; remove the line or rerun "
            "with a wider OutFmt"
        ),
        wrong=lambda _: "correct it, or rerun with a wider OutFmt",
    )
    heads = [blank_cells(line) for line in lines[header.at : below]]
    rows, repeats = without_repeats(rows, heads[0], heads[1:])
    table = read_rows(rows, layout)
    # Some drivers leave the unit of the time open.
    unit = "" if units[0] == "-" else units[0]
    check_seconds(path, names[0], unit)
    channels = [
        Channel(n, u, s) for n, u, s in zip(names[1:], units[1:], table.steps[1:], strict=True)
    ]
    time, values = table.values[:, 0], table.values[:, 1:]
    notes = [*table.notes, *([repeats] if repeats else [])]
    for j in table.words:
        notes.append(f"'{names[j]}' holds words ('{rows[0].cells[j][:24]}'): its samples are NaN")
    if table.stamps is not None:
        notes.append(table.stamps.note(names[0]))
    else:
        time, counted = seconds_of(names[0], unit, time)
        notes += [counted] if counted else []
    if path.suffix.lower().startswith(ROSCO_LOG) and len(time) > 1 and time[0] == time[1]:
        # ROSCO is called once before the simulation starts, and logs that call, too.
        time, values = time[1:], values[1:]
        notes.append(
            f"the first of two rows at {time[0]:g} s left out: the controller's start call"
        )
    return assemble(path, time, values, channels, notes=notes)


@dataclass(frozen=True)
class _TextHeader:
    """Line of the names and that of the first row, from 0; names, and units ("" for none)."""

    at: int
    end: int
    names: list[str]
    units: list[str]


def _text_header(path: Path, lines: list[str]) -> _TextHeader:
    """Find the line with the names, and the units beside them or in the next line if any.

    Drivers write headers of other lengths than OpenFAST, so the line is looked for.
    """
    for line, text in enumerate(lines[:HEADER_LINES], start=1):
        names = text.split()
        if len(names) < 2 or split_header(names[0])[0].lower() != "time":
            continue
        below = lines[line] if line < len(lines) else ""
        first = below.split()[:1]
        if first and (_is_number(first[0])):
            return _TextHeader(line - 1, line, *_with_units(text, len(blank_cells(below))))
        # Between tabs a unit may hold blanks or be empty; so may one in brackets hold blanks.
        named, tabbed = _tabbed(text), _tabbed(below)
        if len(named) > 1 and len(named) == len(tabbed):
            return _TextHeader(line - 1, line + 1, named, [_unit(u) for u in tabbed])
        for units in (below.split(), BRACKETED.findall(below)):
            if len(units) == len(names):
                return _TextHeader(line - 1, line + 1, names, [_unit(u) for u in units])
        # A title may begin with the word as well, but is not followed by units.
        if first and first[0].startswith(("(", "[")):
            raise DfsmError(
                f"{path}, line {line + 1}: {len(below.split())} units for the {len(names)} names "
                f"in line {line}, one unit per name was expected: the file is cut off or foreign"
            )
    raise DfsmError(
        f"{path} is no OpenFAST output: no line that starts with 'Time' among its first "
        f"{HEADER_LINES} lines; check that it is the right file"
    )


def _with_units(line: str, width: int) -> tuple[list[str], list[str]]:
    """Names of as many columns as a row of numbers has, and the units that stand beside them."""
    for names in (line.split(), _tabbed(line), NAME_AND_UNIT.findall(line)):
        if len(names) == width:
            split = [split_header(name) for name in names]
            # Brackets belong to a name where the time has none.
            if split[0][1]:
                return [name for name, _ in split], [unit for _, unit in split]
            return names, [""] * width
    return line.split(), [""] * len(line.split())


def _tabbed(line: str) -> list[str]:
    """Cells between tabs; one at the end of the line ends the last of them."""
    return [cell.strip() for cell in line.removesuffix("\t").split("\t")]


def _is_number(text: str) -> bool:
    return number(text) is not None


def _library(function: str) -> Callable[..., tuple]:
    try:
        from openfast_io import FAST_output_reader
    except ImportError:
        raise DfsmError(
            "reading OpenFAST files needs openfast-io, which is not installed: "
            "pip install 'dfsm[openfast]'"
        ) from None
    return getattr(FAST_output_reader, function)

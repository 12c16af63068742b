"""Bladed results: a header `.%NN` in text for every group of signals, its samples in `.$NN`.

The header is words in capitals with what belongs to them, over several lines where it is long:
``DIMENS`` sizes from the fastest on (signals, places such as blade stations, times), ``VARIAB`` and
``VARUNIT`` the signals, and for every further dimension ``AXISLAB``, ``AXIUNIT`` and either ``MIN``
and ``STEP`` or ``AXIVAL`` or ``AXITICK``. ``ACCESS`` D is binary, S text; ``FORMAT`` is the type of
the samples. What follows ``NVARS`` (extremes and means) is not needed. Units are letters of
dimensions, of SI: ``FL`` is a moment in N m.

`.$PJ`, the project beside them, stands for all groups of the run.

Source: result files of Bladed 4, and how openfast_toolbox reads them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import isfinite, prod
from pathlib import Path

import numpy as np

from dfsm.core.files import existing_file
from dfsm.core.types import Array
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.text import Layout, Row, blank_cells, decode, number, read_rows
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

_GROUP = re.compile(r"\.[%$](\d+)")
_PROJECT = ".$pj"
_TYPES = {"R*4": "<f4", "R*8": "<f8", "I*2": "<i2", "I*4": "<i4"}
_AXIS_WORDS = ("AXISLAB", "AXIUNIT", "AXIMETH", "AXIVAL", "AXITICK", "MIN", "STEP")
_WORDS = {
    *("FILE", "ACCESS", "FORM", "RECL", "FORMAT", "CONTENT", "CONFIG", "NDIMENS", "DIMENS"),
    *("GENLAB", "VARIAB", "VARUNIT", *_AXIS_WORDS),
}
_VALUE = re.compile(r"'([^']*)'|(\S+)")
# Letters of dimensions; N is a number without one.
_UNITS = {
    **{"M": "kg", "L": "m", "T": "s", "A": "rad", "F": "N"},
    **{"P": "W", "Q": "var", "V": "V", "I": "A"},
}


@dataclass(frozen=True, eq=False)
class _Group:
    """One group of signals.

    Attributes
    ----------
    path
        Its header.
    kind
        Type of the samples as NumPy calls it; None for text.
    shape
        Times (0 where the header does not tell), places, signals.
    channels
        One per place and signal, signals fastest.
    time
        Start and step in s, or all times.
    """

    path: Path
    kind: str | None
    shape: tuple[int, int, int]
    channels: list[Channel]
    time: tuple[float, float] | Array


def is_bladed(path: Path) -> bool:
    """Whether a file is called as Bladed calls its results."""
    suffix = path.suffix.lower()
    return suffix == _PROJECT or _GROUP.fullmatch(suffix) is not None


def read_bladed(path: str | Path) -> Trajectory:
    """Read a group of a Bladed run from its `.%NN` or `.$NN`, or all groups from the `.$PJ`.

    Signals at several places are called after both (``Blade 1 My at 20.2 m``).

    Raises
    ------
    DfsmError
        A file is missing, cut off, of an unknown type, over something else than time, or does not
        belong to its header.
    """
    path = existing_file(Path(path))
    if path.suffix.lower() == _PROJECT:
        return _read_run(path)
    header = existing_file(path.with_suffix(path.suffix.replace("$", "%")))
    group = _header(header)
    if isinstance(group, str):
        raise DfsmError(f"{header}: {group}, expected a time series: choose another group")
    time, values, channels, notes = _samples(group)
    return assemble(path, time, values, channels, notes=notes)


def _read_run(path: Path) -> Trajectory:
    """All groups of a run that lie on the mesh of most of them."""
    beside = (p for p in path.parent.iterdir() if p.stem == path.stem and "%" in p.suffix)
    headers = sorted((p for p in beside if is_bladed(p)), key=lambda p: int(p.suffix[2:]))
    notes: list[str] = []
    parts = []
    for header in headers:
        group = _header(header)
        if isinstance(group, str):
            notes.append(f"{header.name} left out: {group}")
            continue
        parts.append((header.name, *_samples(group)))
    if not parts:
        raise DfsmError(
            f"{path}: no results over time lie beside the project, expected {path.stem}.%04 and "
            "the like: copy all files of the run"
        )
    usual = Counter(time.tobytes() for _, time, *_ in parts).most_common(1)[0][0]
    kept = [part for part in parts if part[1].tobytes() == usual]
    notes += [
        f"{name} left out: its times are not those of {kept[0][0]}"
        for name, time, *_ in parts
        if time.tobytes() != usual
    ]
    notes += [f"{name}: {note}" for name, *_, told in kept for note in told]
    values = np.concatenate([part[2] for part in kept], axis=1)
    channels = [channel for part in kept for channel in part[3]]
    return assemble(path, kept[0][1], values, channels, notes=notes)


# -- header -------------------------------------------------------------------------------------


def _records(path: Path) -> list[tuple[str, list[str]]]:
    """Words of a header and what belongs to each, in order."""
    records: list[tuple[str, list[str]]] = []
    for line in decode(path, "a header of Bladed").split("\n"):
        first, *_ = line.split(maxsplit=1) or [""]
        if first in ("NVARS", "ULOADS"):
            break
        rest = line
        if first in _WORDS:
            records.append((first, []))
            rest = line.lstrip()[len(first) :]
        if records:
            records[-1][1].extend(a or b for a, b in _VALUE.findall(rest))
    return records


def _header(path: Path) -> _Group | str:
    """What a header tells; one of another axis than time as a few words about it."""
    records = _records(path)
    told = {word: values for word, values in records if word not in _AXIS_WORDS}
    axes: list[dict[str, list[str]]] = []
    for word, values in records:
        if word == "AXISLAB":
            axes.append({})
        if word in _AXIS_WORDS and axes:
            axes[-1][word] = values
    lost = [w for w in ("ACCESS", "FORMAT", "DIMENS", "VARIAB", "VARUNIT") if not told.get(w)]
    if lost:
        raise DfsmError(f"{path} is no header of Bladed: {lost[0]} is missing: check the file")
    sizes = [int(v) if re.fullmatch(r"[0-9]{1,12}", v) else -1 for v in told["DIMENS"]]
    names, units = told["VARIAB"], told["VARUNIT"]
    if min(sizes) < 0 or 0 in sizes[:-1] or len(sizes) != len(axes) + 1:
        raise DfsmError(
            f"{path}: DIMENS is {' '.join(told['DIMENS'])} for {len(axes)} axes, expected the "
            "number of signals and one of each axis: write it again"
        )
    if not len(names) == len(units) == sizes[0]:
        raise DfsmError(
            f"{path}: {len(names)} names and {len(units)} units, but DIMENS announces {sizes[0]} "
            "signals: write it again"
        )
    label = " ".join(axes[-1]["AXISLAB"])
    if label.lower() != "time" or _text(axes[-1], "AXIUNIT") not in ("T", "s", "S"):
        return f"its signals go over '{label}'"
    if prod(sizes[:-1]) > (size := _data(path).stat().st_size):
        raise DfsmError(
            f"{path}: {prod(sizes[:-1])} signals at one time are announced, its samples have "
            f"{size} bytes: copy both again"
        )
    places = [_places(path, axis, size) for axis, size in zip(axes[:-1], sizes[1:-1], strict=True)]
    return _Group(
        path=path,
        kind=_kind(path, told["ACCESS"][0].upper(), told["FORMAT"][0].upper()),
        shape=(sizes[-1], prod(sizes[1:-1]), sizes[0]),
        # The first of these axes runs fastest.
        channels=[
            Channel(name + "".join(f" at {p}" for p in reversed(place)), _unit(unit))
            for place in product(*reversed(places))
            for name, unit in zip(names, units, strict=True)
        ],
        time=_time(path, axes[-1], sizes[-1]),
    )


def _text(axis: dict[str, list[str]], word: str) -> str:
    return " ".join(axis.get(word, []))


def _kind(path: Path, access: str, form: str) -> str | None:
    if access not in ("D", "S"):
        raise DfsmError(f"{path}: ACCESS is '{access}', expected D (binary) or S (text): export it")
    if form not in _TYPES:
        raise DfsmError(
            f"{path}: its samples are of type '{form}', expected {', '.join(_TYPES)}: export them "
            "as one of these"
        )
    return _TYPES[form] if access == "D" else None


def _places(path: Path, axis: dict[str, list[str]], size: int) -> list[str]:
    """Names of the places along an axis."""
    values = axis.get("AXITICK") or axis.get("AXIVAL")
    if values is None:
        start, step = _start_and_step(path, axis)
        values = [str(start + step * i) for i in range(size)]
    if len(values) != size:
        raise DfsmError(
            f"{path}: {len(values)} places on the axis '{_text(axis, 'AXISLAB')}', but DIMENS "
            f"announces {size}: write it again"
        )
    if "AXITICK" in axis:
        return values
    unit = _unit(_text(axis, "AXIUNIT"))
    numbers = [number(v) for v in values]
    texts = [v if n is None else f"{n:.6g}" for v, n in zip(values, numbers, strict=True)]
    return texts if unit == "-" else [f"{text} {unit}" for text in texts]


def _time(path: Path, axis: dict[str, list[str]], count: int) -> tuple[float, float] | Array:
    """Start and step in s, or all times where they are listed."""
    if "AXIVAL" not in axis:
        return _start_and_step(path, axis)
    times = np.array([np.nan if (t := number(v)) is None else t for v in axis["AXIVAL"]])
    if len(times) != count or not np.isfinite(times).all():
        raise DfsmError(
            f"{path}: {len(times)} times are listed, but DIMENS announces {count}, all of them "
            "numbers: write it again"
        )
    return times


def _start_and_step(path: Path, axis: dict[str, list[str]]) -> tuple[float, float]:
    """Where an equidistant axis begins, and its step; the header has them in single precision."""
    start, step = (number(_text(axis, word) or "x") for word in ("MIN", "STEP"))
    if start is None or step is None or not (isfinite(start) and isfinite(step) and step > 0):
        raise DfsmError(
            f"{path}: MIN '{_text(axis, 'MIN')}' and STEP '{_text(axis, 'STEP')}' of the axis "
            f"'{_text(axis, 'AXISLAB')}' are no start and positive step: write it again"
        )
    return float(f"{start:.7g}"), float(f"{step:.7g}")


def _unit(letters: str) -> str:
    """Unit of letters of dimensions such as ``FL/TT``; others stay as they are."""
    above, *below = letters.split("/")
    if letters == "N" or len(below) > 1 or not letters:
        return "-" if letters == "N" else letters
    parts = [_factor(part) for part in (above, *below)]
    if None in parts:
        return letters
    return "/".join(str(part) for part in parts)


def _factor(letters: str) -> str | None:
    """A product of units, with powers: ``N m``, ``s^2``; 1 stays 1."""
    if letters == "1":
        return letters
    if not letters or any(letter not in _UNITS for letter in letters):
        return None
    powers = Counter(letters)
    return " ".join(_UNITS[x] if n == 1 else f"{_UNITS[x]}^{n}" for x, n in powers.items())


# -- samples ------------------------------------------------------------------------------------


def _samples(group: _Group) -> tuple[Array, Array, list[Channel], list[str]]:
    """Times in s, values ``(time, channel)``, channels with their steps, and what there is to tell.

    Raises
    ------
    DfsmError
        The file is missing, or not of the announced size.
    """
    data = _data(group.path)
    if group.kind is None:
        values, channels, notes = _from_text(data, group)
    else:
        values, channels, notes = _from_bytes(data, group, group.kind), group.channels, []
    if isinstance(group.time, tuple):
        start, step = group.time
        time = start + step * np.arange(len(values))
    else:
        time = group.time[: len(values)]
    return time, values, channels, notes


def _data(header: Path) -> Path:
    return existing_file(header.with_suffix(header.suffix.replace("%", "$")))


def _from_bytes(path: Path, group: _Group, kind: str) -> Array:
    times, places, signals = group.shape
    each = np.dtype(kind).itemsize
    width = places * signals * each
    size = path.stat().st_size
    # A run that goes on has not told its length yet.
    expected = (times or size // width) * width
    if size != expected or not size:
        raise DfsmError(
            f"{path}: {size} bytes, but its header announces {signals} signals at {places} "
            f"place{'s' * (places > 1)} and {times} times of {each} bytes, which makes {expected}: "
            "copy both again"
        )
    return np.fromfile(path, kind).astype(np.float64).reshape(-1, places * signals)


def _from_text(path: Path, group: _Group) -> tuple[Array, list[Channel], list[str]]:
    """One line per place and time: those of one time make one row."""
    times, places, _ = group.shape
    text = decode(path, "text of Bladed")
    lines = [(i, line) for i, line in enumerate(text.split("\n"), start=1) if line.strip()]
    whole = len(lines) // places * places
    notes = []
    if whole < len(lines):
        notes.append(
            f"line {lines[whole][0]} begins a time that not all {places} places have: left out"
        )
    rows = [_row(lines[i : i + places]) for i in range(0, whole, places)]
    layout = Layout(
        path=path,
        names=[channel.name for channel in group.channels],
        time=None,
        ended=text.endswith("\n") or whole < len(lines),
        columns="signals",
        ragged=lambda _: "the two do not belong together, or the run was cut off there",
        wrong=lambda _: "correct it",
    )
    table = read_rows(rows, layout)
    found = len(table.values)
    if not found or (times and found > times):
        raise DfsmError(f"{path}: {found} times, but its header announces {times}: copy both again")
    if found < times:
        notes.append(f"{found} times, the header announces {times}: the run ended early")
    channels = [
        Channel(c.name, c.unit, s) for c, s in zip(group.channels, table.steps, strict=True)
    ]
    return table.values, channels, [*table.notes, *notes]


def _row(lines: Sequence[tuple[int, str]]) -> Row:
    return Row(lines[0][0], [cell for _, line in lines for cell in blank_cells(line)])

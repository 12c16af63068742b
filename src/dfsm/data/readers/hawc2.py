"""HAWC2 results: `.sel` with `.dat`, in text or binary, and `.hdf5` (gtsdf).

The `.sel` holds a line with scans, channels, time and format, then one line per channel: its
number in 12 characters, name in 31, unit in 11, description. Binary samples are 16-bit integers,
channel after channel, in units of the scale factors at the end of the `.sel`; text goes row by row.
The time is one of the channels: in binary its largest value is 32000 codes away from 0, so that
700 s come in steps of 0.022 s. Scans are equidistant, the time of the line over the scans apart.

gtsdf is HDF5: names and units at the top, blocks with `data`, and with `gains` and `offsets` where
samples are integers, whose largest is a missing value. A block has a `time`, or start and step.

Sources: HAWC2 manual, section "output"; General Time Series Data Format 1.0 (DTU Wind Energy), and
its reader and writer in Wind Energy Toolbox (DTU), gtsdf.py.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.core.files import existing_file
from dfsm.core.types import Array
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import time_column
from dfsm.data.readers.text import Layout, Row, blank_cells, decode, number, read_rows
from dfsm.data.readers.times import seconds_of
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

_NUMBER, _NAME, _UNIT = slice(0, 12), slice(12, 43), slice(43, 54)
_SIZES = re.compile(r"\s*(\d+)\s+(\d+)\s+([-+.\deE]+)\s+(\w+)\s*")
_BINARY, _TEXT = "BINARY", "ASCII"
# The code of the largest value of a channel.
_LARGEST_CODE = 32000
# Share of a number that the six digits of a scale factor leave open, and s that the three decimals
# of the time do.
_ROUNDED, _LAST_DIGIT = 5e-6, 5e-4
# Fewer intervals say nothing of a mesh.
_FEWEST = 2


def is_hawc2(path: Path) -> bool:
    """Whether a file is a `.sel`, or a `.dat` beside one."""
    suffix = path.suffix.lower()
    return suffix == ".sel" or (suffix == ".dat" and path.with_suffix(".sel").exists())


def read_hawc2(path: str | Path) -> Trajectory:
    """Read a HAWC2 result from its `.sel` or its `.dat`; the other lies beside it.

    Channels of one name are told apart by their descriptions.

    Raises
    ------
    DfsmError
        One of the files is missing or cut off, or the two do not belong together.
    """
    path = Path(path)
    sel, dat = existing_file(path.with_suffix(".sel")), existing_file(path.with_suffix(".dat"))
    lines = decode(sel, "text of HAWC2").split("\n")
    matches = ((i, m) for i, m in enumerate(map(_SIZES.fullmatch, lines)) if m)
    above, sizes = next(matches, (0, None))
    if sizes is None or sizes[4].upper() not in (_BINARY, _TEXT):
        raise DfsmError(
            f"{sel} is no HAWC2 result: no line with scans, channels, time and format: check it"
        )
    scans, count = int(sizes[1]), int(sizes[2])
    lines = lines[above + 1 :]
    listed = [line for line in lines if re.fullmatch(r"\s+\d+\s+", line[_NUMBER].ljust(12) + " ")]
    listed = [line for line in listed if line[_NAME].strip()][:count]
    if len(listed) != count:
        raise DfsmError(f"{sel}: {len(listed)} channels, but it announces {count}: write it again")
    binary = sizes[4].upper() == _BINARY
    scales = _scales(sel, lines, count) if binary else None
    values = _binary(dat, scans, scales) if scales is not None else _text(dat, count)
    texts = [(t[_NAME].strip(), t[_UNIT].strip(), " ".join(t[54:].split())) for t in listed]
    steps = [None] * count if scales is None else list(scales)
    channels = _channels(texts, steps)
    at = time_column(sel, channels)
    keep = [i for i in range(count) if i != at]
    notes = []
    if len(values) != scans:
        notes.append(f"{len(values)} scans, the .sel announces {scans}: the run ended early")
    kept, time = [channels[i] for i in keep], values[:, at]
    if scales is not None:
        time, told = _times(sel, time, abs(scales[at]), number(sizes[3]) or 0.0)
        notes += told
    time, converted = seconds_of(channels[at].name, channels[at].unit, time)
    notes += [converted] if converted else []
    return assemble(path, time, values[:, keep], kept, notes=notes)


def _channels(
    texts: Sequence[tuple[str, str, str]], steps: Sequence[float | None]
) -> list[Channel]:
    """Channels by their names; those of one name by name and description."""
    often = Counter(name for name, _, _ in texts)
    return [
        Channel(name if often[name] == 1 else f"{name}: {told}", unit if unit != "-" else "", step)
        for (name, unit, told), step in zip(texts, steps, strict=True)
    ]


def _scales(path: Path, lines: list[str], count: int) -> list[float]:
    start = next((i for i, line in enumerate(lines) if line.lower().startswith("scale")), None)
    try:
        found = [float(line) for line in lines[(start or len(lines)) + 1 :] if line.strip()]
    except ValueError:
        found = []
    if len(found) != count or not np.isfinite(found).all():
        raise DfsmError(f"{path}: {len(found)} scale factors for {count} channels: write it again")
    return found


def _binary(path: Path, scans: int, scales: Sequence[float]) -> Array:
    expected = 2 * scans * len(scales)
    if path.stat().st_size != expected:
        raise DfsmError(
            f"{path}: {path.stat().st_size} bytes, but its .sel announces {len(scales)} channels "
            f"and {scans} scans, which makes {expected}: copy both again"
        )
    codes = np.fromfile(path, "<i2").reshape(len(scales), scans).T
    return codes * np.asarray(scales)


def _times(path: Path, rough: Array, unit: float, announced: float) -> tuple[Array, list[str]]:
    """Times in s of scans whose time channel is rounded to codes, and what is to be told of them.

    Parameters
    ----------
    path
        The `.sel`.
    rough
        Times in s as the channel has them, shape ``(time,)``.
    unit
        A code of the channel in s.
    announced
        Time that the `.sel` states for all scans, in s.

    Raises
    ------
    DfsmError
        Codes are too far apart to tell scans apart, and no equal interval goes through them.
    """
    last = len(rough) - 1
    if last < _FEWEST or not unit > 0:
        return rough, []
    index = np.arange(len(rough))
    slope = float(np.polyfit(index, rough, 1)[0])
    steps = [announced / (last + 1), announced / last]
    steps += [float(f"{slope:.{digits}g}") for digits in range(1, 10)]
    slack = _ROUNDED * float(np.abs(rough).max()) + _LAST_DIGIT
    for step in steps:
        if not 0 < step < np.inf:
            continue
        starts = rough - step * index
        room = unit - float(np.ptp(starts))
        if room < -slack:
            continue
        # The largest time lies on its code; of all others, the middle of what they leave open.
        largest = round(abs(rough[-1]) / unit) == _LARGEST_CODE
        start = float(starts[-1] if largest else (starts.max() + starts.min()) / 2)
        # Simulations start at 0, so that times are multiples of their step.
        whole = round(start / step)
        if abs(whole * step - start) <= max(room, 0.0) / 2 + slack:
            return (whole + index) * step, []
        return start + step * index, []
    if (np.diff(rough) <= 0).any():
        raise DfsmError(
            f"{path}: its time channel comes in steps of {unit:.3g} s, in which scans fall "
            "together, and no equal interval fits it: write the result as text or gtsdf"
        )
    return rough, [f"times are no equal steps and rounded to {unit:.3g} s, as their channel is"]


def _text(path: Path, count: int) -> Array:
    text = decode(path, "text of HAWC2")
    lines = enumerate(text.split("\n"), start=1)
    rows = [Row(i, blank_cells(line)) for i, line in lines if line.strip()]
    layout = Layout(
        path=path,
        names=[str(i + 1) for i in range(count)],
        time=0,
        ended=text.endswith("\n"),
        columns="channels",
        ragged=lambda _: "the run was cut off there; remove the line",
        wrong=lambda _: "correct it",
    )
    return read_rows(rows, layout).values


def is_gtsdf(content: Mapping[str, Any]) -> bool:
    """Whether the content of an HDF5 file is a General Time Series Data Format."""
    kind = np.ravel(np.asarray(content.get("@type", "")))
    return kind.size == 1 and str(kind[0]).lower() == "general time series data format"


def from_gtsdf(path: Path, content: Mapping[str, Any]) -> Trajectory:
    """Make a run of the content of a gtsdf file, see `read_hdf5`.

    Raises
    ------
    DfsmError
        No block, or blocks that do not fit together.
    """
    blocks = {n: content[n] for n in sorted(content) if re.fullmatch(r"block\d+", n)}
    parts = [
        _block(path, n, b) for n, b in blocks.items() if isinstance(b, Mapping) and "data" in b
    ]
    if not parts or len({v.shape[1] for _, v in parts}) > 1:
        raise DfsmError(f"{path}: it holds no blocks of samples that fit together: write it again")
    time, values = (np.concatenate(p) for p in zip(*parts, strict=True))
    count = values.shape[1]
    names = [str(n) for n in content.get("attribute_names", [])] or [
        f"Attribute {i + 1}" for i in range(count)
    ]
    units = [str(u) for u in content.get("attribute_units", [])] or [""] * count
    told = [" ".join(str(d).split()) for d in content.get("attribute_descriptions", [])] or [
        ""
    ] * count
    if not len(names) == len(units) == len(told) == count:
        raise DfsmError(
            f"{path}: {count} signals, but {len(names)} names, {len(units)} units and "
            f"{len(told)} descriptions: write it again"
        )
    steps = [None] * count
    return assemble(
        path, time, values, _channels(list(zip(names, units, told, strict=True)), steps)
    )


def _block(path: Path, name: str, block: Mapping[str, Any]) -> tuple[Array, Array]:
    """Times in s and samples ``(time, signal)`` of one block."""
    raw = np.atleast_2d(np.asarray(block["data"]))
    values = raw.astype(np.float64)
    if raw.dtype.kind in "iu":
        values[raw == np.iinfo(raw.dtype).max] = np.nan
    gains, offsets = np.ravel(block.get("gains", 1.0)), np.ravel(block.get("offsets", 0.0))
    if not {len(gains), len(offsets)} <= {1, values.shape[1]}:
        raise DfsmError(
            f"{path}: {name} has {len(gains)} gains and {len(offsets)} offsets for "
            f"{values.shape[1]} signals: write it again"
        )
    values = values * gains + offsets
    step, start = (
        _one_number(path, name, block, key, usual)
        for key, usual in (("time_step", 1.0), ("time_start", 0.0))
    )
    time = np.ravel(block.get("time", np.arange(len(values)))).astype(np.float64)
    if len(time) != len(values):
        raise DfsmError(f"{path}: {len(time)} times for {len(values)} samples: write it again")
    return time * step + start, values


def _one_number(
    path: Path, block: str, content: Mapping[str, Any], key: str, usual: float
) -> float:
    """Attribute of a block that is a number, or an array of one; `usual` where there is none."""
    found = np.ravel(np.asarray(content.get(f"@{key}", usual)))
    if found.size != 1 or found.dtype.kind not in "fiu" or not np.isfinite(found[0]):
        shown = ", ".join(str(v) for v in found[:4])[:60]
        raise DfsmError(
            f"{path}: {key} of {block} is '{shown}', one number in s was expected: write it again"
        )
    return float(found[0])

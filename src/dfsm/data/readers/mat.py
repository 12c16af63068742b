"""MAT files: structs of any depth, matrices, Simulink's output, and what `ReadFASTbinary` leaves.

Names are those of the workspace: ``body.position`` of 6 columns becomes ``body.position_1`` to
``_6``; arrays of structs count their elements (``bodies_1.position``). Simulink's *Structure With
Time* is ``time`` and ``signals.values``. A struct that is the only one names nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import (
    ToldStep,
    agreed_step,
    kept_columns,
    no_time,
    rate_step,
    time_column,
    uniform_times,
)
from dfsm.data.readers.hawc2 import from_gtsdf, is_gtsdf
from dfsm.data.readers.hdf5 import read_hdf5
from dfsm.data.readers.mat4 import is_mat4, read_mat4
from dfsm.data.readers.mat5 import OTHER, DamagedError, read_mat5
from dfsm.data.readers.times import (
    CAPITAL,
    OTHER_NAMED,
    SMALL,
    capital_note,
    counts_from_a_date,
    rises,
    seconds_of,
    time_rank,
)
from dfsm.data.readers.wecsim import is_label, is_wecsim, wecsim_unit
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

HDF5 = b"\x89HDF\r\n\x1a\n"
# Columns of a matrix that are worth a channel each; more are pictures and mode shapes.
_WIDEST = 100


def read_mat(path: Path, step: float | None = None) -> Trajectory:
    """Read a run from an existing MAT file, see `dfsm.data.readers.tables.read_table`.

    Raises
    ------
    DfsmError
        DamagedError, v7.3 (HDF5) without h5py, or without time and channels.
    """
    with path.open("rb") as stream:
        start = stream.read(520)
    if start.startswith((HDF5, b"MATLAB 7.3")) or start[512:] == HDF5:
        content = read_hdf5(path)
        if is_gtsdf(content):
            return from_gtsdf(path, content)
        content = {k: v for k, v in content.items() if not k.startswith("@")}
    else:
        try:
            content = read_mat4(path) if is_mat4(start) else read_mat5(path)
        except DamagedError as error:
            raise DfsmError(
                f"{path} is no readable MAT file ({error}): save it again with -v7"
            ) from None
    structs = {n: v for n, v in content.items() if isinstance(v, Mapping)}
    if not _is_run(content) and len(structs) == 1:
        ((outer, inside),) = structs.items()
        content = {**inside, **{n: v for n, v in content.items() if n not in (outer, *inside)}}
    if "Channels" in content:
        return _from_channels(path, content)
    return _from_variables(path, content, step)


def _is_run(content: Mapping[str, Any]) -> bool:
    """Whether variables hold a time or `Channels`."""
    return "Channels" in content or any(_rank(n) is not None for n in content)


def _from_channels(path: Path, content: Mapping[str, Any]) -> Trajectory:
    if "ChanName" not in content:
        raise DfsmError(
            f"{path}: it holds Channels but no ChanName: save ChanName and ChanUnit with it"
        )
    names = _strings(content["ChanName"])
    units = _strings(content["ChanUnit"]) if "ChanUnit" in content else [""] * len(names)
    try:
        table = np.atleast_2d(np.asarray(content["Channels"], dtype=np.float64))
    except (TypeError, ValueError):
        raise DfsmError(f"{path}: its Channels are no table of real numbers") from None
    if not table.shape[1:] == (len(names),) == (len(units),):
        raise DfsmError(
            f"{path}: Channels is {' x '.join(map(str, table.shape))}, but there are {len(names)} "
            f"ChanName and {len(units)} ChanUnit; expected one column each: save them again"
        )
    channels = [Channel(n, u.strip("()[]")) for n, u in zip(names, units, strict=True)]
    at = time_column(path, channels, lambda i: rises(table[:, i]))
    time, told = seconds_of(channels[at].name, channels[at].unit, table[:, at])
    keep, notes = kept_columns(path, channels, list(table.T), at)
    notes += [n for n in (told, capital_note(channels[at].name, channels[at].unit)) if n]
    return assemble(path, time, table[:, keep], [channels[i] for i in keep], notes=notes)


def _from_variables(path: Path, content: Mapping[str, Any], step: float | None) -> Trajectory:
    """Every vector and matrix that is as long as the time."""
    found, wecsim = dict(_flat(content, "")), is_wecsim(content)
    if wecsim:
        found = {n: v for n, v in found.items() if not is_label(v)}
    numbers = {
        n: v for n, v in found.items() if isinstance(v, np.ndarray) and v.dtype.kind in "fiub"
    }
    rates = _told_steps(numbers, step)
    time_name = _time_name(numbers, [rate.step for rate in rates])
    notes: list[str] = []
    told = ""
    if time_name is None:
        raw, rate, notes = _without_time(path, found, numbers, rates)
        time, told = raw, rate.name
    else:
        raw, called = np.ravel(numbers[time_name]).astype(np.float64), _last(time_name)
        time, note = seconds_of(called, "", raw)
        notes = [n for n in (note, capital_note(called, "")) if n]
    chosen = None if time_name is None else _rank(time_name)
    columns: list[Array] = []
    channels: list[Channel] = []
    for name, value in found.items():
        if name in (time_name, told):
            continue
        rank = _rank(name) if name in numbers else None
        # What is called elapsed or the like beside a time is a signal; so is a T that differs.
        same = rank is not None and _same_times(numbers[name], raw)
        if same and (rank != OTHER_NAMED or rank == chosen):
            continue
        if chosen is not None and rank is not None and rank <= max(chosen, SMALL):
            notes.append(f"'{name}' left out: it is another time than '{time_name}'")
            continue
        table = _along(numbers.get(name), len(time))
        other = None if chosen is None else _own_time(name, numbers, max(chosen, SMALL))
        if table is None or (other is not None and not _same_times(numbers[other], raw)):
            notes.append(f"'{name}' left out: {_why(value, len(time), other)}")
            continue
        width = table.shape[1]
        columns += list(table.T)
        names = [name] if width == 1 else [f"{name}_{i + 1}" for i in range(width)]
        units = [wecsim_unit(name, i, width) if wecsim else "" for i in range(width)]
        channels += map(Channel, names, units)
    values = np.stack(columns, axis=1) if columns else np.empty((len(time), 0))
    return assemble(path, time, values, channels, notes=notes)


def _flat(content: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Names and values of what is no struct, depth first."""
    for name, value in content.items():
        if name.startswith("@"):
            continue
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and all(isinstance(v, Mapping) for v in value):
            numbered = {f"{name}_{i + 1}": v for i, v in enumerate(value)}
            yield from _flat(numbered, prefix)
        else:
            yield f"{prefix}{name}", value


def _last(name: str) -> str:
    return name.rsplit(".", 1)[-1]


def _rank(name: str) -> int | None:
    """As `time_rank`; Simulink calls the time tout."""
    last = _last(name)
    if last.lower() == "tout":
        return time_rank("t" if last == "tout" else "T")
    return time_rank(last)


def _time_name(numbers: Mapping[str, np.ndarray], steps: Sequence[float]) -> str | None:
    """The time: one that signals are as long as, that lies least deep, in the first struct.

    Of several there the longest, of these by its name. What counts from a date comes behind them,
    a T last: where it increases, by the steps that are told if any are.
    """
    vectors = {n: v for n, v in numbers.items() if v.size > 1 and v.size == max(v.shape)}
    named = {n: rank for n in vectors if (rank := _rank(n)) is not None}
    signals = [v for n, v in numbers.items() if named.get(n, CAPITAL) == CAPITAL]
    usable = {
        n: any(_along(s, vectors[n].size) is not None for s in signals if s is not vectors[n])
        for n, rank in named.items()
        if rank != CAPITAL or rises(np.ravel(vectors[n]).astype(np.float64), steps)
    }
    folders = list(dict.fromkeys(n.rpartition(".")[0] for n in usable))

    def place(name: str) -> tuple[bool, bool, int, int, int, int]:
        folder, rank = folders.index(name.rpartition(".")[0]), named[name]
        size = vectors[name].size
        return rank == CAPITAL, not usable[name], name.count("."), folder, -size, rank

    best = min(usable, key=place, default=None)
    if best is not None and not usable[best] and steps:
        best = None
    if best is None or named[best] == CAPITAL:
        dated = (n for n, v in vectors.items() if counts_from_a_date(_last(n), np.ravel(v)))
        return next(dated, best)
    return best


def _own_time(name: str, numbers: Mapping[str, np.ndarray], lowest: int) -> str | None:
    """The time in the same struct as a variable, or in the nearest around it.

    One whose name comes after this rank is a signal.
    """
    folder = name
    while "." in folder:
        folder = folder.rsplit(".", 1)[0]
        for other in numbers:
            rank = _rank(other) if other.rpartition(".")[0] == folder else None
            if rank is not None and rank <= lowest:
                return other
    return None


def _same_times(values: np.ndarray, time: Array) -> bool:
    other = np.ravel(values)
    return other.shape == time.shape and bool(np.allclose(other, time, rtol=1e-9, atol=0.0))


def _told_steps(numbers: Mapping[str, np.ndarray], step: float | None) -> list[ToldStep]:
    """Intervals between samples that are told, or stand in variables."""
    if step is not None:
        return [ToldStep(step, "", "was told")]
    told = {
        name: rate_step(_last(name), float(value.ravel()[0]))
        for name, value in numbers.items()
        if value.size == 1
    }
    return [ToldStep(s, n, f"stands in '{n}'") for n, s in told.items() if s is not None]


def _without_time(
    path: Path,
    found: Mapping[str, Any],
    numbers: Mapping[str, np.ndarray],
    rates: Sequence[ToldStep],
) -> tuple[Array, ToldStep, list[str]]:
    """Times of a record that tells its rate, where that stands, and what to tell."""
    if not rates and found.get("output") is OTHER:
        raise DfsmError(
            f"{path}: no time, and 'output' is an object that only MATLAB reads: save it as a "
            "struct (output = struct(output); save('run.mat', 'output'))"
        )
    if not rates:
        raise no_time(path, [Channel(f"{n} ({_what(v)})") for n, v in found.items()])
    lengths = [
        max(v.shape) for n, v in numbers.items() if v.size > 1 and _rank(n) in (None, CAPITAL)
    ]
    if not lengths:
        raise DfsmError(f"{path}: no signal, expected vectors of one length beside the rate")
    # Signals of one record have one length; the one that most of them have.
    count = max(dict.fromkeys(lengths), key=lengths.count)
    rate, others = agreed_step(path, rates)
    note = f"there is no time: samples every {rate.step:g} s, which {rate.source}"
    return uniform_times(path, count, rate.step), rate, [n for n in (note, others) if n]


def _along(values: np.ndarray | None, count: int) -> Array | None:
    """Samples as ``(time, column)``; None where no dimension is as long as the time."""
    if values is None or values.size == 0:
        return None
    array = np.squeeze(values)
    # Simulink puts time last in signals of more than one dimension.
    axes = [a for a in range(array.ndim) if array.shape[a] == count]
    if not axes:
        return None
    table = np.moveaxis(array, axes[0] if array.ndim < 3 else axes[-1], 0).reshape(count, -1)
    return table.astype(np.float64) if table.shape[1] <= _WIDEST else None


def _why(value: Any, count: int, other: str | None) -> str:
    if (
        other is not None
        and _along(value if isinstance(value, np.ndarray) else None, count) is not None
    ):
        return f"'{other}' is another time"
    return f"it is {_what(value)}, no real vector of {count} values, the length of the time"


def _what(value: Any) -> str:
    """A variable in few words."""
    if isinstance(value, np.ndarray):
        return "empty" if not value.size else " x ".join(map(str, value.shape))
    if isinstance(value, str):
        return value if value is OTHER else "a text"
    return f"{len(value)} cells" if isinstance(value, list) else "no numbers"


def _strings(value: Any) -> list[str]:
    # A cell array of strings, a padded character matrix, or one string alone.
    return [str(v).strip() for v in np.ravel(np.asarray(value, dtype=object))]

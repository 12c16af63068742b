"""Parquet: runs with everything a `Channel` knows, plain or packed as 16-bit codes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from dfsm.core.files import write_file
from dfsm.core.types import Array
from dfsm.data.readers.arrow import changing_dates, is_stamped, without_words
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import (
    kept_columns,
    split_header,
    time_column,
    uniform_times,
)
from dfsm.data.readers.guard import check_run_name
from dfsm.data.readers.long_run import LONG, LongRun, long_run
from dfsm.data.readers.parquet_times import (
    stamped_or_counted,
    stamped_seconds,
    time_index,
)
from dfsm.data.readers.times import seconds_of
from dfsm.data.trajectory import Channel, Role, Trajectory
from dfsm.errors import DfsmError

if TYPE_CHECKING:
    import pyarrow as pa

CODE_MIN, CODE_MAX = -32768, 32767
# Key of the digest of all that is not in the pages.
_HEADER = "dfsm.header"
# How far, in steps, a sample may lie off the grid: rounding in float64 stays far below.
GRID_SLACK = 1e-3
# The codes' place in the 16-bit range is tried out where they leave room.
MAX_SHIFTS = 64


def read_parquet(path: Path, step: float | None = None) -> Trajectory:
    """Read a run from an existing Parquet file, see `dfsm.data.readers.tables.read_table`.

    Raises
    ------
    DfsmError
        Damaged, without time or numbers, or metadata that make no sense.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read()
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise _unreadable(path, error) from error
    schema = _texts(table.schema.metadata)
    _check_header(path, table, schema)
    kinds = dict(zip(table.schema.names, table.schema.types, strict=True))
    dates = changing_dates(table)
    table, words = without_words(table)
    units = _pandas_units(schema)
    fields = [_with_shared(path, field, schema) for field in table.schema]
    channels = [_channel(path, field, units) for field in fields]
    columns = [_column(path, table, i, field) for i, field in enumerate(fields)]
    if "dfsm.time_start" in schema:
        at, start = None, _number(path, schema, "dfsm.time_start")
        time = start + _number(path, schema, "dfsm.time_step") * np.arange(table.num_rows)
    else:
        try:
            pandas = schema.get("pandas")
            at = time_index(path, table.schema, channels, pandas, columns, step)
        except DfsmError:
            _check_time_of_words(path, words)
            raise
        _check_dates(path, table.schema, at, dates)
        time = uniform_times(path, table.num_rows, step or 0.0) if at is None else columns[at]
    keep, notes = kept_columns(path, channels, columns, at)
    notes += [f"column '{name}' left out: it holds {told}" for name, told in words.items()]
    for i in [i for i in keep if is_stamped(fields[i])]:
        keep.remove(i)
        notes.append(f"column '{channels[i].name}' left out: it holds time stamps beside the time")
    if at is not None:
        time, told = stamped_or_counted(table, at, channels[at], time)
        notes += told
    if not keep:
        for name in words:
            raise DfsmError(
                f"{path}: column '{name}' holds {kinds[name]}, expected numbers: no other is there "
                "besides the time, convert it"
            )
        raise DfsmError(f"{path}: no channel besides time, at least one is needed")
    return assemble(
        path,
        time,
        np.stack([columns[i] for i in keep], axis=1),
        [channels[i] for i in keep],
        name=check_run_name(path, schema.get("dfsm.name", "")) or None,
        wall_time=_number(path, schema, "dfsm.wall_time") if "dfsm.wall_time" in schema else None,
        notes=(*_notes(path, schema), *notes),
    )


def long_parquet(path: Path) -> LongRun | None:
    """A long run of plain columns; None for all else, which `read_parquet` reads or refuses."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            rows, schema = file.metadata.num_rows, file.schema_arrow
    except (pa.ArrowException, OSError, ValueError):
        return None
    metadata = _texts(schema.metadata)
    if 8 * rows * len(schema) < LONG or (
        _HEADER in metadata and metadata[_HEADER] != _header_digest(schema, rows)
    ):
        return None
    units = _pandas_units(metadata)
    try:
        fields = [_with_shared(path, field, metadata) for field in schema]
        channels = [_channel(path, field, units) for field in fields]
        at, time = None, np.empty(0)
        if "dfsm.time_start" in metadata:
            step = _number(path, metadata, "dfsm.time_step")
            time = _number(path, metadata, "dfsm.time_start") + step * np.arange(rows)
        else:
            at = time_column(path, channels)
        wall = _number(path, metadata, "dfsm.wall_time") if "dfsm.wall_time" in metadata else None
        notes, name = _notes(path, metadata), check_run_name(path, metadata.get("dfsm.name", ""))
    except DfsmError:
        return None
    plain = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
    if not all(any(kind(field.type) for kind in plain) for field in fields):
        return None
    keep = [i for i in range(len(fields)) if i != at]

    def column(i: int) -> Array:
        values, done, name = np.empty(rows), 0, fields[i].name
        try:
            with pq.ParquetFile(path, page_checksum_verification=True) as file:
                # Group by group: a reader of all groups holds all of the column.
                for group in range(file.num_row_groups):
                    for batch in file.iter_batches(
                        2**18, row_groups=[group], columns=[name], use_threads=False
                    ):
                        part = pa.Table.from_batches([batch]).select([name])
                        values[done : done + len(part)] = _column(path, part, 0, fields[i])
                        done += len(part)
        except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
            raise _unreadable(path, error) from error
        pa.default_memory_pool().release_unused()
        return values

    if at is not None:
        time, told = seconds_of(channels[at].name, channels[at].unit, column(at))
        notes = (*notes, *([told] if told else []))
    return long_run(
        path,
        time,
        tuple(channels[i] for i in keep),
        lambda place: column(keep[place]),
        name=name or None,
        wall_time=wall,
        notes=tuple(notes),
    )


def _unreadable(path: Path, error: BaseException) -> DfsmError:
    reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
    return DfsmError(
        f"{path} is no readable Parquet file ({reason}): it is damaged or of another kind; "
        "write it again"
    )


def write_parquet(trajectory: Trajectory, path: Path, *, packed: bool) -> None:
    """Write a run to Parquet, see `dfsm.write_table`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = {"dfsm.name": trajectory.name, "dfsm.notes": json.dumps(trajectory.notes)}
    if trajectory.source:
        # The file's name says where the data came from; the folder is nobody else's business.
        schema["dfsm.source"] = Path(trajectory.source).name
    if trajectory.wall_time is not None:
        schema["dfsm.wall_time"] = repr(trajectory.wall_time)
    fields, arrays, coded = [], [], {}
    mesh = _equidistant(trajectory) if packed else None
    if mesh is None:
        fields.append(pa.field("Time", pa.float64(), metadata={"unit": "s"}))
        arrays.append(_array(trajectory.time))
    else:
        schema["dfsm.time_start"], schema["dfsm.time_step"] = map(repr, mesh)
    for channel, values in zip(trajectory.channels, trajectory.values.T, strict=True):
        known = {"unit": channel.unit}
        if channel.step is not None:
            known["step"] = repr(float(channel.step))
        if channel.role is not None:
            known["role"] = channel.role
        codes = _pack(values, channel.step) if packed and channel.step else None
        if codes is None:
            arrays.append(_array(values))
        else:
            numbers, scale, offset = codes
            known |= {"scale": repr(scale), "offset": repr(offset)}
            arrays.append(_array(numbers))
            coded[channel.name] = "DELTA_BINARY_PACKED"
        fields.append(pa.field(channel.name, arrays[-1].type, metadata=known))
    table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=schema))
    schema[_HEADER] = _header_digest(table.schema, table.num_rows)
    table = table.replace_schema_metadata(schema)
    options: dict[str, Any] = {"compression": "zstd", "compression_level": 19 if packed else 3}
    options["write_page_checksum"] = True
    if coded:
        options |= {"use_dictionary": False, "column_encoding": coded}
    with write_file(path) as temporary:
        pq.write_table(table, temporary, **options)


def _array(values: Array | NDArray[np.int32]) -> pa.Array:
    """Arrow's array of numbers. ``pyarrow.array`` would import pandas to see what it was given."""
    import pyarrow as pa

    content = pa.py_buffer(np.ascontiguousarray(values))
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, content])


def _floats(column: pa.ChunkedArray) -> Array:
    """Numbers of a column, NaN where there is none."""
    import pyarrow as pa

    if column.null_count or pa.types.is_boolean(column.type) or not column.num_chunks:
        return column.cast(pa.float64(), safe=False).to_numpy()
    # Both of the above import pandas.
    return np.concatenate([np.from_dlpack(part).astype(np.float64) for part in column.chunks])


def _header_digest(schema: pa.Schema, rows: int) -> str:
    """SHA-256 of what the checksums of pages leave out: sizes, names, types and metadata."""
    fields = [[f.name, str(f.type), sorted(_texts(f.metadata).items())] for f in schema]
    known = {k: v for k, v in _texts(schema.metadata).items() if k != _HEADER}
    text = json.dumps([rows, fields, sorted(known.items())])
    return hashlib.sha256(text.encode()).hexdigest()


def _check_header(path: Path, table: pa.Table, schema: Mapping[str, str]) -> None:
    if _HEADER in schema:
        whole = schema[_HEADER] == _header_digest(table.schema, table.num_rows)
    else:
        # A damaged list of metadata is passed over by the library as if there were none.
        with path.open("rb") as stream:
            stream.seek(-8, os.SEEK_END)
            size = int.from_bytes(stream.read(4), "little")
            stream.seek(-8 - size, os.SEEK_END)
            whole = _HEADER.encode() not in stream.read(size)
    if not whole:
        raise DfsmError(f"{path} is damaged, its header is not as it was written: write it again")


# -- packing ------------------------------------------------------------------------------------


def _pack(values: Array, step: float) -> tuple[NDArray[np.int32], float, float] | None:
    """Codes, scale and offset with value = (code - offset) / scale, or None off the grid."""
    # A step beyond single precision is nobody's quantisation.
    if not np.isfinite(values).all() or not 1e-30 < step < 1e30:
        return None
    low = float(values.min())
    grid = np.rint((values - low) / step)
    span = int(grid.max())
    if span > CODE_MAX - CODE_MIN or np.abs(values - low - grid * step).max() > GRID_SLACK * step:
        return None
    # OpenFAST holds scale and offset in single precision and fills the range from its bottom.
    # Where that is how the values came about, they come back to the last bit.
    scale = float(np.float32(1 / step))
    for first in range(CODE_MIN, min(CODE_MIN + MAX_SHIFTS, CODE_MAX - span + 1)):
        codes = grid + first
        offset = float(np.float32(np.median(codes - values * scale)))
        if np.array_equal((codes - offset) / scale, values):
            return codes.astype(np.int32), scale, offset
    codes = grid + CODE_MIN
    return codes.astype(np.int32), 1 / step, CODE_MIN - low / step


def _equidistant(trajectory: Trajectory) -> tuple[float, float] | None:
    """Start and step that give the time mesh again to rounding, or None."""
    if trajectory.time_step is None:
        return None
    time, mean = trajectory.time, trajectory.time_step
    index = np.arange(len(time))
    slack = 4 * np.spacing(np.abs(time).max())
    for step in (mean, float(f"{mean:.9g}"), float(time[1] - time[0])):
        if np.array_equal(time[0] + step * index, time):
            return float(time[0]), step
    return (float(time[0]), mean) if np.abs(time[0] + mean * index - time).max() <= slack else None


# -- metadata -----------------------------------------------------------------------------------


def _channel(path: Path, field: pa.Field, units: Mapping[str, str]) -> Channel:
    known = _texts(field.metadata)
    if "unit" in known:
        name, unit = field.name, known["unit"]
    elif field.name in units:
        name, unit = field.name, units[field.name]
    else:
        name, unit = split_header(field.name)
    role: Role | None = None
    if "role" in known:
        roles = {r: r for r in get_args(Role)}
        if known["role"] not in roles:
            raise DfsmError(
                f"{path}: channel '{name}' has the role '{known['role']}', expected one of "
                f"{', '.join(roles)}: write the file again"
            )
        role = roles[known["role"]]
    step = _number(path, known, "step") if "step" in known else None
    return Channel(name, unit, step, role)


def _with_shared(path: Path, field: pa.Field, schema: Mapping[str, str]) -> pa.Field:
    """A column of integers with the unit and step that its file states once for all of them."""
    import pyarrow as pa

    known = _texts(field.metadata)
    if not (pa.types.is_integer(field.type) and {"unit", "scale"} <= schema.keys()) or known:
        return field
    step = _number(path, schema, "scale")
    if not step > 0:
        raise DfsmError(f"{path}: its metadata give a scale of {step:g}: write the file again")
    shared = {"unit": schema["unit"], "step": repr(step), "scale": repr(1 / step), "offset": "0"}
    return field.with_metadata(shared)


def _column(path: Path, table: pa.Table, index: int, field: pa.Field) -> Array:
    if is_stamped(field):
        return stamped_seconds(table, index)
    values = _floats(table.column(index))
    known = _texts(field.metadata)
    if "scale" not in known:
        return values
    scale = _number(path, known, "scale")
    if scale == 0:
        raise DfsmError(f"{path}: column '{field.name}' has a scale of 0: write the file again")
    return (values - _number(path, known, "offset")) / scale


def _check_dates(path: Path, schema: pa.Schema, at: int | None, dates: Sequence[str]) -> None:
    """Refuse times of day beside dates that change: days between samples would be lost."""
    import pyarrow as pa

    if at is not None and dates and pa.types.is_time(schema.field(at).type):
        raise DfsmError(
            f"{path}: '{schema.names[at]}' holds times of day and '{dates[0]}' the dates: join "
            "them to one column of time stamps"
        )


def _check_time_of_words(path: Path, words: Mapping[str, str]) -> None:
    """Refuse a time that is no numbers; `words` are columns that were left out."""
    for name, told in words.items():
        try:
            time_column(path, [Channel(split_header(name)[0])])
        except DfsmError:
            continue  # it is no time by its name
        raise DfsmError(
            f"{path}: its time '{name}' holds {told}, expected numbers in s or time stamps: "
            "convert it"
        )


def _pandas_units(metadata: Mapping[str, str]) -> dict[str, str]:
    """Units of a frame that came from `Trajectory.to_pandas`, which pandas keeps as JSON."""
    try:
        units = json.loads(metadata.get("PANDAS_ATTRS", "{}")).get("units", {})
        return {str(k): str(v) for k, v in units.items()}
    except (ValueError, AttributeError):
        return {}


def _texts(metadata: Mapping[bytes, bytes] | None) -> dict[str, str]:
    known = metadata or {}
    return {k.decode(errors="replace"): v.decode(errors="replace") for k, v in known.items()}


def _notes(path: Path, metadata: Mapping[str, str]) -> tuple[str, ...]:
    try:
        return tuple(str(n) for n in json.loads(metadata.get("dfsm.notes", "[]")))
    except (ValueError, TypeError):
        raise DfsmError(f"{path}: its notes are damaged; write it again") from None


def _number(path: Path, metadata: Mapping[str, str], key: str) -> float:
    try:
        number = float(metadata[key])
    except (KeyError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        raise DfsmError(
            f"{path}: its metadata give '{key}' as '{metadata.get(key)}', expected a number: "
            "write the file again"
        )
    return number

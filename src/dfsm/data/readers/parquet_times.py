"""Which column of a Parquet table is its time, and what stamps and durations there are in s."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array
from dfsm.data.readers.arrow import is_stamped
from dfsm.data.readers.columns import named_time, time_column
from dfsm.data.readers.stamps import Stamps, since_first
from dfsm.data.readers.times import (
    SECONDS,
    capital_note,
    counts_from_a_date,
    is_date_name,
    rises,
    seconds_of,
)
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError

if TYPE_CHECKING:
    import pyarrow as pa


def time_index(
    path: Path,
    schema: pa.Schema,
    channels: Sequence[Channel],
    pandas: str | None,
    columns: Sequence[Array],
    step: float | None,
) -> int | None:
    """Column that holds the time: by its name, the index of a pandas table, dates, or a T.

    Parameters
    ----------
    path
        The file, for messages.
    schema, channels, columns
        What it says of its columns, and their samples.
    pandas
        What pandas noted of the table. An index counts where its numbers are floats or stamps.
    step
        Interval between samples in s, if it is told.

    Returns
    -------
    int or None
        None where only `step` tells the time.

    Raises
    ------
    DfsmError
        There is no time, or it is not in s.
    """
    import pyarrow as pa

    wrong: DfsmError | None = None
    try:
        if (at := named_time(path, channels)) is not None:
            return at
    except DfsmError as error:
        wrong = error
    try:
        index = json.loads(pandas or "{}").get("index_columns", [])
    except (ValueError, AttributeError):
        raise DfsmError(f"{path}: its pandas metadata are damaged; write it again") from None
    if len(index) == 1 and isinstance(index[0], str) and index[0] in schema.names:
        at = schema.names.index(index[0])
        field = schema.field(at)
        counts = pa.types.is_floating(field.type) or is_stamped(field)
        if counts and channels[at].unit in SECONDS:
            return at
    if wrong is not None and step is None:
        raise wrong
    for i, channel in enumerate(channels):
        stamped = is_stamped(schema.field(i)) or counts_from_a_date(channel.name, columns[i])
        if stamped and is_date_name(channel.name) and not channel.unit:
            return i
    if step is None:
        return time_column(path, channels, lambda i: rises(columns[i]))
    return None if wrong else named_time(path, channels, lambda i: rises(columns[i], [step]))


def stamped_seconds(table: pa.Table, index: int) -> Array:
    """Seconds since the first stamp of a column; those of durations as they are."""
    import pyarrow as pa

    if pa.types.is_duration(table.column(index).type):
        return _nanoseconds(table, index) / 1e9
    return since_first(_nanoseconds(table, index))


def stamped_or_counted(
    table: pa.Table, index: int, channel: Channel, time: Array
) -> tuple[Array, list[str]]:
    """Times in s of the column of the time, and what there is to tell of them.

    Parameters
    ----------
    table, index, channel
        The column, and what is known of it.
    time
        Its samples, in s where it holds stamps.
    """
    if is_stamped(table.schema.field(index)):
        first = _first_stamp(table, index)
        return time, [Stamps(time, first).note(channel.name)] if first else []
    time, note = seconds_of(channel.name, channel.unit, time)
    return time, [told for told in (note, capital_note(channel.name, channel.unit)) if told]


def _nanoseconds(table: pa.Table, index: int) -> NDArray[np.int64]:
    """Stamps of a column in ns."""
    import pyarrow as pa

    column = table.column(index)
    unit = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}[column.type.unit]
    if pa.types.is_time32(column.type):
        column = column.cast(pa.int32())
    return column.cast(pa.int64()).to_numpy() * unit


def _first_stamp(table: pa.Table, index: int) -> str | None:
    """The first time stamp of a column as text; None where it holds numbers."""
    import pyarrow as pa

    kind = table.column(index).type
    if not (pa.types.is_timestamp(kind) or pa.types.is_time(kind)):
        return None
    return str(table.column(index)[0].as_py()) if table.num_rows else None

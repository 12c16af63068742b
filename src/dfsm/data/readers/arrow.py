"""Columns of Arrow's tables by what they hold: numbers, time stamps, or neither."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa

_SHOWN = 40


def is_stamped(field: pa.Field) -> bool:
    """Whether a column holds time stamps, times of day or durations."""
    import pyarrow as pa

    kind = field.type
    return pa.types.is_timestamp(kind) or pa.types.is_time(kind) or pa.types.is_duration(kind)


def without_words(table: pa.Table) -> tuple[pa.Table, dict[str, str]]:
    """Columns of numbers and time stamps; categories of numbers and decimal numbers are numbers.

    Returns
    -------
    tuple[pa.Table, dict[str, str]]
        The table with its metadata, and what the columns hold that it lacks, by their names.
    """
    import pyarrow as pa

    words: dict[str, str] = {}
    keep, columns, fields = [], [], []
    for place, field in enumerate(table.schema):
        column = table.column(place)
        if pa.types.is_dictionary(field.type):
            column = column.cast(field.type.value_type)
        if pa.types.is_decimal(column.type):
            column = column.cast(pa.float64())
        plain = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
        if is_stamped(field) or any(kind(column.type) for kind in plain):
            keep.append(place)
            columns.append(column)
            fields.append(field.with_type(column.type))
        else:
            words[field.name] = _told(column)
    if len(keep) == len(table.schema) and all(
        f.type == g.type for f, g in zip(fields, table.schema, strict=True)
    ):
        return table, {}
    schema = pa.schema(fields, metadata=table.schema.metadata)
    return pa.Table.from_arrays(columns, schema=schema), words


def changing_dates(table: pa.Table) -> list[str]:
    """Names of columns of dates in which more than one day stands."""
    import pyarrow as pa

    dates = [i for i, field in enumerate(table.schema) if pa.types.is_date(field.type)]
    return [table.schema.names[i] for i in dates if len(table.column(i).unique()) > 1]


def _told(column: pa.ChunkedArray) -> str:
    """What a column holds that are no numbers, with its first value."""
    import pyarrow as pa

    if column.null_count == len(column):
        return "no values"
    text = (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view)
    if not any(kind(column.type) for kind in text):
        return f"{column.type}, no numbers"
    first = str(column.drop_null()[0].as_py())
    return f"words ('{first[:_SHOWN]}')"

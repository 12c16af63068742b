"""MAT files of version 5 (up to v7, compressed or not): every tag checked before it is followed.

A file is a header of 128 bytes and data elements: a tag of 8 bytes (type, number of bytes) and the
data, padded to 8; up to 4 bytes of data may stand in the tag itself. An array is an element of
elements: flags with its class, dimensions, name, and what the class needs. Compressed elements hold
one array in a zlib stream.

Read here and not by a library, whose compiled reader can end the whole process at a damaged tag.
Source: MATLAB MAT-File Format, The MathWorks, chapter 1.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

_INT8, _UINT8, _INT16, _UINT16, _INT32, _UINT32, _SINGLE = range(1, 8)
_DOUBLE, _INT64, _UINT64, _MATRIX, _COMPRESSED, _UTF8, _UTF16, _UTF32 = (
    9,
    12,
    13,
    14,
    15,
    16,
    17,
    18,
)
_NUMBERS = {
    _INT8: "i1",
    _UINT8: "u1",
    _INT16: "i2",
    _UINT16: "u2",
    _INT32: "i4",
    _UINT32: "u4",
    _SINGLE: "f4",
    _DOUBLE: "f8",
    _INT64: "i8",
    _UINT64: "u8",
}
_TEXTS = {_UTF8: "utf-8", _UINT8: "latin-1", _INT8: "latin-1", _UTF32: "utf-32"}
# Classes of arrays.
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE = 1, 2, 3, 4, 5
_NUMERIC = range(6, 16)
_COMPLEX = 0x0800
_HEADER = 128
# Nothing that a simulation writes is nested so deeply or has so many dimensions.
_DEEPEST, _MOST_DIMENSIONS = 32, 32
# An array of classes that are not read: objects, functions, tables, sparse matrices.
OTHER = "an array of another class"


class DamagedError(ValueError):
    """What is wrong with a file, as the tail of a sentence."""


def read_mat5(path: Path) -> dict[str, Any]:
    """Variables of a file by name.

    Returns
    -------
    dict
        Numeric arrays as they are, ``(rows, columns)`` or more; texts as `str`, or a list of the
        rows of a character matrix; cell arrays as lists; structs as dicts, arrays of structs as
        lists of these; `OTHER` for classes that hold no signals.

    Raises
    ------
    DamagedError
        The bytes make no such file.
    """
    raw = path.read_bytes()
    mark = raw[126:128]
    if len(raw) < _HEADER or mark not in (b"IM", b"MI"):
        raise DamagedError("its header is not that of a MAT file")
    order = "<" if mark == b"IM" else ">"
    content = {}
    for kind, data in _elements(raw[_HEADER:], order):
        if kind == _COMPRESSED:
            kind, data = next(_elements(_inflated(data), order), (0, b""))
        if kind != _MATRIX:
            raise DamagedError(f"an element of type {kind} stands where an array is expected")
        name, value = _array(data, order, 0)
        if name:
            content[name] = value
    return content


def _inflated(data: bytes) -> bytes:
    try:
        return zlib.decompress(data)
    except (zlib.error, MemoryError) as error:
        raise DamagedError(f"a compressed element cannot be unpacked ({error})") from None


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and data of the elements that follow each other in some bytes."""
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise DamagedError("it ends inside a tag")
        (word,) = struct.unpack_from(f"{order}I", data, at)
        small = word >> 16
        if small:
            kind, size, start, following = word & 0xFFFF, small, at + 4, at + 8
            if size > 4:
                raise DamagedError(f"a short element announces {size} bytes")
        else:
            kind, (size,), start = word, struct.unpack_from(f"{order}I", data, at + 4), at + 8
            # Compressed elements alone are not padded.
            following = start + size + (0 if kind == _COMPRESSED else -size % 8)
        if start + size > len(data):
            raise DamagedError(f"an element announces {size} bytes, {len(data) - start} are there")
        yield kind, data[start : start + size]
        at = following


def _array(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of an array."""
    if depth > _DEEPEST:
        raise DamagedError(f"its arrays are nested more than {_DEEPEST} deep")
    if not data:  # an empty cell
        return "", np.empty((0, 0))
    parts = list(_elements(data, order))
    if len(parts) < 3 or len(parts[0][1]) < 8:
        raise DamagedError("an array has no flags, dimensions and name")
    flags = struct.unpack_from(f"{order}I", parts[0][1])[0]
    kind = flags & 0xFF
    if kind not in (_CELL, _STRUCT, _CHAR, *_NUMERIC):
        # An object's second element is no dimensions; its name stands there or behind them.
        names = (p for k, p in parts[1:3] if k == _INT8)
        return next((_text(_INT8, p, order) for p in names if p), ""), OTHER
    shape = _shape(parts[1], order)
    name, rest = _text(*parts[2], order), parts[3:]
    count = int(np.prod(shape, dtype=object))
    if kind == _CELL:
        return name, [_array(d, order, depth + 1)[1] for _, d in _so_many(rest, count)]
    if kind == _STRUCT:
        return name, _struct(rest, count, order, depth)
    if kind == _CHAR:
        return name, _characters(_so_many(rest, 1)[0], shape, order)
    if flags & _COMPLEX:
        return name, OTHER
    return name, _numbers(_so_many(rest, 1)[0], order, count).reshape(shape, order="F")


def _so_many(parts: list[tuple[int, bytes]], count: int) -> list[tuple[int, bytes]]:
    if len(parts) < count:
        raise DamagedError(f"an array has {len(parts)} parts, its dimensions ask for {count}")
    return parts[:count]


def _shape(part: tuple[int, bytes], order: str) -> tuple[int, ...]:
    kind, data = part
    if kind != _INT32 or len(data) % 4 or not 2 <= len(data) // 4 <= _MOST_DIMENSIONS:
        raise DamagedError("the dimensions of an array make no sense")
    shape = struct.unpack(f"{order}{len(data) // 4}i", data)
    if min(shape) < 0:
        raise DamagedError(f"an array has the dimensions {' x '.join(map(str, shape))}")
    return shape


def _numbers(part: tuple[int, bytes], order: str, count: int) -> np.ndarray:
    """As many numbers, stored in whatever type takes least room, in double precision."""
    kind, data = part
    if kind not in _NUMBERS:
        raise DamagedError(f"numbers of type {kind} are not known")
    values = np.frombuffer(data, f"{order}{_NUMBERS[kind]}", len(data) // int(_NUMBERS[kind][1]))
    if len(values) != count:
        raise DamagedError(f"an array holds {len(values)} numbers, its dimensions make {count}")
    return values.astype(np.float64)


def _characters(part: tuple[int, bytes], shape: tuple[int, ...], order: str) -> str | list[str]:
    text = _text(*part, order)
    rows, columns = shape[0], int(np.prod(shape[1:], dtype=object))
    if rows == 1 or len(text) != rows * columns:
        return text
    return [text[row::rows] for row in range(rows)]


def _text(kind: int, data: bytes, order: str) -> str:
    if kind in (_UINT16, _UTF16):
        encoding = "utf-16-le" if order == "<" else "utf-16-be"
    elif kind in _TEXTS:
        encoding = _TEXTS[kind]
    else:
        raise DamagedError(f"a text of type {kind} is not known")
    return data.decode(encoding, errors="replace")


def _struct(parts: list[tuple[int, bytes]], count: int, order: str, depth: int) -> Any:
    (_, width), (_, names) = _so_many(parts, 2)
    length = struct.unpack(f"{order}i", width)[0] if len(width) == 4 else 0
    if length <= 0 or len(names) % length:
        raise DamagedError("the field names of a struct make no sense")
    fields = [
        names[i : i + length].split(b"\0")[0].decode("latin-1")
        for i in range(0, len(names), length)
    ]
    values = [_array(d, order, depth + 1)[1] for _, d in _so_many(parts[2:], count * len(fields))]
    structs = [
        dict(zip(fields, values[i * len(fields) : (i + 1) * len(fields)], strict=True))
        for i in range(count)
    ]
    return structs[0] if count == 1 else structs

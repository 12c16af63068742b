"""MAT files of version 4: matrices one after the other, as old programs and Modelica tools write.

Each has a header of five integers: MOPT (thousands: byte order; tens: type of number; ones: kind,
numbers, text or sparse), rows, columns, whether there is an imaginary part, length of the name. The
name with a zero at its end follows, and the numbers column by column.

Source: MATLAB MAT-File Format, The MathWorks, chapter 2.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.data.readers.mat5 import OTHER, DamagedError

_TYPES = ("f8", "f4", "i4", "i2", "u2", "u1")
_NUMERIC, _TEXT = 0, 1
_LONGEST_NAME = 1024


def is_mat4(start: bytes) -> bool:
    """Whether a file begins with the header of such a matrix."""
    return len(start) >= 20 and _order(start) is not None


def _order(header: bytes) -> str | None:
    for order, thousands in (("<", 0), (">", 1)):
        mopt, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", header)
        kinds = (
            mopt // 1000 == thousands and mopt // 100 % 10 == 0 and mopt // 10 % 10 < len(_TYPES)
        )
        sizes = min(rows, columns) >= 0 and imaginary in (0, 1) and 0 < length <= _LONGEST_NAME
        if mopt >= 0 and kinds and mopt % 10 < 3 and sizes:
            return order
    return None


def read_mat4(path: Path) -> dict[str, Any]:
    """Matrices and texts of a file by name, as `read_mat5` returns them.

    Raises
    ------
    DamagedError
        The bytes make no such file.
    """
    raw, at = path.read_bytes(), 0
    content: dict[str, Any] = {}
    while at < len(raw):
        order = _order(raw[at : at + 20]) if len(raw) - at >= 20 else None
        if order is None:
            raise DamagedError(f"what stands at byte {at} is no header of a matrix")
        mopt, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", raw, at)
        kind = np.dtype(order + _TYPES[mopt // 10 % 10])
        size = rows * columns * kind.itemsize
        start = at + 20 + length
        at = start + size * (1 + imaginary)
        if at > len(raw):
            raise DamagedError(f"a matrix of {rows} x {columns} numbers is cut off")
        name = raw[start - length : start].split(b"\0")[0].decode("latin-1")
        values = np.frombuffer(raw, kind, rows * columns, start).reshape((rows, columns), order="F")
        content[name] = _value(values, mopt % 10 if not imaginary else -1)
    return content


def _value(values: np.ndarray, kind: int) -> Any:
    if kind == _NUMERIC:
        return values.astype(np.float64)
    if kind != _TEXT:
        return OTHER
    lines = ["".join(chr(int(c)) for c in row if 0 < c < 0x110000) for row in values]
    return lines[0] if len(lines) == 1 else lines

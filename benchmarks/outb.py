"""Binary OpenFAST files, written from the format's description with struct and NumPy alone.

Independent of both dfsm's reader and openfast-io, so that an error in one cannot hide in the other:
benchmarks and tests write their runs with it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.core.types import Array


def outb_header(
    names: Sequence[str],
    units: Sequence[str],
    samples: int,
    times: tuple[float, float],
    packing: tuple[Array, Array] | None,
    *,
    format_id: int = 2,
    width: int | None = None,
    description: str = "made by hand",
) -> bytes:
    """What stands before the samples.

    Parameters
    ----------
    names, units
        Of the channels without the time.
    samples
        How many follow.
    times
        Start and step in s; in format 1 scale and offset of the times, which follow the header.
    packing
        Scales and offsets of 16-bit codes, each ``(channel,)``; None in format 3.
    format_id, width
        Of the file, and the width of names in it, 20 in format 4 and 10 in others by default.
    description
        Any text.
    """
    width = width or (20 if format_id == 4 else 10)
    parts = [struct.pack("<h", format_id)]
    if format_id == 4:
        parts.append(struct.pack("<h", width))
    parts.append(struct.pack("<iidd", len(names), samples, *times))
    parts += [np.asarray(part, "<f4").tobytes() for part in packing or ()]
    text = description.encode("ascii")
    parts.append(struct.pack("<i", len(text)) + text)
    parts += [n.encode("latin-1").ljust(width)[:width] for n in ("Time", *names)]
    parts += [f"({u})".encode("latin-1").ljust(width)[:width] for u in ("s", *units)]
    return b"".join(parts)


def outb_bytes(
    time: Array, values: Array, names: Sequence[str], units: Sequence[str], **more: Any
) -> bytes:
    """Encode samples (time, channel); 16-bit in formats 1, 2 and 4, double precision in 3.

    Parameters
    ----------
    time, values
        Shapes ``(time,)`` and ``(time, channel)``.
    names, units
        Of the channels.
    more
        Format, width and description, see `outb_header`.
    """
    format_id = more.get("format_id", 2)
    times, stamps = (time[0], time[1] - time[0]), b""
    if format_id == 1:
        scale = (2**31 - 1) / (time[-1] - time[0])
        times = scale, -time[0] * scale
        stamps = np.rint(time * scale + times[1]).astype("<i4").tobytes()
    if format_id == 3:
        packing, stored = None, values.astype("<f8")
    else:
        scales, offsets, stored = encode(values)
        packing = scales, offsets
    header = outb_header(names, units, len(time), times, packing, **more)
    return header + stamps + stored.tobytes()


def encode(values: Array) -> tuple[Array, Array, Any]:
    """Return single-precision scales and offsets, and 16-bit codes that fill the range."""
    low = values.min(axis=0)
    span = np.ptp(values, axis=0)
    scales = np.where(span > 0, 65535 / np.where(span > 0, span, 1), 1).astype(np.float32)
    offsets = (-32768 - low * scales).astype(np.float32)
    codes = np.rint(values * scales.astype(float) + offsets.astype(float))
    return scales, offsets, np.clip(codes, -32768, 32767).astype("<i2")


def write_outb(path: Path, *args: Any, **kwargs: Any) -> Path:
    """Write `outb_bytes` to a file."""
    path.write_bytes(outb_bytes(*args, **kwargs))
    return path


def smooth_run(samples: int = 50, step: float = 0.05) -> tuple[Array, Array]:
    """Time and three unlike channels, deterministic."""
    time = 10 + step * np.arange(samples)
    values = np.stack([5e3 + 40 * np.sin(time), 1e-3 * np.cos(3 * time), time**2 - 200], axis=1)
    return time, values

"""A tiny writer of binary OpenFAST files, written from the format's description with struct alone.

Independent of both dfsm's reader and openfast-io, so that an error in one cannot hide in the other.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def outb_bytes(
    time: np.ndarray,
    values: np.ndarray,
    names: Sequence[str],
    units: Sequence[str],
    *,
    format_id: int = 2,
    width: int | None = None,
    description: str = "made in a test",
) -> bytes:
    """Encode samples (time, channel); 16-bit in formats 1, 2 and 4, double precision in 3."""
    width = width or (20 if format_id == 4 else 10)
    samples, count = values.shape
    parts = [struct.pack("<h", format_id)]
    if format_id == 4:
        parts.append(struct.pack("<h", width))
    parts.append(struct.pack("<ii", count, samples))
    if format_id == 1:
        span = time[-1] - time[0]
        time_scale = (2**31 - 1) / span
        time_offset = -time[0] * time_scale
        parts.append(struct.pack("<dd", time_scale, time_offset))
    else:
        parts.append(struct.pack("<dd", time[0], time[1] - time[0]))
    codes = None
    if format_id != 3:
        scales, offsets, codes = encode(values)
        parts.append(struct.pack(f"<{count}f", *scales))
        parts.append(struct.pack(f"<{count}f", *offsets))
    text = description.encode("ascii")
    parts.append(struct.pack("<i", len(text)) + text)
    parts += [n.encode("latin-1").ljust(width)[:width] for n in ("Time", *names)]
    parts += [f"({u})".encode("latin-1").ljust(width)[:width] for u in ("s", *units)]
    if format_id == 1:
        packed = np.rint(time * time_scale + time_offset).astype(int)
        parts.append(struct.pack(f"<{samples}i", *packed.tolist()))
    if codes is None:
        parts.append(struct.pack(f"<{samples * count}d", *values.ravel().tolist()))
    else:
        parts.append(struct.pack(f"<{samples * count}h", *codes.ravel().tolist()))
    return b"".join(parts)


def encode(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return single-precision scales and offsets, and 16-bit codes that fill the range."""
    low = values.min(axis=0)
    span = np.ptp(values, axis=0)
    scales = np.where(span > 0, 65535 / np.where(span > 0, span, 1), 1).astype(np.float32)
    offsets = (-32768 - low * scales).astype(np.float32)
    codes = np.rint(values * scales.astype(float) + offsets.astype(float))
    return scales, offsets, np.clip(codes, -32768, 32767).astype(np.int16)


def write_outb(path: Path, *args: object, **kwargs: object) -> Path:
    path.write_bytes(outb_bytes(*args, **kwargs))  # type: ignore[arg-type]
    return path


def smooth_run(samples: int = 50, step: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Time and three unlike channels, deterministic."""
    time = 10 + step * np.arange(samples)
    values = np.stack([5e3 + 40 * np.sin(time), 1e-3 * np.cos(3 * time), time**2 - 200], axis=1)
    return time, values

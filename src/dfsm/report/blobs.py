"""Arrays inside a page: base64 of what is needed to draw them, each distinct one once.

`blobs.js` reads them back. What is drawn along an axis takes two bytes a sample, of its own range:
a fiftieth of the height of a hair on any screen. All else is in single precision around its middle,
so that a large offset does not swallow what happens on top of it.
"""

from __future__ import annotations

import base64

import numpy as np

from dfsm.core.types import Array

# Steps of a range in 16 bits; the last value stands for "no number".
_STEPS, _NOTHING = 65534, 65535
# A range is worth its 16 bits while so much of the samples spreads over so many steps.
_CORE, _FINE = (5.0, 95.0), 2000

Blob = tuple[str, float, float, str]


class Blobs:
    """Arrays of one page, by index."""

    def __init__(self) -> None:
        self.encoded: list[Blob] = []
        self._known: dict[tuple[str, float, float, bytes], int] = {}

    def add(self, values: Array) -> int:
        """Store an array in single precision, and return its index."""
        limit = np.finfo(np.float32).max
        finite = values[np.isfinite(values)]
        offset = float(np.median(finite)) if len(finite) else 0.0
        # Numbers around zero stay as they are.
        if not len(finite) or abs(offset) < 10 * float(np.ptp(finite)):
            offset = 0.0
        data = np.clip(values - offset, -limit, limit).astype("<f4").tobytes()
        return self._store("f4", offset, 1.0, data)

    def add_drawn(self, values: Array) -> int:
        """Store what a linear axis shows, to 16 bits of its range, and return its index."""
        finite = values[np.isfinite(values)]
        if len(finite):
            low, high = float(finite.min()), float(finite.max())
            step = (high - low) / _STEPS
            # One sample that ran away must not flatten the others.
            if step * _FINE <= np.ptp(np.percentile(finite, _CORE)) or step == 0:
                return self._quantised("u2", values, low, step)
        return self.add(values)

    def add_logarithmic(self, values: Array) -> int:
        """Store what a logarithmic axis shows; what is not positive becomes "no number"."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithms = np.where(values > 0, np.log10(values), np.nan)
        finite = logarithms[np.isfinite(logarithms)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
        return self._quantised("log", logarithms, low, (high - low) / _STEPS)

    def _quantised(self, kind: str, values: Array, low: float, step: float) -> int:
        known = np.isfinite(values)
        steps = np.round((np.where(known, values, low) - low) / (step or 1.0))
        data = np.where(known, steps, _NOTHING).astype("<u2").tobytes()
        return self._store(kind, low, step, data)

    def _store(self, kind: str, offset: float, step: float, data: bytes) -> int:
        key = (kind, offset, step, data)
        if key not in self._known:
            self._known[key] = len(self.encoded)
            self.encoded.append((kind, offset, step, base64.b64encode(data).decode("ascii")))
        return self._known[key]

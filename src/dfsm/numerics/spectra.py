"""Power spectral densities, their peaks, and the power in frequency bands (Sec. 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dfsm.core.shapes import Bins, Series
from dfsm.errors import DfsmError
from dfsm.numerics.time_mesh import time_step


@dataclass(frozen=True)
class Band:
    """A frequency range in Hz with a name, e.g. the wave band."""

    name: str
    low: float
    high: float


@dataclass(frozen=True)
class Spectrum:
    """A one-sided power spectral density.

    Attributes
    ----------
    frequency
        In Hz, shape ``(bin,)``.
    density
        In the signal's unit squared per Hz, shape ``(bin,)``.
    """

    frequency: Bins
    density: Bins

    def peak(self, band: Band) -> float | None:
        """Frequency of the largest density in a band, in Hz; None if it holds no bin."""
        inside = self._inside(band)
        if not inside.any():
            return None
        return float(self.frequency[inside][np.argmax(self.density[inside])])

    def power(self, band: Band) -> float:
        """Variance in a band, in the signal's unit squared."""
        inside = self._inside(band)
        return float(np.trapezoid(self.density[inside], self.frequency[inside]))

    def _inside(self, band: Band) -> NDArray[np.bool_]:
        return (self.frequency >= band.low) & (self.frequency <= band.high)


def spectrum(time: Series, values: Series, segment: float = 200.0) -> Spectrum:
    """Welch's estimate (1967): Hann windows of `segment` s, half overlapping, mean removed.

    Parameters
    ----------
    time
        Equidistant mesh in s, shape ``(time,)``; resample an irregular one first.
    values
        Unfiltered samples, shape ``(time,)``.
    segment
        Segment length in s; a shorter record is one segment.

    Raises
    ------
    DfsmError
        The mesh is not equidistant.
    """
    step = time_step(time)
    if step is None:
        raise DfsmError("a spectrum needs an equidistant time mesh: resample the run first")
    size = min(len(values), round(segment / step))
    # Written out: SciPy's signal package takes a second of processor time to import.
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)
    parts = np.lib.stride_tricks.sliding_window_view(values, size)[:: max(1, size - size // 2)]
    amplitudes = np.fft.rfft(window * (parts - parts.mean(axis=1, keepdims=True)))
    density = (np.abs(amplitudes) ** 2).mean(axis=0) * (step / (window @ window))
    # Both halves of the spectrum, but what has no counterpart.
    density[1 : (size + 1) // 2] *= 2
    return Spectrum(np.fft.rfftfreq(size, step), density)

"""Zero-phase filters for states: what they remove is gone, what they keep stays where it was."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from dfsm.core.settings import settings_class
from dfsm.core.shapes import Series
from dfsm.core.types import Array
from dfsm.errors import DfsmError, near_matches
from dfsm.numerics.smoothing import checked
from dfsm.numerics.time_mesh import time_step


@settings_class
class Filter:
    """A zero-phase filter for one state, applied to the state and to what is derived from it.

    Attributes
    ----------
    kind
        ``moving_average`` over `window`, on any mesh, or ``low_pass``, a Butterworth filter of
        order 4 run forward and backward, on an equidistant mesh.
    window
        Full width of the average in s.
    cutoff
        Frequency in Hz at which `low_pass` halves the amplitude.

    Raises
    ------
    DfsmError
        A kind that does not exist, or not exactly the one positive number that the kind needs.
    """

    kind: Literal["moving_average", "low_pass"]
    window: float | None = None
    cutoff: float | None = None

    def __post_init__(self) -> None:
        needs = {"moving_average": "window", "low_pass": "cutoff"}
        if self.kind not in needs:
            raise DfsmError(
                f"there is no filter '{self.kind}'; {near_matches(str(self.kind), needs)}"
            )
        wanted = needs[self.kind]
        other = "cutoff" if wanted == "window" else "window"
        value = getattr(self, wanted)
        if value is None or getattr(self, other) is not None:
            raise DfsmError(
                f"a {self.kind} filter takes a {wanted} and no {other}, but came with "
                f"window={self.window}, cutoff={self.cutoff}: give the {wanted} alone"
            )
        if not (np.isfinite(value) and value > 0):
            raise DfsmError(f"a {self.kind} filter came with {wanted}={value}: give a positive one")


def moving_average(time: ArrayLike, values: ArrayLike, window: float) -> Series:
    """Average over a time window centred on each sample, on any mesh.

    The signal is taken as linear between samples. Near the ends the window shrinks on both
    sides alike, so nothing is shifted in time and the end samples are kept.

    Parameters
    ----------
    time, values
        Shape ``(time,)``; time in s.
    window
        Full width in s; a sine of frequency f is multiplied by ``sinc(f * window)``.

    Returns
    -------
    Array
        Shape ``(time,)``.

    Raises
    ------
    DfsmError
        A window longer than the record, or input that `smoothing_spline` would refuse.
    """
    t, y = checked(time, values)
    if not 0 < window <= t[-1] - t[0]:
        raise DfsmError(
            f"a moving average over {window:g} s does not fit a record of {t[-1] - t[0]:g} s: "
            "give a positive window that is shorter"
        )
    # An average over a shrinking window divides by its width: without the mean it keeps digits.
    centre = y.mean()
    y = y - centre
    half = np.minimum(window / 2, np.minimum(t - t[0], t[-1] - t))
    integral = np.concatenate([[0.0], np.cumsum(np.diff(t) * (y[1:] + y[:-1]) / 2)])

    def upto(at: Array) -> Array:
        cell = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        return integral[cell] + (at - t[cell]) * (y[cell] + np.interp(at, t, y)) / 2

    average = y.copy()
    inside = half > 0
    at, width = t[inside], half[inside]
    average[inside] = (upto(at + width) - upto(at - width)) / (2 * width)
    return average + centre


def low_pass(time: ArrayLike, values: ArrayLike, cutoff: float) -> Series:
    """Butterworth low-pass of order 4, run forward and backward, hence without phase.

    Parameters
    ----------
    time, values
        Shape ``(time,)``; time in s, equidistant.
    cutoff
        Frequency in Hz at which the amplitude is halved.

    Returns
    -------
    Array
        Shape ``(time,)``.

    Raises
    ------
    DfsmError
        A mesh that is not equidistant, a cutoff outside (0, Nyquist frequency), or input that
        `smoothing_spline` would refuse.
    """
    t, y = checked(time, values)
    step = time_step(t)
    if step is None:
        raise DfsmError(
            "a low_pass filter needs an equidistant mesh and this one is not: use a "
            "moving_average, or resample the run first"
        )
    nyquist = 0.5 / step
    if not 0 < cutoff < nyquist:
        raise DfsmError(
            f"a low_pass cutoff of {cutoff:g} Hz is not between 0 and the Nyquist frequency "
            f"{nyquist:g} Hz of samples {step:g} s apart: lower it"
        )
    sections = scipy.signal.butter(4, cutoff / nyquist, output="sos")
    # SciPy's own padding is a few samples; the filter's memory is about one period of the cutoff.
    padding = min(len(y) - 1, max(15, int(np.ceil(1 / (cutoff * step)))))
    return scipy.signal.sosfiltfilt(sections, y, padlen=padding)


def decimated(values: Array, factor: int) -> Array:
    """Every `factor`-th sample of what is left below their Nyquist frequency, without phase.

    A sinc in a Kaiser window (β = 5) of ten samples to either side, as SciPy's `resample_poly` has
    it; the record goes on beyond its ends by odd reflection, which keeps them where they are.

    Parameters
    ----------
    values
        Equidistant samples, shape ``(time, channel)``.
    factor
        At least 2.

    Returns
    -------
    Array
        Shape ``(ceil(time / factor), channel)``.
    """
    half = 10 * factor
    weights = np.kaiser(2 * half + 1, 5.0) * np.sinc(np.arange(-half, half + 1) / factor)
    wide = np.pad(values, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    parts = np.lib.stride_tricks.sliding_window_view(wide, 2 * half + 1, axis=0)[::factor]
    return parts @ (weights / weights.sum())


def filtered(time: Series, values: Series, chosen: Filter | None) -> Series:
    """Apply a filter, or none.

    Parameters
    ----------
    time, values
        Shape ``(time,)``; time in s.
    chosen
        The filter; None returns the values as they are.

    Returns
    -------
    Array
        Shape ``(time,)``.

    Raises
    ------
    DfsmError
        As `moving_average` and `low_pass`.
    """
    if chosen is None:
        return values
    if chosen.window is not None:
        return moving_average(time, values, chosen.window)
    return low_pass(time, values, chosen.cutoff or np.nan)

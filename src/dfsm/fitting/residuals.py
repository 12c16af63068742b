"""What a linear fit of derivatives leaves over, run by run on a mesh as coarse as it allows.

Diagnostics of a fit ask how its residual moves in time and with what. They need no sample that
says nothing new: each run is averaged over equal intervals, several of which make one correlation
time of the residual. An average of both sides of ``ξ̇ = L I + r`` is as true as the equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.numerics.least_squares import correlation_length
from dfsm.numerics.time_mesh import parts_of

# Intervals per correlation time of the residual, or per so many of the input that remembers least,
# and the most of them in all runs together.
_PER_CORRELATION, _OF_INPUTS = 10, 4
_MOST = 10_000


@dataclass(frozen=True)
class Residuals:
    """One row of a fit over the runs, averaged over equal intervals.

    Attributes
    ----------
    step
        Length of the intervals in s.
    inputs, targets, left
        What the fit takes, the derivative, and what the fit leaves of it: per run
        ``(interval, input)`` and ``(interval,)``.
    sample
        Usual distance of the samples in s; 0 where nobody says.
    """

    step: float
    inputs: tuple[Array, ...]
    targets: tuple[Array, ...]
    left: tuple[Array, ...]
    sample: float = 0.0

    @property
    def unexplained(self) -> float:
        """RMS of what is left over relative to the standard deviation of the derivative."""
        spread = float(np.concatenate(self.targets).std())
        rms = float(np.sqrt(np.mean(np.concatenate(self.left) ** 2)))
        return rms / max(spread, np.finfo(float).tiny)

    def centred(self) -> Residuals:
        """Every run about its own mean: what is constant in a run is none of what moves."""
        inputs, targets, left = (
            tuple(v - v.mean(axis=0) for v in part)
            for part in (self.inputs, self.targets, self.left)
        )
        return Residuals(self.step, inputs, targets, left, self.sample)


def residuals_of(
    times: Sequence[Array],
    inputs: Array,
    target: Array,
    left: Array,
    inputs_too: bool = False,
) -> Residuals | None:
    """Average one row over intervals.

    Parameters
    ----------
    times
        Of the samples of every run, one after the other, each ``(time,)``.
    inputs, target, left
        As in `Residuals`, ``(sample, input)`` and ``(sample,)``.
    inputs_too
        Whether intervals are short for the inputs as well. Over longer ones states have already
        answered what acts on them, so that the next value of a series is no news any more.

    Returns
    -------
    Residuals or None
        None where all runs are too short to tell anything: fewer than 4 intervals per input.
    """
    parts = list(zip(times, parts_of(times), strict=True))
    step = sample = min(float(np.median(np.diff(time))) for time in times)
    memory = float(np.mean([_memory(time, left[part]) for time, part in parts]))
    if inputs_too:
        moving = [column for column in inputs.T if np.ptp(column) > 0]
        own = [np.mean([_memory(time, column[part]) for time, part in parts]) for column in moving]
        memory = min(memory, _OF_INPUTS * float(min(own, default=memory)))
    together = sum(float(time[-1] - time[0]) for time in times)
    step = max(step, memory / _PER_CORRELATION, together / _MOST)

    def means_of(time: Array, part: slice) -> Array:
        return _means(time, np.column_stack([inputs[part], target[part], left[part]]), step)

    means = [m for time, part in parts if len(m := means_of(time, part))]
    if sum(len(m) for m in means) < 4 * (inputs.shape[1] + 1):
        return None
    return Residuals(
        step,
        tuple(m[:, :-2] for m in means),
        tuple(m[:, -2] for m in means),
        tuple(m[:, -1] for m in means),
        sample,
    )


def _memory(time: Array, left: Array) -> float:
    """Correlation time in s, on an equidistant mesh."""
    even = np.linspace(time[0], time[-1], len(time))
    return float(correlation_length(np.interp(even, time, left)[:, None])[0]) * (even[1] - even[0])


def _means(time: Array, table: Array, step: float) -> Array:
    """Averages over intervals of a run, ``(interval, column)``; empty ones are interpolated."""
    count = int((time[-1] - time[0]) / step + 0.5)
    if count < 2:
        return np.empty((0, table.shape[1]))
    place = np.clip(((time - time[0]) / step).astype(int), 0, count - 1)
    filled = np.bincount(place, minlength=count)
    sums = np.stack([np.bincount(place, column, count) for column in table.T], axis=1)
    some = np.flatnonzero(filled)
    means = sums[some] / filled[some, None]
    every = np.arange(count)
    return np.stack([np.interp(every, some, column) for column in means.T], axis=1)


def stacked(parts: Sequence[Array]) -> Array:
    """Runs below each other."""
    return np.concatenate(list(parts))

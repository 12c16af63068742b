"""Time meshes: equidistant or not, what time a sample stands for, samples at one instant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from dfsm.core.shapes import Series

# Share of a step by which times may miss a straight line: of no weight for filters and spectra.
_SHARE = 1e-3
# Rounding that is coarser than this share of a step hides whether a mesh is equidistant.
_COARSE = 0.1
_MOST_DECIMALS = 8
# Samples that make a rate; three at equal distances happen by chance.
_FEWEST = 4
# Share of the usual step below which two samples are one instant.
_INSTANT = 1e-6
# Share of the usual interval by which another may differ where samples are even.
_UNEVEN = 0.05
# Samples of a mesh that are looked at together, and those of many channels.
_BLOCK, _ROWS = 1_000_000, 2**16


def time_step(time: Series) -> float | None:
    """Sampling interval of an equidistant mesh; the one definition of equidistant.

    All times lie on the straight line from the first to the last, within a thousandth of a step or
    within the rounding of the times themselves: that of single precision, or of the last decimal
    that any of them has, as files write them. A missing sample or a drifting clock is neither.

    Parameters
    ----------
    time
        Strictly increasing times in s, shape ``(time,)``, at least two.

    Returns
    -------
    float or None
        Mean step in s; None where the mesh is not equidistant.
    """
    last = len(time) - 1
    step = float((time[-1] - time[0]) / last)

    def off(first: int, stop: int) -> Series:
        # Not as time[0] + step * index: the error of a step would grow with the index.
        line = time[0] + (time[-1] - time[0]) * (np.arange(first, stop) / last)
        return np.abs(time[first:stop] - line)

    error = _largest(off, len(time))
    slack = 4 * float(np.spacing(max(abs(time.min()), abs(time.max()))))
    if error <= max(_SHARE * step, slack):
        return step
    # Both ends and the time between may each be half a unit off.
    return step if error <= _rounding(time, step) + slack else None


def without_rounding(time: Series) -> Series:
    """Times of an equidistant mesh without the rounding of their file.

    At 0.00625 s, four decimals move times by up to 0.8 % of a step; a spline through the samples
    would take that for motion.

    Parameters
    ----------
    time
        Times in s, shape ``(time,)``, at least two.

    Returns
    -------
    ndarray
        Times at the shortest step that rounds to these, where they are equidistant and rounded to
        decimals or to single precision; otherwise the times as they are.
    """
    if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        return time
    step = time_step(time)
    unit = 0.0 if step is None else _rounding(time, step)
    if step is None or unit == 0.0:
        return time
    index, slack = np.arange(len(time)), 4 * np.spacing(np.abs(time).max())
    slope, start = np.polyfit(index.astype(np.float64), time, 1)
    # The shortest step that rounds to these times is the one that was meant.
    lines = [time[0] + float(f"{slope:.{digits}g}") * index for digits in range(1, 10)]
    near = (line for line in lines if np.abs(line - time).max() <= unit / 2 + slack)
    line = next(near, start + slope * index)
    return line if np.abs(line - time).max() > slack else time


def own_interval(time: Series, present: NDArray[np.bool_]) -> float | None:
    """Interval of a signal that has a sample at some times of a mesh only, at regular ones.

    Parameters
    ----------
    time
        Strictly increasing times in s, shape ``(time,)``.
    present
        Where the signal has a sample, shape ``(time,)``.

    Returns
    -------
    float or None
        In s; None where no sample is missing between the first and the last, where they are not
        equidistant, or fewer than four.
    """
    if present.all():
        return None
    rows = np.flatnonzero(present)
    if len(rows) < _FEWEST or len(rows) == rows[-1] - rows[0] + 1:
        return None
    return time_step(time[rows])


def _largest(parts: Callable[[int, int], Series], count: int) -> float:
    """Largest of `count` numbers that are computed block by block, as a long mesh needs it."""
    ends = [*range(0, count, _BLOCK), count]
    return float(np.max([parts(first, stop).max() for first, stop in pairwise(ends)]))


def _single_spacing(largest: float) -> float:
    """Distance of numbers of single precision there; infinite beyond their range."""
    if largest > np.finfo(np.float32).max:
        return np.inf
    return float(np.spacing(np.float32(largest)))


def _rounding(time: Series, step: float) -> float:
    """Unit in s to which the times of an equidistant mesh seem to be rounded; 0 for none."""
    largest, most = np.abs(time).max(), _COARSE * step
    single = _single_spacing(largest)
    if single <= most and np.array_equal(time.astype(np.float32), time):
        return single
    slack = 4 * np.spacing(largest)
    for decimals in range(_MOST_DECIMALS + 1):
        unit = 10.0**-decimals
        if unit > most:
            continue

        def off(first: int, stop: int, decimals: int = decimals) -> Series:
            return np.abs(np.round(time[first:stop], decimals) - time[first:stop])

        if _largest(off, len(time)) <= slack:
            # Whole multiples of the unit would not have been rounded.
            return 0.0 if round((time[-1] - time[0]) / unit) % (len(time) - 1) == 0 else unit
    return 0.0


def weights_over_time(times: Sequence[Series]) -> Series | None:
    """Weights that turn sums over the samples of some runs into integrals over time.

    On a mesh that is not equidistant a sample stands for half the time to each of its neighbours
    (the trapezoidal rule), on an equidistant one for a step.

    Parameters
    ----------
    times
        Strictly increasing times in s of every run, each of shape ``(time,)``, at least two.

    Returns
    -------
    ndarray or None
        One weight per sample of all runs, 1 on average, shape ``(sample,)``. None where all runs
        have one and the same step, so that every sample counts alike.
    """
    steps = [time_step(time) for time in times]
    known = [step for step in steps if step is not None]
    if len(known) == len(steps) and max(known) <= (1 + _SHARE) * min(known):
        return None
    parts = []
    for time, step in zip(times, steps, strict=True):
        between = np.diff(time) / 2
        by_rule = np.concatenate([between, [0.0]]) + np.concatenate([[0.0], between])
        parts.append(by_rule if step is None else np.full(len(time), step))
    weights = np.concatenate(parts)
    return weights / weights.mean()


def parts_of(times: Sequence[Series]) -> list[slice]:
    """The samples of every run ``(time,)`` among those of all, one run after the other."""
    ends = np.cumsum([0, *(len(time) for time in times)]).tolist()
    return [slice(start, stop) for start, stop in pairwise(ends)]


def mean_over(values: np.ndarray, weights: Series | None) -> np.ndarray:
    """Mean over samples ``(sample, ...)`` with weights ``(sample,)``; None takes all alike."""
    if weights is None:
        return values.mean(axis=0)
    if len(values) <= _ROWS:
        return np.average(values, axis=0, weights=weights)
    return _mean_of(values, weights, lambda part: part)


def std_over(values: np.ndarray, weights: Series | None) -> np.ndarray:
    """Standard deviation over samples, with weights as in `mean_over`."""
    if weights is None and len(values) <= _ROWS:
        return values.std(axis=0)
    mean = mean_over(values, weights)
    return np.sqrt(_mean_of(values, weights, lambda part: (part - mean) ** 2))


def rms_over(values: np.ndarray, weights: Series | None) -> np.ndarray:
    """Root of the mean square over samples, with weights as in `mean_over`."""
    return np.sqrt(_mean_of(values, weights, np.square))


def _mean_of(
    values: np.ndarray, weights: Series | None, change: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Mean of what becomes of samples, part by part: all at once would need as much memory."""
    if len(values) <= _ROWS:
        return mean_over(change(values), weights)
    total = np.zeros(values.shape[1:])
    for start in range(0, len(values), _ROWS):
        rows = slice(start, start + _ROWS)
        part = change(values[rows])
        total += part.sum(axis=0) if weights is None else np.tensordot(weights[rows], part, 1)
    return total / (len(values) if weights is None else weights.sum())


def quantiles_over(
    values: Series, at: float | Sequence[float] | np.ndarray, weights: Series | None
) -> np.ndarray:
    """Quantiles of samples ``(sample,)`` at shares of their number, or of their weight."""
    if weights is None:
        return np.quantile(values, np.asarray(at))
    order = np.argsort(values, kind="stable")
    weight = weights[order]
    share = (np.cumsum(weight) - weight / 2) / weight.sum()
    return np.interp(np.asarray(at), share, values[order])


def same_instant(time: Series) -> np.ndarray:
    """Tell which intervals are none: both samples stand for one instant, before and after a jump.

    An event-driven solver writes an event twice, at times that differ by less than a millionth of
    the usual step, or by no more than times are rounded.

    Parameters
    ----------
    time
        Strictly increasing times in s, shape ``(time,)``.

    Returns
    -------
    ndarray
        Booleans, one per interval, shape ``(time - 1,)``.
    """
    steps = np.diff(time)
    # The mean: where every sample is written twice, the median is of the wrong kind.
    usual, largest = (time[-1] - time[0]) / len(steps), np.abs(time).max()
    limit = max(_INSTANT * usual, 4 * float(np.spacing(largest)))
    single = 1.5 * _single_spacing(largest)
    if single < _SHARE * usual and np.array_equal(time.astype(np.float32), time):
        limit = max(limit, single)
    return steps <= limit


def instants_apart(time: Series, values: np.ndarray) -> Series:
    """Move the second of two samples at one time on by the smallest step there is.

    An event is written as two samples, before and after inputs jump; what does not jump is the same
    in both. Two samples that have nothing in common, three at one time, or copies of samples in a
    run without events are something else.
    """
    rows = np.flatnonzero(np.diff(time) == 0) + 1
    same = values[rows] == values[rows - 1]
    if same.all():
        return time
    pairs = rows[(np.diff(rows, prepend=-2) > 1) & same.any(axis=1)]
    time[pairs] = np.nextafter(time[pairs], np.inf)
    return time


def uneven(times: Sequence[Series]) -> tuple[float, int | None]:
    """Usual interval in s of some meshes, and the first of these that has others.

    Returns
    -------
    tuple of float and int
        None instead of an index where all samples are that interval apart.
    """
    every = np.concatenate([np.diff(time) for time in times])
    # One that there is, not the mean of two.
    step = float(np.quantile(every, 0.5, method="lower"))
    off = (np.abs(np.diff(time) - step).max() > _UNEVEN * step for time in times)
    return step, next((i for i, other in enumerate(off) if other), None)

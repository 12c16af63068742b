"""Equations over windows of time, on any mesh, for judging which channels follow from which.

A derivative at a sample is no good judge: where a held input jumps, the state has a kink, and noise
and rounding are all that a derivative of finely sampled records holds. Over a window of some
samples an equation y' = a y + b u + c holds without any derivative,

    (y(t₁) - y(t₀)) / (t₁ - t₀) = a mean(y) + b mean(u) + c ,

with the mean of a held input exact; the second difference of y is the mean of y'' under a hat over
two windows in the same way, with the means of y, y' and u under that hat (the weak form of the
equation). All of them are divided differences of y and of its first and second integral.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array
from dfsm.data.between import recognised
from dfsm.data.trajectory import Trajectory

# Samples of a run that are looked at, of its second half where it is longer, runs, and rows of all.
_MOST_SAMPLES, _MOST_RUNS, _MOST_ROWS = 20_000, 8, 6000
# Noise may be this share of the variance of what happens over a window, and the mean over a window
# must keep this share of the variance of the channel: windows grow until both hold, or one cannot.
_NOISE, _KEPT, _LONGEST = 0.003, 0.9, 1024
# Noise of a larger share covers what moves a channel.
_COVERED = 0.5
# Windows further from the median than so many usual distances, if few, are dropouts.
_OFF, _FEW = 30.0, 0.01
# Samples that tell whether noise moves a channel, and the share of the fitted effect below which it
# does not.
_TELLS, _NO_EFFECT = 100, 0.3
# Orders of the differences that tell noise.
_DIFFERENCES = (3, 5, 8)


@dataclass(frozen=True, eq=False)
class Rows:
    """Equations over windows.

    Attributes
    ----------
    change
        First or second divided differences, means of y' or y'', ``(row, channel)``.
    slope
        Means of y' under the same windows; the change itself for first differences.
    mean
        Means of the channels.
    """

    change: Array
    slope: Array
    mean: Array


class Windows:
    """The channels of some runs over windows of any length.

    Parameters
    ----------
    runs
        Runs that share the channels; the longest few are looked at.
    names
        Channels.

    Attributes
    ----------
    values, neighbours
        Samples of all runs, and samples of one that follow each other, ``(sample, channel)``.
    spread, noise
        Standard deviations of the channels and of what is white or rounded in them, ``(channel,)``.
    """

    def __init__(self, runs: Sequence[Trajectory], names: Sequence[str]) -> None:
        self.names = tuple(names)
        longest = sorted(runs, key=len, reverse=True)[:_MOST_RUNS]
        held = np.array([kind == "hold" for kind in recognised(runs, names)], dtype=bool)
        self._runs = [_Run(run, names, held) for run in longest]
        pooled = np.concatenate([run.values for run in self._runs])
        self.spread = np.maximum(pooled.std(axis=0), np.finfo(float).tiny)
        self.values = pooled[:: max(1, len(pooled) // _MOST_ROWS)]
        self.neighbours = self._runs[0].values[:_MOST_ROWS]
        self.noise = np.median([run.noise() for run in self._runs], axis=0)
        # What is held has the value that it shows.
        self._unsure = np.where(held, 0.0, self.noise)
        self._kept: dict[tuple[int, int], Rows] = {}

    def rows(self, order: int, span: int) -> Rows:
        """First or second differences over windows of so many samples, of all runs."""
        if (order, span) not in self._kept:
            every = max(1, sum(len(run.time) for run in self._runs) // _MOST_ROWS)
            parts = [run.rows(order, span, every) for run in self._runs]
            self._kept[order, span] = Rows(*map(np.concatenate, zip(*parts, strict=True)))
        return self._kept[order, span]

    @property
    def usual(self) -> float:
        """Usual time between samples in s."""
        return float(np.median(np.concatenate([np.diff(run.time) for run in self._runs])))

    def span(self, column: int, order: int) -> tuple[int, float]:
        """Samples of the windows for a channel, and the share of its change that is noise there.

        The shortest windows over which noise and rounding are next to nothing; longer ones than
        the channel's own motion would hide what it does.
        """
        span = 1
        while True:
            if len(self.rows(order, span).change) < 4:
                return max(1, span // 2), 1.0
            share = self._own_noise(column, order, span)
            if share <= _NOISE or not self._may_grow(column, order, span):
                return span, share
            span *= 2

    def swing(self, name: str) -> float:
        """Time in s that a channel takes for a swing, by its second derivative over its first.

        Over windows of the length at which noise is next to nothing; inf where it does not swing.
        """
        column = self.names.index(name)
        span, _ = self.span(column, 2)
        first, second = (np.var(self.rows(o, span).change[:, column]) for o in (1, 2))
        rate = float(np.sqrt(second / max(first, np.finfo(float).tiny)))
        return 2 * np.pi / rate if rate > 0 else np.inf

    def per_swing(self, name: str) -> float:
        """Windows of that length per swing."""
        span, _ = self.span(self.names.index(name), 2)
        return self.swing(name) / (span * self.usual)

    def _own_noise(self, column: int, order: int, span: int) -> float:
        """Share of the change of a channel that its noise is."""
        variance = np.var(self.rows(order, span).change[:, column])
        weight = 2.0 if order == 1 else 6.0
        own = weight * self.noise[column] ** 2 / (span * self.usual) ** (2 * order)
        return float(own / max(variance, own, np.finfo(float).tiny))

    def _may_grow(self, column: int, order: int, span: int) -> bool:
        """Whether windows twice as long hide next to nothing of a channel's own motion."""
        longer = self.rows(order, 2 * span).mean
        kept = np.var(longer[:, column]) if len(longer) >= 4 else 0.0
        motion = self.spread[column] ** 2 - self.noise[column] ** 2
        short = kept < _KEPT * max(motion, _KEPT * self.spread[column] ** 2 / 2)
        return not (short or 2 * span > _LONGEST)

    def left(self, name: str, order: int, among: Sequence[str]) -> tuple[float, float]:
        """Share of the variance of a channel's derivative that a linear fit leaves.

        Over the shortest windows over which noise is next to nothing, and without its share: of
        that in the channel itself, and of that in the others where it moves nothing.

        Parameters
        ----------
        name
            The channel.
        order
            Of the derivative.
        among
            What it may follow from beside itself and, of order 2, its rate.

        Returns
        -------
        tuple of float
            By all, and by the channel alone; one where noise covers most.
        """
        i = self.names.index(name)
        span, noise = self.span(i, order)
        if noise > _COVERED:
            return 1.0, 1.0
        columns = [self.names.index(n) for n in dict.fromkeys((name, *among))]
        shares, others = self._shares(i, order, span, columns)
        silent = others > _NOISE and self._silent(i, order, columns)
        while silent and others > _NOISE and self._may_grow(i, order, span):
            span *= 2
            noise = self._own_noise(i, order, span)
            shares, others = self._shares(i, order, span, columns)
        left = _without(shares[0], noise + (others if silent else 0.0))
        return left, _without(shares[1], noise)

    def _shares(
        self, column: int, order: int, span: int, columns: Sequence[int]
    ) -> tuple[tuple[float, float], float]:
        """What is left by some channels and by the first of them; what noise of the others makes.

        All relative to the variance of the change.
        """
        rows = self.rows(order, span)
        target = rows.change[:, column]
        good = without_dropouts(target)
        target, every, own = target[good], rows.mean[good][:, columns], rows.mean[good][:, [column]]
        if order == 2:
            # Of the rates, its own: that of an input is none that it acts by.
            slope = rows.slope[good, column]
            every, own = (np.column_stack([part, slope]) for part in (every, own))
        total = max(float(np.var(target)), np.finfo(float).tiny)
        # White noise in a mean between samples, under a box and under a hat.
        mean = (1 - 1 / (2 * span)) / span if order == 1 else 2 * (1 - 1 / (4 * span)) / (3 * span)
        acts = fitted(target, every)[1 : len(columns)]
        passed = float(np.sum((acts * self._unsure[list(columns[1:])]) ** 2)) * mean / total
        return (left_of(target, every), left_of(target, own)), passed

    def _silent(self, column: int, order: int, columns: Sequence[int]) -> bool:
        """Whether a derivative does not follow what changes from sample to sample in the others.

        Noise of a sensor moves nothing; a signal that is truly rough does.
        """
        change, _, mean = self._runs[0].rows(order, 1, 1)
        others = [c for c in columns[1:] if self._unsure[c] > 0]
        if not others:
            return False
        turns = np.diff(mean[:, others], 2, axis=0)
        # Of jumps the derivative follows with all the rest: the quieter half is between them.
        size = np.max(np.abs(turns) / np.maximum(turns.std(axis=0), np.finfo(float).tiny), axis=1)
        quiet = size <= np.median(size)
        if np.sum(quiet) < _TELLS:
            return False
        slow = fitted(change[:, column], mean[:, [column, *others]])[1:]
        fast = fitted(np.diff(change[:, column], 2)[quiet], turns[quiet])
        power = self._unsure[others] ** 2
        return bool(np.sum(power * fast**2) < _NO_EFFECT**2 * np.sum(power * slow**2))


class _Run:
    """One run: values, and their first and second integral over time."""

    def __init__(self, run: Trajectory, names: Sequence[str], held: Array) -> None:
        values = run.select(names).values
        begin = max(0, min(len(run) // 2, len(run) - _MOST_SAMPLES))
        part = slice(begin, begin + _MOST_SAMPLES)
        self.time = run.time[part] - run.time[part][0]
        self.values = _bridged(self.time, values[part])
        v, h = self.values, np.diff(self.time)[:, None]
        last = np.where(held, v[:-1], v[1:])
        first = np.cumsum(np.vstack([0 * v[:1], h * (v[:-1] + last) / 2]), axis=0)
        inner = h * first[:-1] + h**2 * (2 * v[:-1] + last) / 6
        second = np.cumsum(np.vstack([0 * v[:1], inner]), axis=0)
        self.integrals = v, first, second

    def noise(self) -> Array:
        """Standard deviation of what is white in each channel, or of its rounding.

        From differences of several orders: motion and kinks add to each, so that the least is
        nearest to the truth.
        """
        white = np.full(self.values.shape[1], np.inf)
        for order in _DIFFERENCES:
            if len(self.values) > 2 * order:
                size = np.abs(np.diff(self.values, order, axis=0))
                gain = comb(2 * order, order) ** 0.5
                white = np.minimum(white, 1.4826 * np.median(size, axis=0) / gain)
        moves = np.abs(np.diff(self.values, axis=0))
        least = np.where(moves > 0, moves, np.inf).min(axis=0, initial=np.inf)
        rounded = np.where(np.isfinite(least), least, 0.0) / 12**0.5
        return np.maximum(np.where(np.isfinite(white), white, 0.0), rounded)

    def rows(self, order: int, span: int, every: int) -> tuple[Array, Array, Array]:
        """Changes, slopes and means, see `Rows`, of every so many windows."""
        t, n = self.time, order * span
        begin = np.arange(0, max(0, len(t) - n), every)
        middle, last, end = begin + span, begin + n - span, begin + n
        a, b = t[middle] - t[begin], t[end] - t[last]
        good = (a > 0) & (b > 0)
        begin, middle, last, end = begin[good], middle[good], last[good], end[good]
        a, b = a[good, None], b[good, None]

        def differences(of: Array) -> Array:
            first = (of[middle] - of[begin]) / a
            return first if order == 1 else ((of[end] - of[last]) / b - first) / ((a + b) / 2)

        # Of y and its first integral, or of y and both.
        change, *means = (differences(v) for v in self.integrals[: order + 1])
        return change, means[0] if order == 2 else change, means[-1]


def _bridged(time: Array, values: Array) -> Array:
    """Values with straight lines over samples that are lost, or that a slower channel lacks."""
    if np.isfinite(values).all():
        return values
    bridged = np.zeros_like(values)
    for column, own in zip(bridged.T, values.T, strict=True):
        known = np.isfinite(own)
        if known.any():
            column[:] = np.interp(time, time[known], own[known])
    return bridged


def without_dropouts(target: Array) -> NDArray[np.bool_]:
    """Rows that are not as far off as a few dropouts are."""
    off = np.abs(target - np.median(target))
    usual = 1.4826 * float(np.median(off))
    good = off <= _OFF * usual
    if not usual > 0 or np.mean(~good) > _FEW:
        return np.ones(len(target), dtype=bool)
    return good


def fitted(target: Array, inputs: Array) -> Array:
    """Coefficients of a linear fit, ``(input,)``."""
    X, y = inputs - inputs.mean(axis=0), target - target.mean()
    size = np.maximum(X.std(axis=0), np.finfo(float).tiny)
    X = X / size
    return np.linalg.lstsq(X.T @ X, X.T @ y, rcond=1e-12)[0] / size


def rest_of(target: Array, inputs: Array) -> Array:
    """What a linear fit leaves of a target."""
    X, y = inputs - inputs.mean(axis=0), target - target.mean()
    return y - X @ fitted(target, inputs)


def left_of(target: Array, inputs: Array) -> float:
    """Share of a variance that a linear fit leaves; all of what does not vary."""
    total = float(np.var(target))
    return float(np.mean(rest_of(target, inputs) ** 2)) / total if total > 0 else 1.0


def _without(share: float, noise: float) -> float:
    """What is left of a share of a variance, of which noise is another."""
    return max(0.0, share - noise) / (1 - noise) if noise < 1 else 0.0

"""How prediction intervals grow along a rollout, and with the distance from the training data.

A rollout begins at the record and is off by more and more until errors are forgotten as fast as
they are made; and it is off by more where no training run was. With τ the time since the start and
D̄ the distance from the training data over the recent past (1 is as far as is usual), a half-width
is

    h(schedule) · a(τ) · ((k² + D̄²) / (k² + 1))^(p / 2) ,

per channel, with h, a, p and k from rollouts over runs that were left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import scipy

from dfsm.core.types import Array
from dfsm.numerics.hats import hat_weights

# Lags at which the growth is known: this many, each half of the next, up to the longest rollout.
_LAGS = 9
# Powers of the distance that are tried.
_POWERS = np.linspace(0.0, 3.0, 16)
# Distances k below which nothing depends on it.
_KNEES = (0.25, 1.0)
# How far back the distance counts, as shares of the longest rollout.
_MEMORIES = (0.0, 0.02, 0.1)
# Rounds in which the parts of the law are fitted one after the other.
_ROUNDS = 4
# Samples that enter, of all rollouts together.
_SAMPLES = 10_000
# What all errors say weighs as much at every schedule value as this share of a rollout, lest one
# run decides there.
_LEANING = 0.25
# Of the mean squared error: the least that is expected anywhere.
_LEAST = 1e-12


@dataclass(frozen=True)
class RolloutErrors:
    """What a rollout over a run that was left out is off by.

    Attributes
    ----------
    group
        Rollouts of one group are left out together when others judge them.
    lag
        Time since the start in s, shape ``(time,)``.
    schedule
        Value of the schedule, ``(time,)``; zeros without one.
    distance
        From the training data of the model that was simulated, ``(time,)``.
    errors
        Simulated minus recorded, ``(time, channel)``.
    """

    group: str
    lag: Array
    schedule: Array
    distance: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class Growth:
    """Law of the growth of half-widths.

    Attributes
    ----------
    lag
        Times since the start in s, shape ``(lag,)``.
    along
        a(τ) there, shape ``(lag, channel)``: 1 at the last one, and never falling.
    power
        p, shape ``(channel,)``.
    knee
        k, the distance from which on it counts.
    memory
        Time constant in s over which the distance is averaged; 0 takes it as it is.
    farthest
        Largest averaged distance of the runs left out: beyond, the law is extrapolated.
    """

    lag: Array
    along: Array
    power: Array
    knee: float
    memory: float
    farthest: float

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Growth) and all(
            np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)
        )

    def factor(self, lag: Array, distance: Array) -> Array:
        """What half-widths are multiplied by, shape ``(time, channel)``.

        Beyond the longest rollout that was left out, errors that still grew go on growing as they
        did over its second half.

        Parameters
        ----------
        lag
            Times since the start in s, ``(time,)``.
        distance
            From the training data, ``(time,)``.
        """
        return self._along(lag) * np.exp(
            _far(recent(lag, distance, self.memory), self.knee)[:, None] * self.power
        )

    def _along(self, lag: Array) -> Array:
        inside = hat_weights(_octaves(self.lag), _octaves(lag)) @ self.along
        last = self.lag[-1]
        if lag[-1] <= last * (1 + 1e-6):
            return inside
        rate = np.clip(-np.log2(self.along[-2]), 0.0, 1.0)
        return inside * (np.maximum(lag / last, 1.0)[:, None] ** rate)


def recent(time: Array, distance: Array, memory: float) -> Array:
    """Root mean square of a distance over the recent past, weighted by exp(-age / memory)."""
    if memory == 0 or len(time) < 2:
        return distance
    mesh = np.linspace(time[0], time[-1], len(time))
    stay = np.exp(-(mesh[1] - mesh[0]) / memory)
    squares = np.interp(mesh, time, distance**2)
    averaged, _ = scipy.signal.lfilter([1 - stay], [1, -stay], squares, zi=stay * squares[:1])
    return np.sqrt(np.interp(time, mesh, averaged))


def _far(distance: Array, knee: float) -> Array:
    """Log of what a power of one multiplies half-widths by, ``(time,)``."""
    return 0.5 * np.log((knee**2 + distance**2) / (knee**2 + 1))


@dataclass(frozen=True)
class Law:
    """Root mean square errors: along the schedule, and how they grow from there.

    Attributes
    ----------
    grid
        Schedule values, shape ``(point,)``.
    scale
        At the usual distance after the longest rollout, shape ``(point, channel)``.
    growth
        See `Growth`.
    """

    grid: Array
    scale: Array
    growth: Growth

    def at(self, part: RolloutErrors) -> Array:
        """Root mean square error that is expected along a rollout, ``(time, channel)``."""
        return (hat_weights(self.grid, part.schedule) @ self.scale) * self.growth.factor(
            part.lag, part.distance
        )


def law_of(parts: Sequence[RolloutErrors], grid: Array) -> Law:
    """The law under which the errors are most likely, taken for normal.

    Parameters
    ----------
    parts
        Rollouts over runs left out.
    grid
        Schedule values at which the size of errors is told.
    """
    longest = max(float(p.lag[-1]) for p in parts)
    tried = []
    for share in _MEMORIES:
        memory = longest * share
        thinned = [_thinned(p, memory, len(parts)) for p in parts]
        for knee in _KNEES:
            law = _Likeliest(thinned, grid, longest, knee)
            tried.append((law.cost, law.law(memory)))
    return min(tried, key=lambda found: found[0])[1]


def _thinned(part: RolloutErrors, memory: float, count: int) -> RolloutErrors:
    """Some samples, more of them early, with the distance averaged over the past of each."""
    last, some = len(part.lag) - 1, int(np.clip(_SAMPLES // count, 40, 400))
    even = np.linspace(0, last, min(last + 1, some))
    early = np.geomspace(1, max(last, 1), some // 4)
    rows = np.unique(np.r_[even, early].astype(int).clip(0, last))
    past = recent(part.lag, part.distance, memory)
    along = (part.lag, part.schedule, past, part.errors)
    return RolloutErrors(part.group, *(values[rows] for values in along))


class _Likeliest:
    """The parts of a law, fitted in turn to squared errors until they fit together."""

    def __init__(
        self, parts: Sequence[RolloutErrors], grid: Array, longest: float, knee: float
    ) -> None:
        lag, schedule, distance = (
            np.concatenate([getattr(p, name) for p in parts])
            for name in ("lag", "schedule", "distance")
        )
        squares = np.concatenate([p.errors for p in parts]) ** 2
        self.knee = knee
        self.grid, self.lag = grid, longest / 2.0 ** np.arange(_LAGS)[::-1]
        # Relative, so that a channel that is always zero has no error to be divided by.
        self.size = np.sqrt(np.maximum(squares.mean(axis=0), np.finfo(float).tiny))
        self.squares = squares / self.size**2
        self.farthest = float(distance.max())
        self.points = hat_weights(grid, schedule)
        self.lags = hat_weights(_octaves(self.lag), _octaves(lag))
        # Log of what the distance multiplies squared errors by, for every power.
        self.far = 2 * _far(distance, knee)[:, None] * _POWERS
        self.near = np.exp(-self.far)
        channels, leaning = squares.shape[1], _LEANING * len(lag) / len(parts)
        self.scale = np.ones((len(grid), channels))
        self.along = np.ones((_LAGS, channels))
        self.power = np.zeros(channels, dtype=int)
        for _ in range(_ROUNDS):
            left = self.squares / (self._grown() * self._apart())
            summed = self.points.T @ left + leaning * left.mean(axis=0)
            scale = summed / (self.points.sum(axis=0)[:, None] + leaning)
            self.scale = np.maximum(scale, _LEAST)
            left = self.squares / (self._sized() * self._apart())
            weights = self.lags.sum(axis=0)
            along = (self.lags.T @ left) / np.maximum(weights, 1e-9)[:, None]
            along = np.stack([_rising(a, weights) for a in along.T], axis=1)
            self.along = np.maximum(along / np.maximum(along[-1], _LEAST), _LEAST)
            left = self.squares / (self._sized() * self._grown())
            # Mean squares relative to what every power expects, of which the size is free.
            means = np.maximum(left.T @ self.near / len(left), _LEAST)
            costs = self.far.mean(axis=0) + np.log(means)
            self.power = np.argmin(costs, axis=1)
        expected = self._sized() * self._grown() * self._apart()
        self.cost = float(np.sum(np.mean(np.log(expected) + self.squares / expected, axis=0)))

    def _sized(self) -> Array:
        return self.points @ self.scale

    def _grown(self) -> Array:
        return self.lags @ self.along

    def _apart(self) -> Array:
        return 1 / self.near[:, self.power]

    def law(self, memory: float) -> Law:
        """As root mean squares, in the units of the errors."""
        growth = Growth(
            self.lag, np.sqrt(self.along), _POWERS[self.power], self.knee, memory, self.farthest
        )
        return Law(self.grid, np.sqrt(self.scale) * self.size, growth)


def _octaves(lag: Array) -> Array:
    return np.log2(np.maximum(lag, np.finfo(float).tiny))


def _rising(values: Array, weights: Array) -> Array:
    """The nearest sequence that never falls."""
    return scipy.optimize.isotonic_regression(values, weights=np.maximum(weights, 1e-9)).x

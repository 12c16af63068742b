"""Design-level figures of load cases: energy, loads over a life, overshoot, travel, extremes."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dfsm.core.settings import require, require_kind, require_list, require_number, shown
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.numerics.fatigue import WOHLER_EXPONENTS, damage_by_exponent
from dfsm.numerics.time_mesh import mean_over, std_over, weights_over_time

HOURS_PER_YEAR = 8766.0


@dataclass(frozen=True)
class Figures:
    """One channel of a load case, or of all with their weights.

    Attributes
    ----------
    mean, std
        Over time, in the channel's unit; of all: over their common life.
    minimum, maximum
        Extremes.
    travel
        Mean of the absolute rate, in the channel's unit per s.
    damage
        1 Hz damage-equivalent load per Wöhler exponent; of all: what does the damage of all cases,
        each for its share of the time (Palmgren-Miner).
    """

    mean: float
    std: float
    minimum: float
    maximum: float
    travel: float
    damage: Mapping[str, float]

    @classmethod
    def of(cls, time: Array, values: Array, weights: Array | None = None) -> Figures:
        """Figures of one signal, ``(time,)``; `weights` as of `weights_over_time`."""
        duration = float(time[-1] - time[0])
        return cls(
            mean=float(mean_over(values, weights)),
            std=float(std_over(values, weights)),
            minimum=float(values.min()),
            maximum=float(values.max()),
            travel=float(np.abs(np.diff(values)).sum() / duration),
            damage=damage_by_exponent(values, duration),
        )

    @classmethod
    def over(cls, cases: Sequence[Figures], weights: Sequence[float]) -> Figures:
        """Figures of several cases, of which each stands for a share of the time."""
        w = np.asarray(weights) / np.sum(weights)
        means, stds = np.array([c.mean for c in cases]), np.array([c.std for c in cases])
        mean = float(w @ means)
        damage = {}
        for m in cases[0].damage:
            loads, power = np.array([c.damage[m] for c in cases]), float(m)
            largest = float(loads.max()) or 1.0
            damage[m] = largest * float(w @ (loads / largest) ** power) ** (1 / power)
        return cls(
            mean=mean,
            std=math.sqrt(float(w @ (stds**2 + (means - mean) ** 2))),
            minimum=min(c.minimum for c in cases),
            maximum=max(c.maximum for c in cases),
            travel=float(w @ [c.travel for c in cases]),
            damage=damage,
        )


def case_figures(run: Trajectory) -> dict[str, Figures]:
    """Figures of every channel of a run."""
    weights = weights_over_time([run.time])
    return {name: Figures.of(run.time, run[name], weights) for name in run.names}


def require_counted(exponent: float) -> None:
    """Refuse a Wöhler exponent for which no loads are counted.

    Raises
    ------
    DfsmError
        Names those for which some are.
    """
    counted = ", ".join(f"{m:g}" for m in WOHLER_EXPONENTS)
    require(exponent in WOHLER_EXPONENTS, "exponent", shown(exponent), f"one of {counted}")


def require_weights(weights: Any, runs: int | None = None) -> None:
    """Refuse shares of the time that are not numbers above 0, one per run.

    Parameters
    ----------
    weights
        What was given: anything.
    runs
        Number of the runs, where it is known.

    Raises
    ------
    DfsmError
        They are not.
    """
    expected = "one per run" if runs is None else f"one per run, {runs}"
    require_list("weights", weights, expected)
    many = len(weights) > 0 if runs is None else len(weights) == runs
    require(many, "weights", shown(list(weights)), expected)
    for weight in weights:
        require_number("one of the weights", weight, "a number above 0", above=0)


def require_shares(weights: Sequence[float]) -> None:
    """Refuse weights, numbers above 0, that are in no proportion to the year.

    Raises
    ------
    DfsmError
        They add up to more than all of the time.
    """
    total = sum(weights)
    # Tables are rounded.
    if total > 1.01:
        raise DfsmError(
            f"weights add up to {total:g}, expected shares of the time, at most 1 in all, where "
            "energy or extremes are asked for: divide them by 100 if they are percent, by 8766 if "
            "they are hours of a year"
        )


@dataclass(frozen=True)
class LoadCases:
    """Shares of the time that runs stand for, and which of them are seeds of one condition.

    Attributes
    ----------
    weights
        Of the runs.
    groups
        Which runs make up each condition.
    """

    weights: tuple[float, ...]
    groups: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, weights: Sequence[float], conditions: Sequence[Hashable] | None) -> LoadCases:
        """Group runs by the condition that each is a case of; None for one each.

        Raises
        ------
        DfsmError
            Conditions are not one per run.
        """
        runs = len(weights)
        if conditions is None:
            return cls(tuple(weights), tuple((i,) for i in range(runs)))
        expected = f"one per run, {runs}, as [6, 6, 12] for two seeds at 6 m/s and one at 12"
        require_list("conditions", conditions, expected)
        require(len(conditions) == runs, "conditions", shown(list(conditions)), expected)
        for condition in conditions:
            require_kind("one of the conditions", condition, Hashable, "a number or a text")
        alike: dict[Hashable, list[int]] = {}
        for i, condition in enumerate(conditions):
            alike.setdefault(condition, []).append(i)
        return cls(tuple(weights), tuple(map(tuple, alike.values())))

    @property
    def shares(self) -> list[float]:
        """Share of the time of every condition."""
        return [sum(self.weights[i] for i in group) for group in self.groups]

    def pooled(self, values: Sequence[Array]) -> list[Array]:
        """Values of all runs, each ``(n,)``, by condition."""
        return [np.concatenate([values[i] for i in group]) for group in self.groups]


def weibull_weights(winds: Sequence[float], mean: float, shape: float = 2.0) -> list[float]:
    """Share of the time that each of several runs stands for, by its mean wind.

    Bins reach half-way to the neighbouring winds, the first and the last as far out as in; runs of
    one wind share its bin. What lies beyond counts for none, so that the sum is below 1.

    Parameters
    ----------
    winds
        Nominal mean wind of every run in m/s; at least two different ones.
    mean
        Mean of the Weibull distribution in m/s.
    shape
        Its shape k; 2 is Rayleigh's distribution, the customary one.

    Returns
    -------
    list of float
        In the order of `winds`.

    Raises
    ------
    DfsmError
        A wind that is no number or negative, fewer than two different ones, or a mean or shape that
        is not positive.
    """
    require_number("mean", mean, "m/s, more than 0", above=0)
    require_number("shape", shape, "more than 0", above=0)
    require_list("winds", winds, "one for every run")
    for wind in winds:
        require_number("one of the winds", wind, "a number in m/s, at least 0", least=0)
    different = sorted({float(w) for w in winds})
    if len(different) < 2:
        raise DfsmError(
            f"winds are {', '.join(f'{w:g}' for w in different) or 'none'}, expected at least two "
            "different ones: the bins of a distribution reach half-way to their neighbours"
        )
    middles = (np.array(different[1:]) + np.array(different[:-1])) / 2
    first, last = 2 * different[0] - middles[0], 2 * different[-1] - middles[-1]
    edges = np.maximum(np.concatenate([[first], middles, [last]]), 0.0)
    scale = mean / math.gamma(1 + 1 / shape)
    shares = np.diff(1 - np.exp(-((edges / scale) ** shape)))
    counts = {w: sum(float(v) == w for v in winds) for w in different}
    return [float(shares[different.index(float(w))]) / counts[float(w)] for w in winds]

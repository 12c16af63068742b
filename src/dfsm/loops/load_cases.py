"""Design-level figures of load cases: energy, loads over a life, overshoot, travel, extremes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dfsm.core.settings import require, require_list, require_number, shown
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.numerics.fatigue import WOHLER_EXPONENTS, damage_by_exponent

HOURS_PER_YEAR = 8766.0


@dataclass(frozen=True)
class Figures:
    """One channel of a load case, or of all with their weights.

    Attributes
    ----------
    mean, std
        In the channel's unit; of all: over their common life.
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
    def of(cls, time: Array, values: Array) -> Figures:
        """Figures of one signal, ``(time,)``."""
        duration = float(time[-1] - time[0])
        return cls(
            mean=float(values.mean()),
            std=float(values.std()),
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
    return {name: Figures.of(run.time, run[name]) for name in run.names}


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

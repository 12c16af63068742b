"""Records of systems of one measured state under inputs that are swept or jump."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from dfsm.data.trajectory import Channel, Trajectory

Array = NDArray[np.floating[Any]]
Rate = Callable[[float, Array, float], Sequence[float]]


def swept(seed: int, size: float, band: float) -> Callable[[float], float]:
    rng = np.random.default_rng(seed)
    rates = 2 * np.pi * np.linspace(band / 30, band, 25)
    phases = rng.uniform(0, 2 * np.pi, 25)
    return lambda t: float(size * np.cos(rates * t + phases).sum() / np.sqrt(12.5))


def jumping(seed: int, hold: float) -> Callable[[float], float]:
    values = np.random.default_rng(seed).uniform(-1.7, 1.7, 4000)
    return lambda t: float(values[int(t / hold + 1e-9)])


def record(
    rate: Rate,
    start: Sequence[float],
    drive: tuple[Callable[[float], float], bool],
    time: Array,
    noise: tuple[float, float],
) -> Trajectory:
    """Input and first state, with white noise of so much of their spread, by a tight tolerance."""
    u, held = drive
    tight: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-10}
    if held:
        x = [np.array(start)]
        for a, b in pairwise(time):
            x.append(solve_ivp(rate, (a, b), x[-1], args=(u(a),), **tight).y[:, -1])
        y = np.array(x)[:, 0]
    else:
        span = (time[0], time[-1])
        y = solve_ivp(lambda t, x: rate(t, x, u(t)), span, start, t_eval=time, **tight).y[0]
    table = np.stack([[u(t) for t in time], y], axis=1)
    table += table.std(axis=0) * noise * np.random.default_rng(9).standard_normal(table.shape)
    return Trajectory(time, table, (Channel("u", "V"), Channel("y", "m")), name="run")


def duffing(t: float, x: Array, u: float) -> list[float]:
    return [x[1], 40 * (u - x[0] - 0.5 * x[0] ** 3) - x[1]]

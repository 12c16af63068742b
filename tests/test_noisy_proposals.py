"""What `init` makes of noise on inputs, of strong nonlinearity and of inputs that are rough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from dfsm.config.proposal import propose
from dfsm.config.template import fill
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


def lag(t: float, x: Array, u: float) -> list[float]:
    return [u - 0.7 * x[0] - 0.3 * x[0] ** 3]


def tanks(t: float, x: Array, u: float) -> list[float]:
    low, high = np.maximum(x, 0)
    out = 0.06 * np.sqrt(high)
    return [out - 0.05 * np.sqrt(low), 0.05 * (2.6 + 0.9 * u) - out]


def duffing(t: float, x: Array, u: float) -> list[float]:
    return [x[1], 40 * (u - x[0] - 0.5 * x[0] ** 3) - x[1]]


@pytest.mark.parametrize("noise", [0.05, 0.25])
def test_noise_on_an_input_that_jumps_hides_no_state(noise: float) -> None:
    """All of the state is recorded: its rate follows over windows that average the noise."""
    time = 0.1 * np.arange(1000)
    run = record(lag, [0.0], (jumping(1, 1.0), True), time, (noise, 0.0))
    proposed = propose([run], run.names, [])
    assert not proposed.hidden
    assert proposed.states == [{"name": "y", "order": 1}]


def test_an_input_that_is_truly_rough_does_not_pass_for_noise() -> None:
    """What changes from sample to sample acts here, and the upper tank is in between."""
    time = 4.0 * np.arange(1000)
    run = record(tanks, [4.0, 5.0], (jumping(1, 4.0), True), time, (0.0, 0.01))
    assert propose([run], run.names, []).hidden


def test_a_spring_that_hardens_is_driven_by_a_smooth_input() -> None:
    """The response tells of a smooth input what more of the input's own past tells, too."""
    time = 0.05 * np.arange(1000)
    run = record(duffing, [0.0, 0.0], (swept(1, 1.2, 2.0), False), time, (0.0, 0.01))
    proposed = propose([run], run.names, [])
    assert proposed.hidden
    assert proposed.states == [{"name": "y", "order": 1}]
    assert proposed.disturbances == ["u"]


def test_where_nothing_is_a_state_the_next_step_is_told() -> None:
    """The configuration cannot be fitted as it stands."""
    table = np.random.default_rng(0).standard_normal((500, 2))
    channels = (Channel("a", "V"), Channel("b", "m"))
    run = Trajectory(0.1 * np.arange(500), table, channels, name="noise")
    text, told = fill([run], ["noise.csv"], "config.yaml")
    assert "states: []" in text
    assert told.startswith("No channel looks like a state")
    assert "signals.states" in told

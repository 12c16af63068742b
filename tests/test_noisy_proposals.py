"""What `init` makes of noise on inputs, of strong nonlinearity and of inputs that are rough."""

from __future__ import annotations

import numpy as np
import pytest

from dfsm.config.proposal import propose
from dfsm.config.template import fill
from dfsm.data.trajectory import Channel, Trajectory
from driven import Array, duffing, jumping, record, swept


def lag(t: float, x: Array, u: float) -> list[float]:
    return [u - 0.7 * x[0] - 0.3 * x[0] ** 3]


def tanks(t: float, x: Array, u: float) -> list[float]:
    low, high = np.maximum(x, 0)
    out = 0.06 * np.sqrt(high)
    return [out - 0.05 * np.sqrt(low), 0.05 * (2.6 + 0.9 * u) - out]


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

"""Inputs that repeat themselves."""

from __future__ import annotations

import numpy as np
import pytest

from dfsm.data.periods import period
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.fitting.fit import fit
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.settings import FitSettings
from dfsm.models.signals import StateSpec


def run_of(**columns: np.ndarray) -> Trajectory:
    count = len(next(iter(columns.values())))
    channels = tuple(Channel(name, "-") for name in columns)
    return Trajectory(0.1 * np.arange(count), np.stack([*columns.values()], axis=1), channels)


def tones(count: int, base: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    time, phases = 0.1 * np.arange(count), rng.uniform(0, 2 * np.pi, 12)
    return np.cos(2 * np.pi * base * np.outer(time, np.arange(1, 13)) + phases).sum(axis=1)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_period_of_all_inputs_is_told(noise: float) -> None:
    rng = np.random.default_rng(3)
    u = tones(1000, 1 / 20, 1)
    u = u + noise * u.std() * rng.standard_normal(len(u))
    assert period(run_of(u=u), ["u"]) == pytest.approx(20.0, abs=0.1)
    both = run_of(u=tones(1000, 1 / 20, 1), v=tones(1000, 1 / 30, 2), rests=np.ones(1000))
    assert period(both, ["u", "v", "rests"]) == pytest.approx(60.0, abs=0.1)


def test_what_does_not_repeat_has_no_period() -> None:
    rng = np.random.default_rng(4)
    walk = np.repeat(rng.uniform(-1, 1, 50), 20)
    ramp, rests = np.linspace(0, 1, 1000), np.ones(1000)
    for u in (walk, ramp, rests, tones(1000, 1 / 90, 1)):
        assert period(run_of(u=u), ["u"]) is None
    # One that repeats beside one that does not.
    assert period(run_of(u=tones(1000, 1 / 20, 1), v=walk), ["u", "v"]) is None
    assert period(run_of(u=walk), []) is None


def test_a_fit_tells_that_what_was_left_out_was_seen() -> None:
    """The error where data were left out says nothing of other inputs then."""
    u, x = tones(900, 1 / 20, 1) / 4, np.zeros(900)
    for k in range(899):
        x[k + 1] = x[k] + 0.1 * (u[k] - 0.7 * x[k] - 0.3 * x[k] ** 3)
    hidden = HiddenSettings(count=0, form="polynomial")
    states = (StateSpec(name="x"),)
    settings = FitSettings(states=states, disturbances=("u",), inputs="hold", hidden=hidden)
    result = fit([run_of(u=u, x=x)], settings)
    told = next(text for text in result.model.provenance.record["checks"] if "left out" in text)
    assert "repeat themselves every 20 s" in told

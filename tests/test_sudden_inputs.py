"""Smooth inputs that move suddenly now and then: kinks of states are no rates, and told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dfsm.core.types import Array
from dfsm.data.between import events, kinks
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.fitting.corrective import MLP, RBF, NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings

STEP = 0.1
TIME = np.arange(0, 100, STEP)


def breeze(seed: int = 0) -> Array:
    """A smooth force in N."""
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, 3)
    return np.sin(np.multiply.outer(TIME, [0.9, 0.37, 0.13]) + phases).sum(axis=1)


def struck(seed: int = 0, blows: int = 3) -> Array:
    """The same with hammer blows of three samples, 20 N."""
    force, rng = breeze(seed), np.random.default_rng(100 + seed)
    for first in rng.choice(np.arange(30, len(TIME) - 30, 25), blows, replace=False):
        force[first : first + 3] += 20.0
    return force


def oscillator(x: Array, force: float) -> Array:
    return np.array([x[1], -4.0 * x[0] - 0.8 * x[1] + force])


def run_of(
    force: Array, f: Callable[[Array, float], Array] = oscillator, name: str = "run"
) -> Trajectory:
    """What follows lines from sample to sample, by 20 steps of RK4 each."""
    states, h = [np.zeros(2)], STEP / 20
    for a, b in pairwise(force):
        x = states[-1]
        for k in range(20):
            first, middle, last = (a + (b - a) * (k + part) / 20 for part in (0, 0.5, 1))
            k1 = f(x, first)
            k2 = f(x + h / 2 * k1, middle)
            k3 = f(x + h / 2 * k2, middle)
            k4 = f(x + h * k3, last)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(x)
    channels = Channel("x", "m"), Channel("v", "m/s"), Channel("F", "N")
    return Trajectory(TIME, np.column_stack([np.stack(states), force]), channels, name=name)


def settings(rate: str | None, corrective: NoCorrection | RBF | MLP) -> FitSettings:
    return FitSettings(
        states=(StateSpec(name="x", order=2, rate=rate),),
        disturbances=("F",),
        corrective=corrective,
        nonlinear_only=False,
    )


def test_only_what_stands_out_is_an_event():
    force = breeze()
    assert len(events(TIME, force)) == 0
    force[400:403] += 20.0
    force[700:] -= 5.0
    assert events(TIME, force).tolist() == [399, 402, 699]
    run = Trajectory(TIME, force[:, None], (Channel("F"),))
    assert kinks(run, ("F",), ("linear",)).tolist() == [399, 400, 402, 403, 699, 700]
    assert len(kinks(run, ("F",), ("cubic",))) == 0

    rng = np.random.default_rng(0)
    gust = np.exp(-(((TIME - 50) / 2) ** 2))
    rounded = np.round(breeze(), 1)
    stairs = np.repeat(rng.normal(size=len(TIME) // 5), 5)
    for smooth in (rng.normal(size=len(TIME)), gust, rounded, stairs, np.zeros(len(TIME)), TIME):
        assert len(events(TIME, smooth)) == 0


@pytest.mark.parametrize("rate", ["v", None])
def test_blows_leave_the_coefficients_alone(rate):
    runs = [run_of(struck(seed), name=f"run{seed}") for seed in range(2)]
    model = fit(runs, settings(rate, NoCorrection())).model
    assert_allclose(model.f.coefficients[0, 1], [1.0, -4.0, -0.8], rtol=0.01)
    assert "F moves suddenly over 12 intervals between samples" in model.summary()


def test_a_correction_that_harms_rollouts_is_withdrawn():
    """A rate that reads 0.3 sin(15 v) too much: to be learnt, but no part of where x goes."""
    runs = [run_of(breeze(seed), name=f"run{seed}") for seed in range(4)]
    odd = []
    for run in runs:
        wrong = np.gradient(run["v"], TIME) + 0.3 * np.sin(15 * run["v"])
        odd.append(run.with_channels([Channel("a", "m/s^2")], wrong[:, None]))
    accelerated = StateSpec(name="x", order=2, rate="v", acceleration="a")
    model = fit(odd, replace(settings("v", RBF()), states=(accelerated,))).model
    assert model.e is None
    text = model.provenance.record["rows"][-1]["decision"]
    assert "with the correction rollouts over 4 training runs are off by" in text
    assert model.provenance.record["rows"][-1]["explained"] > 0.9


def test_a_correction_that_rollouts_need_stays():
    stiff = lambda x, force: oscillator(x, force) - np.array([0, 3 * x[0] ** 3])  # noqa: E731
    runs = [run_of(2 * breeze(seed), stiff, name=f"run{seed}") for seed in range(4)]
    model = fit(runs, settings("v", MLP(hidden=(8,), iterations=30, samples=1000))).model
    (_, decision) = model.provenance.record["rows"]
    assert decision["corrected"]
    steps = int(decision["decision"].split("network, ")[1].split()[0])
    assert steps > 0

"""What is said of controls that follow from the states: feedback, sines, sensors, a law alone.

Systems are integrated with the exact step, so the true coefficients are known.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from dfsm import DfsmWarning, FitSettings, StateSpec, Trajectory
from dfsm.data.trajectory import Channel
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit

ONE = FitSettings(
    states=(StateSpec(name="x"),),
    controls=("u",),
    corrective=NoCorrection(),
    nonlinear_only=False,
)
TWO = replace(ONE, states=(StateSpec(name="x", order=2, rate="v"),))


def slow(rng, count: int, memory: float) -> np.ndarray:
    x = rng.standard_normal(count + 500)
    for lag in (memory, memory / 5):
        a = np.exp(-1 / lag)
        x = lfilter([1 - a], [1.0, -a], x)
    return x[500:] / x[500:].std()


def answer(A: np.ndarray, B: np.ndarray, w: np.ndarray, step: float, law=None) -> np.ndarray:
    """States under inputs that are lines between samples; with a law the first is a force alone."""
    n = len(A)
    if law is not None:
        A = A + B[:, :1] @ law
        B = B[:, 1:]
    m = B.shape[1]
    whole = np.zeros((n + 2 * m, n + 2 * m))
    whole[:n, : n + m] = np.hstack([A, B])
    whole[n : n + m, n + m :] = np.eye(m)
    P = expm(whole * step)
    states = [np.zeros(n)]
    for now, then in pairwise(w):
        states.append((P @ np.concatenate([states[-1], now, (then - now) / step]))[:n])
    return np.array(states)


def run(step: float, **channels: np.ndarray) -> Trajectory:
    values = np.stack(list(channels.values()), axis=1)
    return Trajectory(step * np.arange(len(values)), values, tuple(Channel(n) for n in channels))


def told(data: Trajectory, settings: FitSettings) -> tuple[np.ndarray, list[str]]:
    """Coefficients of the last row, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DfsmWarning)
        model = fit([data], settings).model
    return np.asarray(model.f.coefficients)[0, -1], [str(w.message) for w in caught]


def one_state(u: np.ndarray, force: np.ndarray) -> Trajectory:
    x = answer(np.array([[-0.1]]), np.array([[0.2, 1.0]]), np.stack([u, force], axis=1), 1.0)
    return run(1.0, x=x[:, 0], u=u)


def two_states(u: np.ndarray, force: np.ndarray) -> Trajectory:
    A, B = np.array([[0.0, 1.0], [-0.09, -0.1]]), np.array([[0.0, 0.0], [0.2, 1.0]])
    x = answer(A, B, np.stack([u, force], axis=1), 1.0)
    return run(1.0, x=x[:, 0], v=x[:, 1], u=u)


@pytest.mark.parametrize("seed", range(4))
def test_a_sine_follows_from_its_state_and_is_no_feedback(seed):
    rng = np.random.default_rng(seed)
    u = np.sin(0.17 * np.arange(2000.0))
    row, notes = told(one_state(u, 0.1 * slow(rng, 2000, 15)), ONE)
    assert row[0] == pytest.approx(0.2, rel=0.25)
    assert not [n for n in notes if "feedback" in n or "believe" in n or "late" in n]


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_a_sine_is_not_late(seed):
    """Any phase of it is what the state and the control make up together."""
    u = np.sin(0.25 * np.arange(1200.0))
    force = np.random.default_rng(seed).standard_normal(1700)
    for _ in range(3):
        force = lfilter([1 - np.exp(-1 / 6)], [1.0, -np.exp(-1 / 6)], force)
    w = np.stack([u, force[500:] / force[500:].std()], axis=1)
    x = answer(np.array([[-0.2]]), np.array([[0.3, 0.1]]), w, 1.0)
    _, notes = told(run(1.0, x=x[:, 0], u=u), ONE)
    assert not [n for n in notes if "late" in n]


@pytest.mark.parametrize("seed", [0, 2])
def test_one_sine_is_too_little_for_three_coefficients(seed):
    u = np.sin(0.17 * np.arange(2000.0))
    force = 0.1 * slow(np.random.default_rng(seed), 2000, 15)
    row, notes = told(two_states(u, force), TWO)
    assert abs(row[0] / 0.2 - 1) > 0.3
    assert not [n for n in notes if "feedback" in n]
    assert "so few sines (about 1) that it cannot tell 3 coefficients apart" in notes[0]


@pytest.mark.parametrize("force", ["slow", "sines", "mostly a sine"])
def test_a_loop_is_told_whatever_the_unknown_force(force):
    """Sines of a force make sines of the control, which its past foretells as well."""
    time, noise = np.arange(2000.0), slow(np.random.default_rng(3), 2000, 15)
    w = {
        "slow": noise,
        "sines": np.sin(0.11 * time) + np.sin(0.29 * time),
        "mostly a sine": 5 * np.sin(0.11 * time) + noise,
    }[force]
    # A controller of the state and its integral, against the force.
    A, B = np.array([[-0.1, 0.0], [1.0, 0.0]]), np.array([[0.2, 1.0], [0.0, 0.0]])
    law = np.array([[-0.8, -0.05]])
    x = answer(A, B, 0.1 * w[:, None], 1.0, law)
    row, notes = told(run(1.0, x=x[:, 0], u=x @ law[0]), ONE)
    assert abs(row[1] / -0.1 - 1) > 0.3
    assert any("feedback" in n for n in notes)


def test_a_law_without_an_integral_is_no_dead_time():
    """The states a sample ago are their derivative: so is a control that is made of them."""
    rng = np.random.default_rng(0)
    A, B = np.array([[0.0, 1.0], [-0.6, -0.05]]), np.array([[0.0, 0.0], [0.3, 0.3]])
    law = np.array([[-0.2, -1.5]])
    x = answer(A, B, slow(rng, 1800, 4)[:, None], 0.5, law)
    u = x @ law[0] + 0.001 * rng.standard_normal(1800)
    _, notes = told(run(0.5, x=x[:, 0], v=x[:, 1], u=u), TWO)
    assert not [n for n in notes if "late" in n or "hidden" in n]
    assert any("'u' is little else than the states" in n or "feedback biases" in n for n in notes)


def test_a_noisy_input_is_called_noisy_and_nothing_else():
    rng = np.random.default_rng(1)
    u = slow(rng, 2000, 8)
    data = one_state(u, np.zeros(2000))
    noisy = run(1.0, x=data["x"], u=u + 0.6 * rng.standard_normal(2000))
    _, notes = told(noisy, ONE)
    assert len(notes) == 1
    assert "noise of a sensor" in notes[0]


@pytest.mark.parametrize("seed", range(6))
def test_a_slow_force_pulls_no_effect_that_is_right(seed):
    """Over intervals that suit the force alone, states have answered the sines already."""
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(0.05, 0.5, (4, 1)), rng.uniform(0, 6, (4, 1))
    u = np.sin(rates * np.arange(2000.0) + phases).sum(axis=0)
    row, notes = told(two_states(u, 0.12 * slow(rng, 2000, 50)), TWO)
    if abs(row[0] / 0.2 - 1) <= 0.1:
        assert not notes

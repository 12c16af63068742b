"""How intervals grow: with the time since the start, and with the distance from the data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dfsm.validation.growth import RolloutErrors, law_of, recent

TIME = np.arange(0, 100, 0.2)
MEMORY = 10.0


def forgetting(seed: int, distance: float) -> RolloutErrors:
    """Errors that start at zero and are forgotten in 10 s, larger the farther from the data."""
    rng, stay = np.random.default_rng(seed), np.exp(-0.2 / MEMORY)
    push = (
        np.sqrt((1 + distance**2) / 2) * np.sqrt(1 - stay**2) * rng.standard_normal((len(TIME), 2))
    )
    errors = np.zeros((len(TIME), 2))
    for k in range(len(TIME) - 1):
        errors[k + 1] = stay * errors[k] + push[k]
    flat = np.full(len(TIME), distance)
    return RolloutErrors(f"{seed % 4}", TIME, np.zeros(len(TIME)), flat, errors)


@pytest.fixture(scope="module")
def law():
    parts = [forgetting(seed, (0.5, 1.0, 2.0, 4.0)[seed % 4]) for seed in range(40)]
    return law_of(parts, np.array([0.0]))


def test_errors_that_are_forgotten_grow_until_then(law):
    lag = np.array([1.0, 3.0, 10.0, 30.0, 80.0])
    usual = law.growth.factor(lag, np.ones(5))
    # The standard deviation of a process that begins at zero.
    expected = np.sqrt(1 - np.exp(-2 * lag / MEMORY))
    np.testing.assert_allclose(usual / usual[-1], expected[:, None] * np.ones(2), atol=0.12)
    np.testing.assert_allclose(law.scale, 1.0, rtol=0.35)


def test_errors_grow_with_the_distance_as_those_left_out_did(law):
    def far(distance: float) -> float:
        part = replace(forgetting(0, 1.0), distance=np.full(len(TIME), distance))
        return law.at(part)[-1, 0]

    assert far(4.0) / far(1.0) == pytest.approx(np.sqrt(17 / 2), rel=0.25)
    assert far(8.0) > far(4.0)
    assert law.growth.farthest == 4.0


def test_what_does_not_grow_stays_as_it_is():
    rng = np.random.default_rng(0)
    parts = [
        RolloutErrors(f"{k}", TIME, np.zeros(500), np.ones(500), rng.standard_normal((500, 1)))
        for k in range(12)
    ]
    law = law_of(parts, np.array([0.0]))
    np.testing.assert_allclose(law.at(parts[0]), 1.0, atol=0.15)
    # Twice as long as any rollout that was left out: nothing grew at last, so nothing does now.
    later = law.growth.factor(np.array([99.8, 199.6]), np.ones(2))
    np.testing.assert_allclose(later[1], later[0], rtol=0.05)


def test_the_distance_of_the_recent_past_counts():
    distance = np.where(TIME > 50, 3.0, 1.0)
    averaged = recent(TIME, distance, 10.0)
    assert averaged[249] == pytest.approx(1.0)
    at = np.searchsorted(TIME, 60.0)
    expected = np.sqrt(9 - 8 * np.exp(-(60.0 - 50.1) / 10.0))
    assert averaged[at] == pytest.approx(expected, rel=0.02)
    np.testing.assert_array_equal(recent(TIME, distance, 0.0), distance)

"""Steady states against those that are known."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import fits
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM
from dfsm.models.steady import steady_state
from systems import (
    linear_model,
)


@pytest.fixture
def linear():
    return fits.linear()


@pytest.fixture
def duffing():
    return fits.duffing()


@pytest.fixture
def scheduled():
    return fits.scheduled()


def test_steady_state_of_a_linear_system(linear):
    steady = steady_state(linear.model, controls=[1.5], disturbances=[8.0])
    assert steady.converged
    # 0 = -4 q + 2 * 1.5 + 0.5 * 8
    np.testing.assert_allclose(steady.states, [1.75, 0], atol=1e-5)
    np.testing.assert_allclose(steady.outputs, [3 * 1.75 + 0.3 + 10], atol=1e-4)
    np.testing.assert_allclose(
        np.sort_complex(steady.eigenvalues), np.sort_complex(np.roots([1, 0.6, 4])), atol=1e-5
    )
    assert steady.message == "steady state inside the training range"
    far = steady_state(linear.model, controls=[100.0], disturbances=[8.0])
    assert far.message == "steady state: outside the training range"


def test_steady_state_of_a_nonlinear_system(duffing):
    steady = steady_state(duffing.model, controls=[0.9], disturbances=[0.0])
    assert steady.converged
    q = next(r.real for r in np.roots([3, 0, 2, -1.8]) if abs(r.imag) < 1e-9)
    np.testing.assert_allclose(steady.states, [q, 0], rtol=0, atol=0.02)
    np.testing.assert_allclose(
        np.sort_complex(steady.eigenvalues),
        np.sort_complex(np.roots([1, 0.8, 2 + 9 * q**2])),
        atol=0.2,
    )


def test_steady_state_along_the_schedule(scheduled):
    steady = steady_state(scheduled, schedule=10.0, controls=[1.0])
    assert steady.converged
    np.testing.assert_allclose(steady.states, [2 / 4, 0], atol=0.05)
    assert steady.disturbances[0] == 10.0
    with pytest.raises(DfsmError, match="an LPV model needs a value of its schedule 'w'"):
        steady_state(scheduled)
    with pytest.raises(DfsmError, match="w = 40 is outside the training range"):
        steady_state(scheduled, schedule=40.0)


def test_no_steady_state_is_told():
    # ẋ0 = u is never zero while u is held at one.
    model = linear_model(np.array([[0.0, 0], [0, -1]]), np.array([[1.0], [0.0]]))
    steady = steady_state(model, controls=[1.0])
    assert not steady.converged
    assert "no steady state was found" in steady.message


def test_an_unstable_steady_state_is_told():
    model = linear_model(np.array([[0.5]]), np.array([[1.0]]))
    steady = steady_state(model, controls=[1.0])
    np.testing.assert_allclose(steady.states, [-2.0])
    assert steady.message == "steady state: unstable, growing at 0.5 1/s"


def at_mean(model: DFSM, mean: list[float], std: list[float]) -> DFSM:
    """The model with other moments of its training data."""
    region = replace(model.region, mean=jnp.asarray(mean), std=jnp.asarray(std))
    return replace(model, region=region)


def test_a_state_that_nothing_depends_on_stays_put():
    # ψ̇ = ω - 2 and ω̇ = u - ω: any azimuth ψ is as good as another.
    model = linear_model(np.array([[0.0, 1], [0, -1]]), np.array([[0.0], [1.0]]))
    model = replace(model, f=replace(model.f, offsets=jnp.array([[-2.0, 0.0]])))
    model = at_mean(model, [0.0, 77.0, 0.5], [1.0, 3.0, 0.2])
    steady = steady_state(model, controls=[2.0])
    assert steady.converged
    np.testing.assert_allclose(steady.states, [77.0, 2.0], rtol=1e-12)


def test_a_state_that_did_not_vary_in_training_has_a_steady_state_too():
    model = at_mean(linear_model(-np.eye(2), np.ones((2, 1))), [0.0, 0.0, 4.0], [1.0, 1.0, 0.0])
    steady = steady_state(model, controls=[3.0])
    assert steady.converged
    np.testing.assert_allclose(steady.states, [3.0, 3.0], rtol=1e-12)


def test_a_steady_state_far_from_the_data_is_reached():
    model = at_mean(linear_model(np.array([[-1e-3]]), np.ones((1, 1))), [0.0, 0.0], [1.0, 1.0])
    steady = steady_state(model, controls=[1.0])
    np.testing.assert_allclose(steady.states, [1000.0], rtol=1e-12)
    assert steady.message == "steady state: outside the training range"

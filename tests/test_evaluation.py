"""What a model offers besides simulation: values, Jacobians, linearization, eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest

import fits
from dfsm.errors import DfsmError
from dfsm.models.signals import Azimuth, blade_harmonics
from systems import (
    OSCILLATOR_A,
    OSCILLATOR_B,
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


# -- evaluation ---------------------------------------------------------------------------------


def test_evaluation_broadcasts_over_leading_axes(duffing):
    model = duffing.model
    rng = np.random.default_rng(0)
    x, u, w = rng.normal(size=(4, 3, 2)), rng.normal(size=(3, 1)), np.array([0.5])
    many = model.derivative(x, u, w)
    outputs = model.output(x, u, w)
    assert many.shape == (4, 3, 2)
    assert outputs.shape == (4, 3, 2)
    for i in range(4):
        for j in range(3):
            one = model.derivative(x[i, j], u[j], w)
            np.testing.assert_allclose(many[i, j], one, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(outputs[i, j], model.output(x[i, j], u[j], w), atol=1e-9)


def test_join_and_split_are_inverse_and_in_the_documented_order(linear):
    model = linear.model
    inputs = model.join([1.0, 2.0], [3.0], [4.0])
    np.testing.assert_array_equal(inputs, [3, 4, 1, 2])
    assert [c.name for c in model.signals.inputs] == ["u", "w", "q", "v"]
    x, u, w, p = model.split(inputs)
    np.testing.assert_array_equal(model.join(x, u, w, p), inputs)


def test_groups_of_the_wrong_size_are_refused(linear):
    model = linear.model
    with pytest.raises(DfsmError, match=r"controls have shape \(2,\).* hold 1: u"):
        model.derivative([0, 0], [1, 2], [0])
    with pytest.raises(DfsmError, match=r"states have shape \(\).* hold 2: q, v"):
        model.derivative(0.0, [1], [0])
    with pytest.raises(DfsmError, match=r"parameters have shape \(1,\).* hold 0: none"):
        model.output([0, 0], [1], [0], [3])
    with pytest.raises(DfsmError, match=r"taken at one point, got shape \(5,\)"):
        model.jacobians(np.zeros((5, 2)), [1], [0])


def test_no_samples_give_no_values(linear):
    assert linear.model.derivative(np.zeros((0, 2)), [1.0], [0.0]).shape == (0, 2)
    assert linear.model.output(np.zeros((0, 2)), [1.0], [0.0]).shape == (0, 1)


def test_a_model_without_outputs():
    model = linear_model(OSCILLATOR_A, OSCILLATOR_B)
    assert model.output(np.zeros((3, 2)), [0.0, 0.0], []).shape == (3, 0)
    A, B, C, D = model.jacobians([0.0, 0.0], [0.0, 0.0], [])
    np.testing.assert_allclose(A, OSCILLATOR_A)
    np.testing.assert_allclose(B, OSCILLATOR_B)
    assert C.shape == (0, 2)
    assert D.shape == (0, 2)


def test_harmonics_average_to_zero_where_the_azimuth_is_not_given():
    model = linear_model(
        -np.eye(1), np.ones((1, 1)), np.array([[2.0]]), units=["rpm"], azimuth=Azimuth(speed="x0")
    )
    psi = 2 * np.pi * np.arange(36) / 36
    around = np.asarray(model.output(np.ones((36, 1)), [0.0], [], azimuth=psi))
    np.testing.assert_allclose(around[:, 0], 2 + np.cos(3 * psi), atol=1e-12)
    mean = model.output([1.0], [0.0], [])
    np.testing.assert_allclose(mean, around.mean(0), atol=1e-12)
    np.testing.assert_allclose(
        blade_harmonics(psi, 2), np.stack([np.cos(2 * psi), np.sin(2 * psi)], 1), atol=1e-12
    )


# -- linearization, equilibria ------------------------------------------------------------------


@pytest.mark.parametrize("which", ["duffing", "scheduled"])
def test_jacobians_agree_with_central_differences(which, duffing, scheduled):
    model = duffing.model if which == "duffing" else scheduled
    x, u, w = np.array([0.3, -0.4]), np.array([0.7]), np.array([9.3 if model is scheduled else 1.0])
    A, B, C, D = model.jacobians(x, u, w)
    h = 1e-5

    def central(function):
        columns = []
        for i in range(4):
            d = np.zeros(4)
            d[i] = h
            up = function(x + d[2:], u + d[:1], w + d[1:2])
            down = function(x - d[2:], u - d[:1], w - d[1:2])
            columns.append((np.asarray(up) - np.asarray(down)) / (2 * h))
        J = np.stack(columns, axis=1)
        return J[:, 2:], J[:, :2]

    for found, expected in zip(
        (A, B, C, D), (*central(model.derivative), *central(model.output)), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_linearize_names_its_signals(linear, duffing):
    system = linear.model.linearize([0.1, 0.2], [1.0], [8.0])
    assert system.state_labels == ["q", "v"]
    assert system.input_labels == ["u", "w"]
    assert system.output_labels == ["y"]
    np.testing.assert_allclose(system.A, OSCILLATOR_A, atol=1e-5)
    np.testing.assert_allclose(system.B, OSCILLATOR_B, atol=1e-5)
    np.testing.assert_allclose(system.C, [[3, -1]], atol=1e-5)
    np.testing.assert_allclose(system.D, [[0.2, 0]], atol=1e-5)
    bent = duffing.model.linearize([0.0, 0.0], [0.0], [0.0])
    # d/dq of -2 q - 3 q³ at 0 is -2; the linear fit averages over the whole swing.
    np.testing.assert_allclose(bent.A, [[0, 1], [-2, -0.8]], atol=0.4)
    assert duffing.model.linear_fit().linearize([0.0, 0.0], [0.0], [0.0]).A[1, 0] < -3


def test_eigenvalues_are_those_of_a_most_unstable_first():
    A = np.array([[0.5, 3.0], [0.0, -2.0]])
    ((point, values),) = linear_model(A, np.ones((2, 1))).eigenvalues()
    assert point == 0
    np.testing.assert_allclose(values, [0.5, -2.0])


def test_eigenvalues_per_schedule_point(scheduled):
    for w, values in scheduled.eigenvalues():
        truth = np.roots([1, 0.5 + 0.05 * w, 1 + 0.3 * w])
        np.testing.assert_allclose(
            np.sort_complex(values), np.sort_complex(truth), rtol=0.05, atol=0.05
        )

"""Delays, corners, intervals and numbers beyond all use: one sentence, or what a limit gives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import dfsm as package
from dfsm.errors import DfsmError, hushed
from systems import driving_run, linear_model

TIME = np.arange(0, 20.01, 0.1)
A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0, 0.0], [2.0, 0.5]])
MODEL = linear_model(A, B, np.array([[1.0, 0.0]]), names=["q", "v"])
INPUTS = np.stack([0 * TIME, np.sin(1.7 * TIME)], axis=1)
RUN = driving_run(MODEL, TIME, INPUTS, np.tile([0.5, 0], (len(TIME), 1)), "r")
SHORT = package.ClosedLoopSettings(start_up=2.0)


def law(interval=0.1):
    return package.PID(
        kp=0.2, ki=0.1, setpoint=0.2, measurements=["q"], measurement_units=["m"],
        commands=["u0"], command_units=["N"], interval=interval,
    )  # fmt: skip


@pytest.mark.parametrize("corner", [0.05, 0.5, 3.0, 40.0, 900.0])
def test_an_actuator_moves_as_its_equation_does(corner):
    h = 0.1
    for damping in (0.0, 0.3, 0.999999, 1.0, 1.000001, 1.02, 1.5, 5.0):
        rate = np.array([[0, 1], [-(corner**2), -2 * damping * corner]])
        # Balanced: exact where the corner is far above 1.
        scale = np.diag([1.0, corner])
        expected = scale @ scipy.linalg.expm(np.linalg.inv(scale) @ rate @ scale * h)
        expected = expected @ np.linalg.inv(scale)
        actuator = package.Actuator(law(h), corner=corner, damping=damping)
        found = np.asarray(actuator.start(jnp.zeros(1), jnp.zeros(1)).moves)
        size = np.array([[1, 1 / corner], [corner, 1]])
        np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=2e-12)


@pytest.mark.parametrize("damping", [0.4, 1.0, 3.0])
def test_the_slope_of_an_actuator_with_its_corner(damping):
    def moves(corner):
        actuator = package.Actuator(law(), corner=corner, damping=damping)
        return actuator.start(jnp.zeros(1), jnp.zeros(1)).moves

    for corner in (0.2, 2.0, 30.0, 1e6):
        step = 1e-5 * corner
        slope = (moves(corner + step) - moves(corner - step)) / (2 * step)
        np.testing.assert_allclose(jax.jacfwd(moves)(corner), slope, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("corner", [3e3, 1e6, 1e12])
def test_an_actuator_much_faster_than_its_interval_is_none(corner):
    with hushed():
        found, plain = (
            package.closed_loop(MODEL, RUN, controller, settings=SHORT)
            for controller in (package.Actuator(law(), corner=corner), law())
        )
    assert found.status is package.LoopStatus.COMPLETED
    np.testing.assert_allclose(found.trajectory["q"], plain.trajectory["q"], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: package.Sensor(law(), delay=1e9), "delay is 1000000000.0, expected seconds, at"),
        (lambda: package.Sensor(law(), seed=10**30), "seed is 1000000000000000000000000000000, ex"),
        (lambda: package.Actuator(law(), corner=1.0, damping=1e9), "damping is 1000000000.0, expe"),
        (lambda: package.TuneSettings(starts=10**10), "starts is 10000000000, expected a whole"),
        (lambda: package.TuneSettings(pareto=10**10), "pareto is 10000000000, expected 0, or a"),
        *(
            (lambda s=s: package.closed_loop(MODEL, RUN, law(s), settings=SHORT), "r.csv: a contro")
            for s in (1e-9, 1e-300, 5e-324)
        ),
        (
            lambda: package.closed_loop(
                MODEL, RUN, law(), settings=package.ClosedLoopSettings(start_up=2.0, step=1e-9)
            ),
            "r.csv: a plant step of 1e-09 s makes 2e\\+10 steps over 20 s, at most 3,000,000 are",
        ),
        (
            lambda: package.sweep(
                MODEL,
                [RUN],
                {"a": law()},
                settings=package.SweepSettings(loop=SHORT, extremes=("q",), block=1e-9),
            ),
            "extremes of q: blocks of 1e-09 s hold no sample where samples are 0.1 s apart: take",
        ),
    ],
)
def test_what_would_fill_the_memory_is_told(make, sentence):
    with hushed(), pytest.raises(DfsmError, match=sentence):
        make()

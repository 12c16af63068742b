"""Built-in controllers against closed forms; limits, anti-windup, reset as properties."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

import dfsm
from dfsm.controllers.actuator import Actuator
from dfsm.controllers.controller import Controller
from dfsm.controllers.pid import PID
from dfsm.controllers.sensor import Sensor
from dfsm.controllers.state_space import StateFeedback, StateSpace, regulator_gain
from dfsm.errors import DfsmError
from systems import linear_model

NAMES = {
    "measurements": ["y"], "measurement_units": ["rpm"],
    "commands": ["u"], "command_units": ["deg"], "interval": 0.1,
}  # fmt: skip
PI = PID(kp=2.0, ki=0.5, setpoint=1.0, limits=(-3.0, 4.0), **NAMES)


@jax.jit
def answers(controller, seen, start):
    """Commands ``(time, command)`` at measurements, and the states after."""

    def call(state, y):
        state, command = controller.step(state, y, jnp.zeros(()))
        return state, (command, state)

    return jax.lax.scan(call, controller.start(seen[0], start), seen)[1]


def told(controller, seen, start=(0.0,)):
    commands, states = answers(
        controller, jnp.asarray(seen).reshape(len(seen), -1), jnp.array(start)
    )
    return np.asarray(commands), states


def test_pid_is_its_formula_and_continues_the_command_it_finds():
    seen = 1 - np.array([0.3, 0.3, 0.1, -0.2, 0.4])
    law = replace(PI, kd=jnp.array(0.05))
    assert isinstance(law, Controller)
    commands, _ = told(law, seen, (0.7,))
    error, sums = 1 - seen, np.cumsum(1 - seen)
    rates = np.diff(seen, prepend=seen[0]) / 0.1
    begun = 0.7 - 2 * error[0] - 0.05 * sums[0]
    expected = begun + 2 * error + 0.05 * sums - 0.05 * rates
    np.testing.assert_allclose(commands[:, 0], expected, atol=1e-12)
    assert commands[0, 0] == pytest.approx(0.7)


def test_gains_follow_their_schedule():
    both = NAMES | {"measurements": ["y", "θ"], "measurement_units": ["rpm", "deg"]}
    law = PID(kp=[2.0, 1.0], ki=0.0, setpoint=0.0, points=[0.0, 10.0], **both)
    seen = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 5.0], [1.0, 30.0]])
    np.testing.assert_allclose(told(law, seen)[0][:, 0], [0, -2, -1.5, -1], atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-50, 50), min_size=8, max_size=8), st.floats(-10, 10))
def test_pid_never_exceeds_its_limits_nor_winds_up(errors, command):
    # Saturated for as long as may be, then the error turns.
    seen = 1 - np.concatenate([np.repeat(errors, 5), np.full(20, -1.0)])
    commands, states = told(PI, seen, (command,))
    integral = np.asarray(states.integral)
    assert commands.min() >= -3
    assert commands.max() <= 4
    assert integral.min() >= -3
    assert integral.max() <= 4
    # Without windup the turned error is felt at once: kp alone takes off 2.
    assert commands[-20, 0] <= 4 - 2
    np.testing.assert_allclose(commands[-20:, 0], np.maximum(
        commands[-20, 0] - 0.05 * np.arange(20), -3.0), atol=1e-9)  # fmt: skip


def test_state_space_answers_as_scipy_and_begins_at_its_command():
    A, B = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.1], [0.4]])
    C, D = np.array([[1.0, 0.5]]), np.array([[0.3]])
    law = StateSpace(A, B, C, D, y0=[2.0], u0=[5.0], **NAMES)
    seen = 2 + np.random.default_rng(0).normal(size=30)
    commands, _ = told(law, seen, (6.0,))
    assert commands[0, 0] == pytest.approx(6.0)
    start = np.asarray(law.start(jnp.asarray(seen[:1]), jnp.array([6.0])))
    _, out, _ = signal.dlsim((A, B, C, D, 0.1), seen - 2, x0=start)
    np.testing.assert_allclose(commands, 5 + out, atol=1e-12)
    # A state that holds a command for ever, where there is one, is the one to begin with.
    steady = np.linalg.solve(np.eye(2) - A, B @ [0.5])
    held = np.asarray(law.start(jnp.array([2.5]), jnp.asarray(5 + C @ steady + D @ [0.5])))
    np.testing.assert_allclose(held, steady, atol=1e-9)
    with pytest.raises(DfsmError, match=r"C of shape is \(1, 3\), expected shape \(1, 2\)"):
        StateSpace(A, B, np.ones((1, 3)), D, **NAMES)


def test_an_integrator_in_state_space_is_a_pi_controller():
    same = StateSpace([[1.0]], [[-0.05]], [[1.0]], [[-2.05]], y0=[1.0], **NAMES)
    seen = 1 + 0.3 * np.random.default_rng(1).normal(size=20)
    np.testing.assert_allclose(told(same, seen, (0.4,))[0], told(PI, seen, (0.4,))[0], atol=1e-12)


def test_a_regulator_is_the_closed_form_and_stabilizes():
    # Of x' = a x + b u in discrete time the Riccati equation is quadratic.
    a, b, h, q, r = 0.3, 2.0, 0.1, 4.0, 0.5
    ad, bd = np.exp(a * h), b * (np.exp(a * h) - 1) / a
    half = (q * bd**2 + r * (ad**2 - 1)) / (2 * bd**2)
    P = half + np.sqrt(half**2 + q * r / bd**2)
    expected = bd * P * ad / (r + bd**2 * P)
    assert regulator_gain([[a]], [[b]], [[q]], [[r]], h)[0, 0] == pytest.approx(expected)
    with pytest.raises(DfsmError, match="no linear-quadratic regulator"):
        regulator_gain([[a]], [[0.0]], [[q]], [[r]], h)


def test_the_regulator_of_a_model_holds_its_point_against_a_step():
    A, B = np.array([[0.0, 1.0], [1.0, 0.2]]), np.array([[0.0, 0.0], [2.0, 1.0]])
    model = linear_model(A, B, names=["q", "v"], units=["deg", "deg/s"])
    none = np.zeros(0)
    point = dfsm.SteadyState(np.array([-1.0, 0]), np.array([0.5, 0]), *[none] * 4, 0.0, True, "")
    law = dfsm.linear_quadratic(
        model, point, states={"q": 1.0, "v": 1.0}, controls={"u0": 1.0}, integral={"q": 1.0},
        interval=0.1,
    )  # fmt: skip
    K, Ki = np.asarray(law.gain), np.asarray(law.integral_gain)
    loop = np.block([[A - B[:, :1] @ K, B[:, :1]], [-Ki, np.zeros((1, 1))]])
    assert np.linalg.eigvals(loop).real.max() < -0.1
    assert isinstance(law, StateFeedback)
    commands, _ = told(law, np.tile(np.asarray(point.states) + 0.1, (3, 1)), (0.9,))
    assert commands[0, 0] == pytest.approx(0.9)
    with pytest.raises(DfsmError, match=r"states: the model has no channel 'w'"):
        dfsm.linear_quadratic(model, point, states={"w": 1.0}, controls={"u0": 1}, interval=0.1)


class Says(PID):
    """Commands what it measures."""

    def step(self, state, measurements, time):
        return state, measurements


SAYS = Says(kp=0.0, ki=0.0, setpoint=0.0, **NAMES)


def test_an_actuator_answers_as_second_order_dynamics():
    law = Actuator(SAYS, corner=jnp.array(3.0), damping=0.6)
    commands, _ = told(law, np.ones(40))
    time = 0.1 * np.arange(1, 41)
    _, out = signal.step(([9.0], [1.0, 3.6, 9.0]), T=np.concatenate([[0.0], time]))
    np.testing.assert_allclose(commands[:, 0], out[1:], atol=1e-9)
    assert told(law, np.full(5, 2.5), (2.5,))[0][:, 0] == pytest.approx(2.5)
    assert (law.measurements, law.commands, law.interval) == (("y",), ("u",), 0.1)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=12, max_size=12), st.booleans())
def test_an_actuator_never_exceeds_its_limits(wanted, moves):
    corner = jnp.array(8.0) if moves else None
    law = Actuator(SAYS, corner=corner, damping=0.2, rate=2.0, limits=(-1.0, 5.0))
    commands, _ = told(law, np.repeat(wanted, 4), (0.5,))
    u = np.concatenate([[0.5], commands[:, 0]])
    assert u.min() >= -1
    assert u.max() <= 5
    assert np.abs(np.diff(u)).max() <= 0.2 * (1 + 1e-12)


def test_a_sensor_filters_delays_and_disturbs():
    seen = np.concatenate([[0.0], np.ones(30)])
    slow, _ = told(Sensor(SAYS, corner=jnp.array(2.0)), seen)
    np.testing.assert_allclose(slow[:, 0], 1 - np.exp(-0.2 * np.arange(31)), atol=1e-12)
    ramp = 0.1 * np.arange(20)
    for delay in (0.0, 0.3, 0.25):
        late, _ = told(Sensor(SAYS, delay=delay), ramp)
        np.testing.assert_allclose(late[:, 0], np.maximum(ramp - delay, 0), atol=1e-12)
    noisy = Sensor(SAYS, noise=0.5, seed=3)
    first, again = (told(noisy, np.full(4000, 7.0))[0][:, 0] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.mean() == pytest.approx(7, abs=0.05)
    assert first.std() == pytest.approx(0.5, rel=0.05)
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 0.05
    assert np.ptp(told(replace(noisy, seed=4), np.full(3, 7.0))[0] - first[:3, None]) > 0.01


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: replace(PI, limits=(1.0, 0.0)), r"limits is \(1.0, 0.0\), expected the lower"),
        (lambda: replace(PI, interval=0.0), "interval is 0.0, expected seconds, more than 0"),
        (lambda: Actuator(PI, acts_on=("v",)), "acts_on: the controller sets no channel 'v'"),
        (lambda: Sensor(PI, acts_on=("z",)), "acts_on: the controller has no channel 'z'"),
        (lambda: Sensor(PI, delay=-1.0), "delay is -1.0"),
        (lambda: Actuator(PI, rate=-1.0), "rate is -1.0, expected more than 0"),
    ],
)
def test_what_cannot_be_is_told(make, sentence):
    with pytest.raises(DfsmError, match=sentence):
        make()


LINEAR = StateSpace(A=[[0.9]], B=[[0.1]], C=[[-5.0]], D=[[0.2]], **NAMES)
SCHEDULED = replace(
    PI, measurements=("y", "v"), measurement_units=("rpm", "m/s"), points=[0.0, 1.0]
)


@pytest.mark.parametrize(
    ("law", "sentence"),
    [
        (replace(SCHEDULED, kp=[1, 2, 3]), r"kp of shape is \(3,\), expected a number or shape"),
        (replace(PI, kp=[1, 2]), r"kp of shape is \(2,\), expected a number$"),
        (replace(PI, setpoint=[1, 2]), r"setpoint of shape is \(2,\), expected a number$"),
        (replace(LINEAR, y0=[1, 2]), r"y0 of shape is \(2,\), .* or shape \(1,\): one per meas"),
        (replace(LINEAR, limits=([0, 0], [1, 1])), r"limits of shape is \(2,\), .* per command"),
        (Actuator(PI, corner=[1, 2]), r"corner of shape is \(2,\), expected a number$"),
        (Sensor(PI, noise=[1, 2]), r"noise of shape is \(2,\), .* one per measurement that it is"),
    ],
)
def test_shapes_are_told_where_a_loop_begins(law, sentence):
    with pytest.raises(DfsmError, match=sentence):
        law.start(jnp.zeros(len(law.measurements)), jnp.zeros(1))


def test_gains_that_a_function_is_mapped_over_have_an_axis_more():
    gains = replace(PI, kp=jnp.array([1.0, 2.0]))
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, gains)
    starts = jax.vmap(lambda one: one.start(jnp.zeros(1), jnp.zeros(1)).integral, in_axes=(axes,))
    np.testing.assert_allclose(starts(gains), [-1.05, -2.05])


def test_limits_may_be_lists_and_nothing_begins_wound_up_beyond_them():
    listed = replace(LINEAR, limits=([-0.5], [0.5]))
    np.testing.assert_array_equal(
        told(listed, np.ones(40))[0], told(replace(LINEAR, limits=(-0.5, 0.5)), np.ones(40))[0]
    )
    law = StateFeedback(
        gain=[[1.0]], integral_gain=[[1.0]], x0=[0.0], u0=[0.0], limits=(0.0, 4.0), **NAMES
    )
    # The plant's control stands far beyond; once the error leads away the command follows at once.
    commands, _ = told(law, np.array([0.0, 0.5, 0.5]), (30.0,))
    np.testing.assert_allclose(commands[:, 0], [4.0, 3.45, 3.4])

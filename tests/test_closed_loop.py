"""Closed loops against exact discrete solutions, open-loop rollouts, differences; bad input."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import dfsm
from dfsm.controllers.pid import PID
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.models.signals import Azimuth
from dfsm.simulation.closed_loop import closed_loops
from systems import driving_run, linear_model

A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0, 0.0], [2.0, 0.5]])
C, D = np.array([[3.0, -1.0]]), np.array([[0.2, 0.0]])
TIME = np.arange(0, 20.01, 0.1)
AT_ONCE = dfsm.ClosedLoopSettings(start_up=0.0)
FINE = dfsm.ClosedLoopSettings(start_up=0.0, step=0.01)


@pytest.fixture(scope="module")
def model():
    """q̈ = -4 q - 0.6 q̇ + 2 u0 + 0.5 u1 with q in deg, y0 = 3 q - q̇ + 0.2 u0."""
    return linear_model(A, B, C, D, names=["q", "v"], units=["deg", "deg/s"])


def run_of(model, time=TIME, disturbed=0.0, x0=(1.0, 0.0), commanded=0.0, name="run"):
    inputs = np.stack([np.full(len(time), commanded), disturbed * np.sin(time)], axis=1)
    states = np.tile(x0, (len(time), 1))
    return driving_run(model, time, inputs, states, name)


class Feedback(eqx.Module):
    """u0 = -k (q, v), in the model's units or others."""

    k: jax.Array
    measurements: tuple[str, ...] = eqx.field(static=True, default=("q", "v"))
    measurement_units: tuple[str, ...] = eqx.field(static=True, default=("deg", "deg/s"))
    commands: tuple[str, ...] = eqx.field(static=True, default=("u0",))
    command_units: tuple[str, ...] = eqx.field(static=True, default=("N",))
    interval: float = eqx.field(static=True, default=0.1)

    def start(self, measurements: Any, commands: Any) -> Any:
        return ()

    def step(self, state: Any, measurements: Any, time: Any) -> Any:
        return state, -jnp.asarray(self.k) @ measurements


class OnHost:
    """The same as an object that JAX knows nothing of."""

    def __init__(self, of):
        self.of = of

    def __getattr__(self, name):
        return getattr(self.of, name)


GAINS = Feedback(jnp.array([[1.5, 0.8]]))


def quietly(*args, **kwargs):
    with dfsm.errors.hushed():
        return dfsm.closed_loop(*args, **kwargs)


def exact(k, steps, interval=0.1, disturbed=None):
    """States at the calls: the matrix exponential with held commands."""
    wide = expm(np.block([[A, B[:, :1]], [np.zeros((1, 3))]]) * interval)
    x, path = np.array([1.0, 0.0]), []
    for _ in range(steps):
        path.append(x)
        x = wide[:2, :2] @ x + wide[:2, 2] * (-(np.asarray(k)[0] @ x))
    return np.array(path)


def test_a_linear_loop_is_the_matrix_exponential_with_held_commands(model):
    found = quietly(model, run_of(model), GAINS, settings=FINE)
    assert found.status is dfsm.LoopStatus.COMPLETED
    expected = exact(GAINS.k, len(TIME))
    np.testing.assert_allclose(found.trajectory.select(["q", "v"]).values, expected, atol=1e-9)
    u = -expected @ np.asarray(GAINS.k)[0]
    np.testing.assert_allclose(found.trajectory["u0"], u, atol=1e-9)
    # An output that the command reaches at once takes the command of its own time.
    np.testing.assert_allclose(found.trajectory["y0"], expected @ C[0] + 0.2 * u, atol=1e-8)
    assert [c.role for c in found.trajectory.channels] == [
        "state",
        "state",
        "control",
        "control",
        "output",
    ]


def test_on_the_host_and_among_others_it_is_the_same(model):
    runs = [run_of(model), run_of(model, TIME[:90], disturbed=1.0, name="short")]
    others = [replace(GAINS, k=k * GAINS.k) for k in (0.5, 1.0, 2.0)]
    many = closed_loops(model, runs, [*others, OnHost(GAINS)], settings=AT_ONCE)
    alone = quietly(model, runs, GAINS, settings=AT_ONCE)
    for one, beside, host in zip(alone, many[1], many[3], strict=True):
        np.testing.assert_allclose(beside.trajectory.values, one.trajectory.values, atol=1e-12)
        np.testing.assert_allclose(host.trajectory.values, one.trajectory.values, atol=1e-12)
    assert np.ptp([m[0].trajectory["q"][5] for m in many[:3]]) > 0.1


class Remembering:
    """A PI that keeps its integral in itself, and begins with what was given once."""

    measurements, measurement_units = ("q",), ("deg",)
    commands, command_units, interval = ("u0",), ("N",), 0.1

    def __init__(self):
        self.integral = 0.0

    def start(self, measurements, commands):
        return None

    def step(self, state, measurements, time):
        self.integral -= 0.05 * measurements[0]
        return None, [self.integral - 0.5 * measurements[0]]


def test_a_controller_that_keeps_its_state_in_itself_has_one_for_every_loop(model):
    runs = [run_of(model, x0=(x, 0.0), name=f"from {x:g}") for x in (1.0, -2.0, 3.0)]
    alone = [quietly(model, run, Remembering(), settings=AT_ONCE) for run in runs]
    used = Remembering()
    for law in (used, used, dfsm.Actuator(Remembering(), rate=np.inf)):
        for one, of_many in zip(alone, quietly(model, runs, law, settings=AT_ONCE), strict=True):
            np.testing.assert_array_equal(of_many.trajectory.values, one.trajectory.values)


def test_nothing_of_the_record_after_the_start_enters_but_disturbances(model):
    run = run_of(model, disturbed=1.0, commanded=0.3)
    values = run.values.copy()
    for name in ("q", "v", "u0"):
        values[1:, run.column(name)] += 5.0
    with pytest.warns(DfsmWarning, match="does not set u1: recorded values"):
        first = dfsm.closed_loop(model, run, GAINS, settings=AT_ONCE)
    second = quietly(model, replace(run, values=values), GAINS, settings=AT_ONCE)
    np.testing.assert_array_equal(first.trajectory.values, second.trajectory.values)
    np.testing.assert_array_equal(first.trajectory["u1"], run["u1"])


def test_a_controller_that_holds_is_an_open_loop_rollout_with_its_azimuth():
    turning = linear_model(
        A, B, C, D, names=["q", "v"], units=["rpm", "rpm/s"], azimuth=Azimuth(speed="q")
    )
    run = run_of(turning, disturbed=2.0, commanded=3.0)
    found = quietly(turning, run, _Constant(3.0), settings=AT_ONCE).trajectory
    rollout = dfsm.simulate(turning, run).trajectory
    np.testing.assert_allclose(found.select(rollout.names).values, rollout.values, atol=1e-12)
    # The output that a controller reads turns as the one that is written.
    reads = _Constant(3.0, ("y0",), ("kN",))
    loop = dfsm.prepare_loop(turning, [run], reads, settings=AT_ONCE)
    seen = np.asarray(loop(reads).measurements)[0, 1 : len(TIME), 0]
    np.testing.assert_allclose(seen, rollout["y0"][1:], atol=1e-12)


class _Constant(eqx.Module):
    value: float
    measurements: tuple[str, ...] = eqx.field(static=True, default=("q",))
    measurement_units: tuple[str, ...] = eqx.field(static=True, default=("rpm",))
    commands: tuple[str, ...] = eqx.field(static=True, default=("u0",))
    command_units: tuple[str, ...] = eqx.field(static=True, default=("N",))
    interval: float = eqx.field(static=True, default=0.1)

    def start(self, measurements: Any, commands: Any) -> Any:
        return 0

    def step(self, state: Any, measurements: Any, time: Any) -> Any:
        return state + 1, jnp.array([self.value])


def test_measurements_come_in_the_controllers_units_with_derivatives_of_states(model):
    reads = _Constant(
        2.0, ("q", "q̇", "acceleration", "y0", "u0"), ("rad", "rad/s", "deg/s^2", "N", "kN")
    )
    reads = replace(reads, command_units=("kN",))
    names = {"q̇": "q_dot", "acceleration": "v_dot"}
    loop = dfsm.prepare_loop(model, [run_of(model)], reads, measurements=names, settings=AT_ONCE)
    path = loop(reads)
    x, seen = np.asarray(path.states)[0, :200], np.asarray(path.measurements)[0, :200]
    u = np.concatenate([[0.0], np.full(199, 2e3)])
    expected = np.stack(
        [
            np.deg2rad(x[:, 0]),
            np.deg2rad(x[:, 1]),
            x @ A[1] + 2 * u,
            1e3 * (x @ C[0] + 0.2 * u),
            u / 1e3,
        ],
        axis=1,
    )
    np.testing.assert_allclose(seen, expected, atol=1e-9, rtol=1e-12)


@pytest.mark.parametrize(("interval", "sampling"), [(0.2, 0.1), (0.03, 0.1)])
def test_controller_and_samples_may_have_different_intervals(model, interval, sampling):
    run = run_of(model, np.arange(0, 6 + 1e-9, sampling))
    found = quietly(model, run, replace(GAINS, interval=interval), settings=FINE).trajectory
    steps = exact(GAINS.k, round(6 / interval) + 1, interval)
    at = np.arange(len(steps)) * interval
    both = np.isclose(np.subtract.outer(found.time, at), 0, atol=1e-9)
    assert both.sum() > 15
    rows, calls = np.nonzero(both)
    np.testing.assert_allclose(found["q"][rows], steps[calls, 0], atol=1e-7)


def test_gains_have_exact_gradients_and_map(model):
    loop = dfsm.prepare_loop(
        model, [run_of(model), run_of(model, TIME[:150])], GAINS, settings=AT_ONCE
    )

    def cost(k):
        path = loop(replace(GAINS, k=k))
        return (
            loop.mean(path.states[..., 0] ** 2) + 0.1 * loop.mean(path.controls[..., 0] ** 2)
        ).sum()

    slope, e = jax.jit(jax.grad(cost))(GAINS.k), 1e-6
    ways = np.eye(2)[:, None]
    tried = jnp.stack([GAINS.k + s * e * way for way in ways for s in (1, -1)])
    mapped = jax.jit(jax.vmap(cost))(tried)
    np.testing.assert_allclose(
        np.asarray(slope)[0], (mapped[::2] - mapped[1::2]) / (2 * e), rtol=1e-6
    )
    # The mean is over the run, without what was padded.
    short = quietly(model, run_of(model, TIME[:150]), GAINS, settings=AT_ONCE).trajectory["q"]
    assert loop.mean(loop(GAINS).states[..., 0] ** 2)[1] == pytest.approx((short**2).mean())


def test_the_start_up_is_not_scored(model):
    run = run_of(model)
    settings = dfsm.ClosedLoopSettings(start_up=4.0)
    whole = quietly(model, run, GAINS, settings=AT_ONCE).trajectory
    for start, first in ((None, 4.0), (10.0, 10.0), (1.0, 4.0)):
        found = quietly(model, run, GAINS, start=start, settings=settings).trajectory
        assert found.time[0] == pytest.approx(first)
        assert found.time[-1] == pytest.approx(20.0)
    np.testing.assert_allclose(found.values, whole.window(4.0).values, atol=1e-12)
    with pytest.raises(DfsmError, match=r"0 to 3 s, not longer than the start-up of 4 s"):
        quietly(model, run.window(0, 3.0), GAINS, settings=settings)


def test_a_loop_that_is_unstable_or_without_numbers_is_told(model):
    run = run_of(model)
    found = quietly(model, run, replace(GAINS, k=-40 * GAINS.k), settings=AT_ONCE)
    assert re.search(r"v reached .* deg/s at .* s; the loop is unstable", found.message)
    assert found.status is dfsm.LoopStatus.UNSTABLE
    assert found.trajectory.time[-1] == pytest.approx(found.ended, abs=0.1)
    for law in (_Fails(GAINS.k), OnHost(_Fails(GAINS.k))):
        found = quietly(model, run, law, settings=AT_ONCE)
        assert found.status is dfsm.LoopStatus.CONTROLLER_FAILED
        assert found.reason == "u0 is nan at 3 s"
        assert found.ended == pytest.approx(3.0)


class _Fails(Feedback):
    def step(self, state: Any, measurements: Any, time: Any) -> Any:
        _, command = super().step(state, measurements, time)
        return state, jnp.where(time > 2.95, jnp.nan, command)


def test_what_does_not_fit_is_told_in_one_sentence(model):
    run = run_of(model)
    for law, names, sentence in (
        (replace(GAINS, measurements=("q", "NcIMURAys")), {}, r"'NcIMURAys' among its outputs, or"),
        (replace(GAINS, measurements=("q", "b")), {"b": "w"}, r"no 'w' to stand for 'b'"),
        (GAINS, {"speed": "q"}, r"does not read 'speed'"),
        (
            replace(GAINS, commands=("u9",)),
            {},
            r"sets 'u9', which is no control of the model; known are: u0, u1",
        ),
        (replace(GAINS, measurement_units=("rpm", "deg/s")), {}, r"'q' is in 'deg' .* 'rpm'"),
        (_Raises(GAINS.k), {}, r"controller's step fails with KeyError: 'mine'"),
        (OnHost(_Raises(GAINS.k)), {}, r"controller's step at 0 s fails with KeyError: 'mine'"),
        (OnHost(_Long(GAINS.k)), {}, r"commands of shape \(2,\), expected \(1,\)"),
        (_Bad(GAINS.k), {}, r"state of shapes \[\] into one of \[\(2,\)\]"),
    ):
        with pytest.raises(DfsmError, match=sentence):
            quietly(model, run, law, measurements=names, settings=AT_ONCE)


class _Raises(Feedback):
    def step(self, state: Any, measurements: Any, time: Any) -> Any:
        raise KeyError("mine")


class _Long(Feedback):
    def step(self, state: Any, measurements: Any, time: Any) -> Any:
        return state, jnp.zeros(2)


class _Bad(Feedback):
    def step(self, state: Any, measurements: Any, time: Any) -> Any:
        return measurements, super().step(state, measurements, time)[1]


def test_a_pi_controller_takes_over_without_a_jump_and_holds_its_setpoint(model):
    run = run_of(model, np.arange(0, 60.01, 0.1), commanded=1.5)
    pi = PID(
        kp=0.4, ki=0.6, setpoint=0.9, measurements=["q"], measurement_units=["deg"],
        commands=["u0"], command_units=["N"], interval=0.1,
    )  # fmt: skip
    found = quietly(model, run, pi, settings=AT_ONCE).trajectory
    assert found["u0"][0] == pytest.approx(1.5)
    assert found["q"][-1] == pytest.approx(0.9, abs=1e-5)


class _Thermostat(Feedback):
    """Sets a heater to 20 °C and two degrees more for each that is missing to 30 °C."""

    unit: tuple[float, float] = eqx.field(static=True, default=(1.0, 0.0))

    def step(self, state: Any, measurements: Any, time: Any) -> Any:
        scale, zero = self.unit
        return state, jnp.array([(80.0 - 2 * (measurements[0] - zero) / scale) * scale + zero])


@pytest.mark.parametrize("host", [False, True])
def test_temperatures_keep_the_zero_of_their_unit_in_a_loop(host):
    # T' = -0.05 (T - u0), both in degC: T settles where T = u0 = 20 + 2 (30 - T).
    pulls = (np.array([[-0.05]]), np.array([[0.05, 0.0]]))
    heated = linear_model(*pulls, names=["T"], units=["degC"])
    controls = (replace(heated.signals.controls[0], unit="degC"), heated.signals.controls[1])
    heated = replace(heated, signals=replace(heated.signals, controls=controls))
    run = run_of(heated, np.arange(0, 200.1, 0.5), x0=(25.0,), commanded=25.0)
    for name, unit in (("degC", (1.0, 0.0)), ("K", (1.0, 273.15)), ("degF", (1.8, 32.0))):
        units = {"measurement_units": (name,), "command_units": (name,)}
        law: Any = replace(_Thermostat(jnp.zeros(1)), measurements=("T",), unit=unit, **units)
        found = quietly(heated, run, OnHost(law) if host else law, settings=AT_ONCE).trajectory
        assert found["T"][-1] == pytest.approx(80 / 3, abs=1e-4)
        assert found["u0"][-1] == pytest.approx(80 / 3, abs=1e-3)

"""Rollouts against solve_ivp and closed forms, and how they end."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, PPoly
from scipy.linalg import expm

from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.models.corrective import GaussianUnits
from dfsm.models.signals import Azimuth
from dfsm.simulation import integrate
from dfsm.simulation.simulate import Simulation, SimulationSettings, Status, simulate
from systems import OSCILLATOR_A, driving_run, linear_model, wander

B = np.array([[0.0], [2.0]])
CENTRES = np.random.default_rng(0).normal(size=(5, 3))
WEIGHTS = np.random.default_rng(1).normal(size=(5, 1))
BUMPS = GaussianUnits(
    shift=jnp.zeros(3),
    scale=jnp.full(3, 2.0),
    centres=jnp.asarray(CENTRES.T),
    weights=jnp.asarray(WEIGHTS.T),
    bias=jnp.zeros(1),
)
C = np.array([[1.0, 2.0]])
MODEL = linear_model(OSCILLATOR_A, B, C, np.array([[0.5]]), corrective=BUMPS)
X0 = np.array([0.5, -0.3])


def slope(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The same f written down in NumPy."""
    z = np.array([*u, *x]) / 2.0
    e = np.exp(-((CENTRES - z) ** 2).sum(1)) @ WEIGHTS
    return OSCILLATOR_A @ x + B @ u + np.array([0.0, e[0]])


def reference(time: np.ndarray, drive) -> np.ndarray:
    """Solve interval by interval, so that no step crosses a kink of the inputs."""
    states = [X0]
    for a, b in pairwise(time):
        found = solve_ivp(
            lambda t, x: slope(x, drive(t)), (a, b), states[-1], rtol=1e-11, atol=1e-12
        )
        states.append(found.y[:, -1])
    return np.array(states)


def inputs_at(time: np.ndarray, seed: int = 0) -> np.ndarray:
    return wander(np.random.default_rng(seed), 0.5, 3.0, 2.0)(time)[:, None]


def recorded(time: np.ndarray, seed: int = 0, model=MODEL) -> Trajectory:
    states = np.tile(X0, (len(time), 1))
    return driving_run(model, time, inputs_at(time, seed), states, f"run{seed}")


def states_of(result: Simulation) -> np.ndarray:
    return result.trajectory.values[:, :2]


def error(time: np.ndarray, truth: np.ndarray, **options) -> float:
    result = simulate(MODEL, recorded(time), settings=SimulationSettings(**options))
    assert result.status is Status.COMPLETED
    np.testing.assert_array_equal(result.trajectory.time, time)
    return float(np.abs(states_of(result) - truth).max())


EVEN = np.linspace(0, 12, 61)
IRREGULAR = np.sort(np.concatenate([[0, 12], np.random.default_rng(2).uniform(0, 12, 70)]))


@pytest.fixture(scope="module", params=["even", "irregular"])
def solved(request):
    time = EVEN if request.param == "even" else IRREGULAR
    u = inputs_at(time)[:, 0]
    return time, reference(time, lambda t: np.array([np.interp(t, time, u)]))


# -- accuracy -----------------------------------------------------------------------------------


def test_rk4_is_accurate_and_of_fourth_order(solved):
    time, truth = solved
    errors = [error(time, truth, step=h) for h in (0.2, 0.1, 0.05, 0.025)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 1e-6
    # An irregular mesh divides its longest interval, so that halving the step is not exact.
    assert ((orders > 3.3) & (orders < 5.0)).all(), (errors, orders)


def test_adaptive_methods_meet_their_tolerance():
    u = inputs_at(IRREGULAR)[:, 0]
    truth = reference(IRREGULAR, lambda t: np.array([np.interp(t, IRREGULAR, u)]))
    loose = error(IRREGULAR, truth, method="tsit5", rtol=1e-4, atol=1e-6)
    tight = error(IRREGULAR, truth, method="tsit5", rtol=1e-9, atol=1e-11)
    stiff = error(IRREGULAR, truth, method="kvaerno5", rtol=1e-8, atol=1e-10)
    assert tight < 1e-6
    assert stiff < 1e-5
    assert tight < loose < 1e-2


# ẋ = -x + u: between two samples x follows from the polynomial that u is there, exactly.
LAG = linear_model(np.array([[-1.0]]), np.array([[1.0]]))


def lagged(time: np.ndarray, u: np.ndarray, interpolation: str) -> np.ndarray:
    """Exact ẋ = -x + u from rest, for the spline through the samples or the line between them."""
    if interpolation == "cubic":
        pieces = CubicSpline(time, u)
    else:
        pieces = PPoly(np.stack([np.diff(u) / np.diff(time), u[:-1]]), time)

    def particular(t: np.ndarray) -> np.ndarray:
        """u - u̇ + ü - ... at times since the sample before, one in each piece."""
        return sum((-1) ** k * np.polyval(pieces.derivative(k).c, t) for k in range(4))

    steps = np.diff(time)
    x = [0.0]
    # What is not of the particular solution decays.
    for begin, end, left in zip(
        particular(0 * steps), particular(steps), np.exp(-steps), strict=True
    ):
        x.append(end + (x[-1] - begin) * left)
    return np.array(x)


def lag_error(time: np.ndarray, u: np.ndarray, **options) -> float:
    """Largest error of a rollout of the lag from rest."""
    run = driving_run(LAG, time, u[:, None], np.zeros((len(time), 1)))
    result = simulate(LAG, run, settings=SimulationSettings(**options))
    assert result.status is Status.COMPLETED
    truth = lagged(time, u, options["interpolation"])
    return float(np.abs(result.trajectory.values[:, 0] - truth).max())


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_all_methods_agree_on_the_inputs_between_samples(interpolation):
    time = np.cumsum(np.random.default_rng(3).uniform(0.1, 0.9, 40))
    u = np.random.default_rng(4).normal(size=40)
    tight = {"rtol": 1e-10, "atol": 1e-12, "interpolation": interpolation}
    assert lag_error(time, u, method="rk4", step=0.01, interpolation=interpolation) < 1e-9
    assert lag_error(time, u, method="tsit5", **tight) < 1e-9
    # An implicit step is solved for to no more than the tolerance.
    assert lag_error(time, u, method="kvaerno5", **tight) < 1e-7


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("method", ["tsit5", "kvaerno5"])
def test_a_pulse_in_the_middle_of_a_long_rest_is_not_stepped_over(method, interpolation):
    time = np.arange(0, 2000, 0.1)
    u = np.where(abs(time - 1234) < 0.5, np.cos(np.pi * (time - 1234)) ** 2, 0.0)
    assert lagged(time, u, interpolation).max() > 0.3
    assert lag_error(time, u, method=method, interpolation=interpolation) < 1e-5


def test_a_step_ends_only_where_the_inputs_bend():
    time = np.arange(0, 100, 0.1)
    corner = np.stack([np.maximum(0, time - 33.3), 7 - 0.3 * time], axis=1)
    run = Trajectory(time, corner, (Channel("a"), Channel("b")))
    assert integrate.pieces_of(run, "linear").bends == pytest.approx([33.3])
    parabola = Trajectory(time, (time**2)[:, None], (Channel("a"),))
    assert len(integrate.pieces_of(parabola, "linear").bends) == len(time) - 2
    assert len(integrate.pieces_of(parabola, "cubic").bends) == 0


def test_outputs_follow_the_rollout():
    result = simulate(MODEL, recorded(EVEN))
    y = states_of(result) @ C[0] + 0.5 * inputs_at(EVEN)[:, 0]
    np.testing.assert_allclose(result.trajectory["y0"], y, rtol=1e-12, atol=1e-12)
    assert [c.role for c in result.trajectory.channels] == ["state", "state", "output"]
    assert result.trajectory.channel("y0").unit == "kN"


def test_cubic_inputs_follow_a_smooth_signal_better_than_linear_ones():
    time = np.linspace(0, 12, 41)
    true = reference(time, lambda t: inputs_at(np.array([t]))[0])
    linear = error(time, true, step=0.02, interpolation="linear")
    cubic = error(time, true, step=0.02, interpolation="cubic")
    assert cubic < linear / 5
    spline = CubicSpline(time, inputs_at(time)[:, 0])
    assert error(time, reference(time, lambda t: np.array([spline(t)])), step=0.01,
                 interpolation="cubic") < 1e-6  # fmt: skip


def test_a_batch_gives_what_single_runs_give():
    times = (EVEN, EVEN[:20], IRREGULAR, np.linspace(3, 40, 1500))
    runs = [recorded(t, seed) for seed, t in enumerate(times)]
    for result, run in zip(simulate(MODEL, runs), runs, strict=True):
        alone = simulate(MODEL, run)
        assert result.trajectory.name == run.name
        np.testing.assert_array_equal(result.trajectory.time, run.time)
        np.testing.assert_allclose(
            result.trajectory.values, alone.trajectory.values, rtol=1e-10, atol=1e-11
        )


def test_a_given_initial_state_replaces_the_recorded_one():
    run = recorded(EVEN).select(["u0"])
    result = simulate(MODEL, run, initial=X0)
    same = simulate(MODEL, recorded(EVEN))
    np.testing.assert_array_equal(result.trajectory.values, same.trajectory.values)


# -- stiffness, instability, range --------------------------------------------------------------

STIFF_A = np.array([[-2000.0, 1999.0], [0.0, -1.0]])


def stiff_run(model) -> Trajectory:
    time = np.linspace(0, 5, 101)
    return driving_run(model, time, np.zeros((101, 1)), np.tile([1.0, -1.0], (101, 1)))


def test_a_stiff_model_gets_shorter_steps_or_the_stiff_method_and_it_is_told():
    model = linear_model(STIFF_A, np.array([[0.0], [1.0]]))
    run = stiff_run(model)
    exact = np.array([expm(STIFF_A * t) @ [1.0, -1.0] for t in run.time])
    cut = r"steps of 0\.00075 s: 0\.05 s are too long .* 2e\+03 1/s"
    with pytest.warns(DfsmWarning, match=cut):
        explicit = simulate(model, run)
    faster = linear_model(2 * STIFF_A, np.array([[0.0], [1.0]]))
    with pytest.warns(DfsmWarning, match="integrated by kvaerno5: steps of 0.05 s are too long"):
        switched = simulate(faster, run)
    implicit = simulate(model, run, settings=SimulationSettings(method="kvaerno5"))
    assert not implicit.note
    twice = np.array([expm(2 * STIFF_A * t) @ [1.0, -1.0] for t in run.time])
    for result, truth in ((explicit, exact), (implicit, exact), (switched, twice)):
        assert result.status is Status.COMPLETED
        np.testing.assert_allclose(states_of(result), truth, rtol=0, atol=1e-4)


def test_steps_so_large_that_numbers_overflow_are_told():
    model = linear_model(1e60 * STIFF_A, np.array([[0.0], [1.0]]))
    with pytest.warns(DfsmWarning):
        result = simulate(model, stiff_run(model))
    assert result.status is not Status.COMPLETED
    hot = linear_model(np.array([[1e200, 0.0], [0.0, 1e200]]), np.array([[0.0], [1.0]]))
    with pytest.warns(DfsmWarning, match="no longer finite: use a smaller step or a stiff method"):
        result = simulate(hot, stiff_run(hot))
    assert result.status is Status.NOT_FINITE


def test_a_solver_that_gives_up_is_told(monkeypatch):
    monkeypatch.setattr(integrate, "_MAX_STEPS", 500)
    model = linear_model(STIFF_A, np.array([[0.0], [1.0]]), names=["hard", "soft"])
    with pytest.warns(DfsmWarning, match="the adaptive solver gave up"):
        result = simulate(model, stiff_run(model), settings=SimulationSettings(method="tsit5"))
    assert result.status is Status.SOLVER_FAILED
    assert np.isfinite(result.trajectory.values).all()
    assert 0.1 < result.ended < 1.5
    assert result.reason == f"no solution beyond {result.ended:g} s"


def test_an_unstable_model_stops_where_a_state_leaves_by_a_factor_of_ten():
    A = np.array([[0.5, 0.0], [0.0, -1.0]])
    model = linear_model(
        A, np.array([[0.0], [1.0]]), names=["speed", "pitch"], units=["rpm", "deg"], span=1.0
    )
    time = np.linspace(0, 30, 301)
    run = driving_run(model, time, np.zeros((301, 1)), np.tile([0.1, 0.1], (301, 1)), "storm")
    with pytest.warns(DfsmWarning, match=r"storm: speed reached 10\.\d+ rpm at 9\.3 s"):
        result = simulate(model, run)
    # 0.1 exp(t/2) = 10 at t = 9.21: the next sample is the first beyond.
    assert result.status is Status.LEFT_REGION
    assert 9.1 <= result.ended <= 9.3
    assert result.trajectory.time[-1] == result.ended
    assert "training range -1 to 1" in result.reason
    exact = 0.1 * np.exp(result.trajectory.time / 2)
    np.testing.assert_allclose(result.trajectory["speed"], exact, rtol=1e-6)


def test_the_share_outside_the_training_range_is_told():
    A = -np.eye(2)
    model = linear_model(A, np.array([[0.0], [1.0]]), span=1.0)
    time = np.linspace(0, 10, 101)
    u = np.where(time < 8, 0.0, 1.5)[:, None]
    run = driving_run(model, time, u, np.zeros((101, 2)), "gust")
    with pytest.warns(DfsmWarning, match=r"1 of 1 rollouts .* gust most \(20\.8%\)"):
        result = simulate(model, run)
    assert result.status is Status.COMPLETED
    np.testing.assert_allclose(result.outside, 21 / 101, rtol=1e-6)
    assert "20.8% of the time outside" in result.message


def test_inside_the_range_nothing_is_warned():
    assert simulate(MODEL, recorded(EVEN)).outside == 0  # any warning is an error here


# -- what drives a rollout ----------------------------------------------------------------------

SECOND = linear_model(OSCILLATOR_A, B, C, names=["q", "q_dot"], order=2)


def motion(model, tail: float | None = None, after: float = 0.0) -> Trajectory:
    """A run whose recorded states are something smooth, and something else after a time."""
    time = np.linspace(0, 60, 1201)
    q = np.stack([np.sin(time), np.cos(time)], axis=1)
    if tail is not None:
        q[time > after] = tail * np.random.default_rng(0).normal(
            size=(int((time > after).sum()), 2)
        )
    columns = q if model is MODEL else q[:, :1]
    return driving_run(model, time, inputs_at(time), columns)


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
@pytest.mark.parametrize(
    ("model", "start", "after"),
    [
        pytest.param(MODEL, None, 0.0, id="first order, from the start of the record"),
        pytest.param(MODEL, 30.0, 30.0, id="first order, with history"),
        pytest.param(SECOND, 30.0, 30.0, id="rates, with history"),
        pytest.param(SECOND, None, 1.01, id="rates, from the record's first second"),
    ],
)
def test_recorded_states_after_the_start_change_nothing(model, start, after):
    honest = simulate(model, motion(model), start=start)
    altered = simulate(model, motion(model, 5.0, after), start=start)
    np.testing.assert_array_equal(honest.trajectory.values, altered.trajectory.values)
    moved = simulate(model, motion(model, 5.0, after - 2.0), start=start) if start else None
    assert moved is None or (moved.trajectory.values != honest.trajectory.values).any()


def test_initial_rates_come_from_the_record():
    result = simulate(SECOND, motion(SECOND), start=30.0)
    # The last sample of a spline's record is where its derivative is least certain.
    np.testing.assert_allclose(result.trajectory["q"][0], np.sin(30.0), atol=1e-4)
    np.testing.assert_allclose(result.trajectory["q_dot"][0], np.cos(30.0), atol=2e-2)
    assert result.trajectory.time[0] == 30.0


def test_a_recorded_rate_is_used_as_it_stands():
    spec = replace(SECOND.signals.specs[0], rate="gyro")
    model = replace(SECOND, signals=replace(SECOND.signals, specs=(spec,)))
    time = np.linspace(0, 10, 201)
    values = np.stack([np.sin(time), 7 + time, inputs_at(time)[:, 0]], axis=1)
    run = Trajectory(time, values, (Channel("q", "m"), Channel("gyro"), Channel("u0", "N")))
    result = simulate(model, run, start=5.0)
    np.testing.assert_array_equal(result.trajectory.values[0, :2], [np.sin(5.0), 12.0])


# -- blade passing ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "factor", "method"),
    [
        ("rpm", np.pi / 30, "rk4"),
        ("rad/s", 1.0, "rk4"),
        ("deg/s", np.pi / 180, "rk4"),
        ("rpm", np.pi / 30, "tsit5"),
    ],
)
def test_azimuth_turns_with_the_speed(unit, factor, method):
    model = linear_model(
        np.zeros((1, 1)),
        np.array([[0.0]]),
        np.zeros((1, 1)),
        names=["speed"],
        units=[unit],
        azimuth=Azimuth(speed="speed", angle="psi"),
    )
    time = np.linspace(10, 40, 301)
    values = np.stack([np.full(301, 7.5), np.full(301, 0.0), np.full(301, 33.0)], axis=1)
    run = Trajectory(time, values, (Channel("speed", unit), Channel("u0"), Channel("psi", "deg")))
    result = simulate(model, run, settings=SimulationSettings(method=method))
    psi = np.deg2rad(33.0) + 7.5 * factor * (time - 10)
    np.testing.assert_allclose(result.trajectory["y0"], np.cos(3 * psi), rtol=0, atol=1e-9)


def test_azimuth_speed_must_be_a_rotational_speed_among_the_states():
    model = linear_model(
        np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), names=["speed"], units=["m"],
        azimuth=Azimuth(speed="speed"),
    )  # fmt: skip
    run = driving_run(model, EVEN, np.zeros((61, 1)), np.ones((61, 1)))
    with pytest.raises(DfsmError, match="'speed' is in 'm', expected one of rpm, rad/s, deg/s"):
        simulate(model, run)
    wrong = replace(model, signals=replace(model.signals, azimuth=Azimuth(speed="sped")))
    with pytest.raises(DfsmError, match="'sped', which is not a state; did you mean 'speed'"):
        simulate(wrong, run)


# -- bad input ----------------------------------------------------------------------------------


def test_bad_runs_are_refused():
    run = recorded(EVEN)
    with pytest.raises(DfsmError, match="no runs were given to simulate"):
        simulate(MODEL, [])
    with pytest.raises(DfsmError, match=r"runs/run0\.csv: runs from 0 s to 12 s, shorter than"):
        simulate(MODEL, run, start=20.0)
    with pytest.raises(DfsmError, match=r"runs/run0\.csv: no channel 'u0'; did you mean 'u00'"):
        simulate(MODEL, replace(run, channels=(*run.channels[:2], Channel("u00"))))
    for column, name in ((2, "u0"), (0, "x0")):
        values = run.values.copy()
        values[0, column] = np.nan
        with pytest.raises(DfsmError, match=f"channel '{name}' has 1 NaN or infinite"):
            simulate(MODEL, replace(run, values=values))


def test_bad_settings_are_refused():
    with pytest.raises(DfsmError, match=r"initial has shape \(3,\), expected \(2,\) or \(1, 2\)"):
        simulate(MODEL, recorded(EVEN), initial=[1.0, 2.0, 3.0])
    for step in (0.0, -0.1, np.nan):
        with pytest.raises(DfsmError, match="simulation step"):
            SimulationSettings(step=step)


def test_more_steps_than_memory_holds_are_refused(monkeypatch):
    run = recorded(np.sort(np.append(EVEN, [0.03, 0.05])))  # the longest of 62 intervals is 0.2 s
    monkeypatch.setattr(integrate, "_MOST_STEPS", 1000)
    with pytest.raises(DfsmError, match=r"of 0\.0001 s over 12 s make 1.24e\+05 steps") as caught:
        simulate(MODEL, run, settings=SimulationSettings(step=1e-4))
    allowed = float(re.search(r"at least (\S+) s", str(caught.value))[1])
    assert integrate.mesh_of(run, allowed, "linear").steps <= 1000
    with pytest.raises(DfsmError, match="a shorter time window"):
        integrate.mesh_of(run, 0.9 * allowed, "linear")
    assert integrate.mesh_of(run, None, "linear").steps == 62
    # A run that has more samples than that is nothing that a step could change.
    monkeypatch.setattr(integrate, "_MOST_STEPS", 10)
    assert integrate.mesh_of(run, None, "linear").steps == 62
    with pytest.raises(DfsmError, match=r"at least 0\.202 s"):
        integrate.mesh_of(run, 0.1, "linear")


def test_a_simulation_prints_in_one_line():
    result = simulate(MODEL, recorded(EVEN))
    assert repr(result) == (
        "<Simulation of run0: completed, 0 to 12 s, 61 samples; "
        f"{result.outside:.1%} of the time outside the training range>"
    )

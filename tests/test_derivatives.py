from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from dfsm.data.derivatives import (
    DerivativeSettings,
    Filter,
    StateSpec,
    differentiate,
    kinematic_rows,
    state_names,
    state_units,
)
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.numerics.filters import low_pass, moving_average
from motion import TIME, error, motion, quantised

ROOT = Path(__file__).parents[1]


def trajectory(time=TIME, **extra):
    q, rate, acceleration = motion(time)
    columns = {
        "q": (q, "deg"),
        "qd": (rate, "deg/s"),
        "qdd": (acceleration, "deg/s^2"),
        "speed": (np.cos(0.3 * time), "rpm"),
        **extra,
    }
    channels = tuple(Channel(n, unit) for n, (_, unit) in columns.items())
    return Trajectory(time, np.stack([v for v, _ in columns.values()], axis=1), channels, "run7")


# -- filters --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "apply", [lambda t, y: moving_average(t, y, 2.0), lambda t, y: low_pass(t, y, 0.5)]
)
def test_filters_shift_nothing_and_keep_the_mean(apply):
    pulse = np.zeros(801)
    pulse[400] = 1.0
    response = apply(TIME[:801], pulse)
    np.testing.assert_allclose(response, response[::-1], atol=1e-12)
    assert response.sum() == pytest.approx(1, rel=1e-6)
    np.testing.assert_allclose(apply(TIME[:801], np.full(801, 5.0)), 5.0)


def test_moving_average_attenuates_as_a_sinc():
    window = 2.0
    for f in (0.1, 0.25, 0.8):
        y = np.sin(2 * np.pi * f * TIME)
        inner = slice(30, -30)
        expected = np.sinc(f * window) * y
        np.testing.assert_allclose(
            moving_average(TIME, y, window)[inner], expected[inner], atol=6e-3
        )


def test_moving_average_on_an_irregular_mesh_keeps_straight_lines():
    t = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.2, 500))
    np.testing.assert_allclose(moving_average(t, 3 * t - 7, 2.0), 3 * t - 7, atol=1e-9)


def test_low_pass_attenuates_as_a_butterworth_run_twice():
    cutoff, rate = 0.5, 20.0
    for f in (0.1, 0.5, 1.0):
        y = np.sin(2 * np.pi * f * TIME)
        ratio = np.tan(np.pi * f / rate) / np.tan(np.pi * cutoff / rate)
        expected = y / (1 + ratio**8)
        np.testing.assert_allclose(
            low_pass(TIME, y, cutoff)[400:-400], expected[400:-400], atol=1e-4
        )


def test_filters_in_differentiate_remove_a_vibration_and_keep_the_motion():
    q, rate, acceleration = motion(TIME)
    shaken = trajectory(shaken=(q + 0.01 * np.sin(2 * np.pi * 3 * TIME), "deg"))
    for chosen in (
        Filter(kind="low_pass", cutoff=0.8),
        Filter(kind="moving_average", window=2 / 3),
    ):
        found = differentiate(
            shaken,
            [StateSpec(name="shaken", order=2)],
            DerivativeSettings(filters={"shaken": chosen}),
        )
        inner = slice(100, -100)
        assert error(found.derivatives[inner, 0], rate[inner]) < 0.03
        assert error(found.derivatives[inner, 1], acceleration[inner]) < 0.05
        # The derivative of the state is the state that holds it, at the ends too.
        np.testing.assert_array_equal(found.derivatives[:, 0], found.trajectory["shaken_dot"])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Filter(kind="low_pass", window=2.0), "takes a cutoff and no window"),
        (lambda: Filter(kind="moving_average"), "takes a window and no cutoff"),
        (lambda: Filter(kind="low_pass", cutoff=1.0, window=2.0), "takes a cutoff and no window"),
        (lambda: Filter(kind="low_pass", cutoff=-1.0), "cutoff=-1.0: give a positive one"),
        (
            lambda: Filter(kind="lowpass", cutoff=1.0),
            "no filter 'lowpass'; did you mean 'low_pass'",
        ),
        (lambda: low_pass(TIME**1.1, TIME, 1.0), "needs an equidistant mesh"),
        (lambda: low_pass(TIME, TIME, 10.0), "Nyquist frequency 10 Hz"),
        (lambda: moving_average(TIME, TIME, 500.0), "over 500 s does not fit a record of 200 s"),
        (lambda: DerivativeSettings(method="cubicspline"), "did you mean 'cubic_spline'"),
        (lambda: StateSpec(name="q", order=3), "has order 3: give 1 or 2"),
        (lambda: StateSpec(name="q", acceleration="qdd"), "has no use for the acceleration"),
        (lambda: state_names([]), "no states were given"),
        (lambda: state_names([StateSpec(name="q"), StateSpec(name="q")]), "'q' was given twice"),
    ],
)
def test_wrong_settings_are_sentences(make, message):
    with pytest.raises(DfsmError, match=message):
        make()


# -- differentiate --------------------------------------------------------------------------------


def test_order_names_units_and_columns_are_the_papers():
    states = [StateSpec(name="q", order=2), StateSpec(name="speed")]
    run = trajectory()
    assert state_names(states) == ("q", "speed", "q_dot")
    assert state_units(states, run) == ("deg", "rpm", "deg/s")
    assert kinematic_rows(states) == {0: 2}
    both = [StateSpec(name="q", order=2), StateSpec(name="speed", order=2)]
    assert state_names(both) == ("q", "speed", "q_dot", "speed_dot")
    assert kinematic_rows(both) == {0: 2, 1: 3}
    assert kinematic_rows([StateSpec(name="q")]) == {}

    found = differentiate(run, states)
    assert found.names == ("q", "speed", "q_dot")
    assert found.derivative_names == ("q_dot", "speed_dot", "q_ddot")
    assert found.derivative_units == ("deg/s", "rpm/s", "deg/s^2")
    assert found.trajectory.names == (*run.names, "q_dot")
    assert found.trajectory.channel("q_dot").unit == "deg/s"
    assert len(found.noise_std) == 3
    _, rate, acceleration = motion(TIME)
    np.testing.assert_allclose(found.derivatives[:, 0], rate, atol=1e-6)
    np.testing.assert_allclose(found.derivatives[:, 1], -0.3 * np.sin(0.3 * TIME), atol=1e-6)
    np.testing.assert_allclose(found.derivatives[:, 2], acceleration, atol=1e-4)
    for row, column in kinematic_rows(states).items():
        np.testing.assert_array_equal(
            found.derivatives[:, row], found.trajectory[found.names[column]]
        )


def test_the_step_of_the_channel_sets_the_noise_and_the_smoothed_state_replaces_it():
    q, _, _ = motion(TIME)
    step = 1e-3
    data = quantised(q, step)
    run = Trajectory(TIME, data[:, None], (Channel("q", "deg", step=step),))
    found = differentiate(run, [StateSpec(name="q", order=2)])
    assert found.noise_std == (pytest.approx(step / np.sqrt(12)), None)
    assert np.std(found.trajectory["q"] - q) < 0.5 * np.std(data - q)
    assert found.trajectory.channel("q").step is None
    np.testing.assert_array_equal(run["q"], data)

    cubic = differentiate(run, [StateSpec(name="q")], DerivativeSettings(method="cubic_spline"))
    np.testing.assert_array_equal(cubic.derivatives[:, 0], CubicSpline(TIME, data)(TIME, 1))
    np.testing.assert_array_equal(cubic.trajectory["q"], data)
    assert cubic.noise_std == (None,)


def test_recorded_rates_and_accelerations_are_used_on_request():
    marker = 0.01 * np.sin(5 * TIME)
    _, rate, acceleration = motion(TIME)
    run = trajectory(
        rec=(rate + marker, "deg/sec"), rec2=(acceleration - marker, "deg/s2"), bare=(rate, "")
    )
    found = differentiate(run, [StateSpec(name="q", rate="rec")])
    np.testing.assert_array_equal(found.derivatives[:, 0], run["rec"])
    found = differentiate(run, [StateSpec(name="q", order=2, rate="rec", acceleration="rec2")])
    np.testing.assert_array_equal(found.derivatives, np.stack([run["rec"], run["rec2"]], axis=1))
    np.testing.assert_array_equal(found.trajectory["q_dot"], run["rec"])
    found = differentiate(run, [StateSpec(name="q", order=2, rate="rec")])
    np.testing.assert_allclose(
        found.derivatives[:, 1], acceleration + 0.05 * np.cos(5 * TIME), atol=1e-3
    )
    found = differentiate(run, [StateSpec(name="q", order=2, acceleration="rec2")])
    np.testing.assert_allclose(found.derivatives[:, 0], rate, atol=1e-6)
    np.testing.assert_array_equal(found.derivatives[:, 1], run["rec2"])
    # A channel without a unit cannot be compared.
    differentiate(run, [StateSpec(name="q", rate="bare")])
    # A linear state has a constant derivative, which is no error.
    linear = trajectory(ramp=(2 * TIME, "m"), two=(np.full_like(TIME, 2), "m/s"))
    assert (differentiate(linear, [StateSpec(name="ramp", rate="two")]).derivatives == 2).all()


def test_units_follow_the_state():
    run = trajectory(
        v=(motion(TIME)[0], "m/s"), a=(motion(TIME)[1], "m/s²"), j=(motion(TIME)[2], "m/s/s/s")
    )
    found = differentiate(run, [StateSpec(name="v", order=2, rate="a", acceleration="j")])
    assert found.derivative_units == ("m/s^2", "m/s^3")


@pytest.mark.parametrize(
    ("states", "filters", "message"),
    [
        ([StateSpec(name="qq")], {}, "run7: no channel 'qq'; did you mean"),
        ([StateSpec(name="q", rate="qe")], {}, "run7: no channel 'qe'"),
        ([StateSpec(name="q", rate="qdd")], {}, r"'deg/s\^2' is not the first derivative of 'q'"),
        (
            [StateSpec(name="q", order=2, acceleration="qd")],
            {},
            "is not the second derivative .* a channel in 'deg/s.2' is expected",
        ),
        ([StateSpec(name="holes")], {}, "channel 'holes' has 2 NaN or infinite samples"),
        ([StateSpec(name="taken", order=2)], {}, "there is a channel 'taken_dot' already"),
        (
            [StateSpec(name="q")],
            {"speed": Filter(kind="moving_average", window=1.0)},
            "a filter was given for 'speed', which is no state",
        ),
        (
            [StateSpec(name="q")],
            {"q": Filter(kind="low_pass", cutoff=30.0)},
            "run7: channel 'q': a low_pass cutoff of 30 Hz",
        ),
    ],
)
def test_what_differentiate_refuses(states, filters, message):
    holes = TIME.copy()
    holes[[3, 9]] = np.nan
    run = trajectory(
        flat=(np.ones_like(TIME), "m"),
        still=(np.zeros_like(TIME), "deg/s"),
        holes=(holes, "m"),
        taken=(TIME**2, "m"),
        taken_dot=(TIME, "m/s"),
    )
    with pytest.raises(DfsmError, match=message):
        differentiate(run, states, DerivativeSettings(filters=filters))


def test_a_short_run_is_named():
    with pytest.raises(DfsmError, match="run7: channel 'q': 5 samples are too few"):
        differentiate(trajectory(TIME[:5]), [StateSpec(name="q")])


# -- real runs ------------------------------------------------------------------------------------


def test_recorded_platform_derivatives_are_recovered_from_16_bit_pitch():
    benchmark = runpy.run_path(str(ROOT / "benchmarks" / "derivatives.py"))
    result = benchmark["run"](ROOT / "examples" / "iea15", "*mps_s09.outb")
    assert len(result["runs"]) == 3
    for method in ("dfsm_default", "dfsm_cross_validation"):
        assert result["worst"][method]["rate"] < 0.2
        assert result["worst"][method]["acceleration"] < 5
        assert result["mean"][method]["acceleration"] < 4
    # The paper's interpolating spline cannot do it, and that is worth knowing.
    assert result["mean"]["paper_cubic"]["acceleration"] > 50
    for what in ("rate", "acceleration"):
        assert result["mean"]["dfsm_default"][what] < result["mean"]["scipy_quintic"][what]

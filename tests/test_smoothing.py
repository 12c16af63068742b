from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import BSpline, CubicSpline

from dfsm.data.derivatives import cubic_spline, smoothing_spline
from dfsm.errors import DfsmError
from dfsm.numerics.smoothing import _Mesh
from motion import TIME, error, motion, quantised

# -- cubic spline ---------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(st.lists(st.floats(-3, 3), min_size=4, max_size=4), st.integers(8, 60), st.integers(0, 99))
def test_cubic_spline_is_exact_on_cubics(coefficients, n, seed):
    t = np.cumsum(np.random.default_rng(seed).uniform(0.5, 1.5, n)) / n
    p = np.polynomial.Polynomial(coefficients)
    values, first, second = cubic_spline(t, p(t))
    np.testing.assert_array_equal(values, p(t))
    np.testing.assert_allclose(first, p.deriv()(t), atol=1e-9)
    np.testing.assert_allclose(second, p.deriv(2)(t), atol=1e-6)


def test_cubic_spline_converges_with_orders_three_and_two():
    errors = []
    for n in (101, 201, 401):
        t = np.linspace(0, 10, n)
        _, first, second = cubic_spline(t, np.sin(t))
        errors.append([abs(first - np.cos(t)).max(), abs(second + np.sin(t)).max()])
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    assert order[:, 0].min() > 2.8
    assert order[:, 1].min() > 1.8


# -- smoothing spline -----------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.integers(8, 300), st.integers(0, 99))
def test_parabolas_are_exact_with_and_without_a_step(coefficients, n, seed):
    t = np.cumsum(np.random.default_rng(seed).uniform(0.5, 1.5, n)) / n
    p = np.polynomial.Polynomial(coefficients)
    for step in (None, 1e-3):
        result = smoothing_spline(t, p(t), step)
        # Values round to a part of the largest coefficient.
        scale = max(np.abs(p(t)).max(), *np.abs(coefficients), 1e-12)
        np.testing.assert_allclose(result.values, p(t), atol=1e-7 * scale)
        np.testing.assert_allclose(result.first, p.deriv()(t), atol=1e-5 * scale)
        np.testing.assert_allclose(result.second, p.deriv(2)(t), atol=1e-3 * scale)


def test_clean_data_is_differentiated_better_than_by_the_cubic_and_with_higher_order():
    errors = []
    for n in (101, 201, 401):
        t = np.linspace(0, 10, n)
        result = smoothing_spline(t, np.sin(2 * t))
        errors.append(abs(result.second + 4 * np.sin(2 * t)).max())
        assert errors[-1] < abs(cubic_spline(t, np.sin(2 * t))[2] + 4 * np.sin(2 * t)).max()
        assert result.chosen_by == "interpolation"
    assert np.log2(errors[0] / errors[1]) > 3
    assert np.log2(errors[1] / errors[2]) > 3


@pytest.mark.parametrize("quanta", [100, 1000, 30000])
def test_quantised_signal_is_recovered(quanta):
    q, rate, acceleration = motion(TIME)
    step = 1 / quanta
    data = quantised(q, step)
    known = smoothing_spline(TIME, data, step)
    assert known.chosen_by == "noise level"
    assert known.noise_std == pytest.approx(step / np.sqrt(12))
    inner = slice(40, -40)
    assert error(known.first, rate) < 0.01
    assert error(known.second, acceleration) < 0.05
    assert error(known.second[inner], acceleration[inner]) < 0.03 * error(
        CubicSpline(TIME, data)(TIME, 2)[inner], acceleration[inner]
    )
    unknown = smoothing_spline(TIME, data)
    assert unknown.chosen_by == "cross-validation"
    assert unknown.noise_std == pytest.approx(known.noise_std, rel=0.1)
    assert error(unknown.second, acceleration) < 0.05
    assert error(unknown.values, known.values) < 2e-2 / quanta**0.5


def test_the_step_keeps_a_coarse_staircase_from_being_followed():
    # Rounding errors of 20 steps per amplitude are far from white: cross-validation fails.
    q, rate, acceleration = motion(TIME)
    known = smoothing_spline(TIME, quantised(q, 0.05), 0.05)
    assert error(known.first, rate) < 0.03
    assert error(known.second, acceleration) < 0.08


def test_noise_beyond_the_step_is_found():
    rng = np.random.default_rng(3)
    q, rate, _ = motion(TIME)
    result = smoothing_spline(TIME, q + rng.normal(0, 0.02, len(q)), 1e-4)
    assert result.chosen_by == "cross-validation"
    assert result.noise_std == pytest.approx(0.02, rel=0.05)
    assert error(result.first, rate) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_a_long_plateau_at_the_noise_level_is_not_missed(seed):
    rng = np.random.default_rng(seed)
    slow = np.sin(0.2 * TIME)
    result = smoothing_spline(TIME, slow + rng.uniform(-0.05, 0.05, len(TIME)), 0.1)
    assert result.chosen_by == "noise level"
    assert result.degrees_of_freedom < 100
    assert error(result.second, -0.04 * slow) < 0.15


@pytest.mark.parametrize("step", [None, 1e-3])
def test_irregular_mesh(step):
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.2, 1.8, 3000)) * 0.05
    q, rate, acceleration = motion(t)
    result = smoothing_spline(t, q if step is None else quantised(q, step), step)
    assert error(result.first, rate) < (1e-7 if step is None else 0.005)
    assert error(result.second, acceleration) < (1e-5 if step is None else 0.03)


def test_clustered_samples_neither_fail_nor_spoil_the_fit():
    t = np.unique(np.r_[np.linspace(0, 100, 1500), 40 + np.linspace(0.0101, 0.0202, 200)])
    q, rate, acceleration = motion(t)
    clean = smoothing_spline(t, q)
    assert error(clean.second, acceleration) < 1e-4
    noisy = smoothing_spline(t, quantised(q, 1e-3), 1e-3)
    assert error(noisy.first, rate) < 0.01
    assert error(noisy.second, acceleration) < 0.08


def test_the_ends_stay_tame():
    # The third derivative is pulled to zero at the ends, so the second levels off there.
    for phase in range(6):
        q, rate, acceleration = motion(TIME + 5 * phase)
        result = smoothing_spline(TIME, quantised(q, 1e-3), 1e-3)
        assert abs(result.first - rate)[[0, -1]].max() < 0.2 * np.std(rate)
        assert abs(result.second - acceleration)[[0, -1]].max() < np.std(acceleration)
        assert abs(result.second).max() < 1.2 * abs(acceleration).max()


@settings(deadline=None, max_examples=15)
@given(st.floats(1e-6, 1e6), st.floats(1e-3, 1e3), st.floats(-1e3, 1e3))
def test_units_scale_results_and_nothing_else(value_scale, time_scale, shift):
    t = TIME[:600]
    data, step = quantised(motion(t)[0], 1e-3), 1e-3
    for known in (step, None):
        base = smoothing_spline(t, data, known)
        other = smoothing_spline(
            (t + shift) * time_scale,
            data * value_scale,
            None if known is None else known * value_scale,
        )
        for got, expected in (
            (other.values, base.values * value_scale),
            (other.first, base.first * value_scale / time_scale),
            (other.second, base.second * value_scale / time_scale**2),
        ):
            np.testing.assert_allclose(got, expected, atol=1e-5 * abs(expected).max())
        assert other.noise_std == pytest.approx(base.noise_std * value_scale)
        assert other.smoothing == pytest.approx(base.smoothing * time_scale**5, rel=1e-4)


def test_degrees_of_freedom_are_the_trace_of_the_smoother():
    t = np.cumsum(np.random.default_rng(5).uniform(0.5, 1.5, 80))
    level = _Mesh(t).level(0)
    for lam in (1e-2, 1.0, 1e4):
        columns = [e - level.fit(e, lam)[1] for e in np.eye(len(t))]
        assert level.degrees_of_freedom(lam) == pytest.approx(np.trace(columns), rel=1e-4)


def test_the_penalty_is_the_integral_of_the_squared_third_derivative():
    level = _Mesh(np.cumsum(np.random.default_rng(6).uniform(0.5, 1.5, 12))).level(0)
    c = np.random.default_rng(7).normal(size=level.size)
    third = BSpline(level.knots, c, 5).derivative(3)
    exact = sum(
        quad(lambda x: float(third(x)) ** 2, a, b)[0]
        for a, b in zip(level.knots[5:-6], level.knots[6:-5], strict=True)
    )
    full = np.zeros((level.size, level.size))
    for k, row in enumerate(level.penalty[::-1]):
        full += np.diag(row[k:], k) + (np.diag(row[k:], -k) if k else 0)
    assert c @ full @ c == pytest.approx(exact, rel=1e-9)


def test_a_constant_has_no_derivative_and_eight_samples_are_enough():
    result = smoothing_spline(np.arange(8.0), np.full(8, 3.0), 0.1)
    assert not result.first.any()
    assert not result.second.any()
    short = smoothing_spline(np.arange(8.0), np.arange(8.0) ** 3)
    assert short.chosen_by == "interpolation"
    np.testing.assert_allclose(short.first, 3 * np.arange(8.0) ** 2, atol=1e-9)
    np.testing.assert_allclose(short.second, 6 * np.arange(8.0), atol=1e-9)
    # Noise far above a tiny signal, in units that square to nothing.
    faint = smoothing_spline(np.arange(30.0), 1e-250 * np.sin(np.arange(30.0)), 1.0)
    assert faint.noise_std == pytest.approx(1 / np.sqrt(12))


@pytest.mark.parametrize(
    ("time", "values", "step", "message"),
    [
        (np.arange(7.0), np.arange(7.0), None, "7 samples are too few"),
        (np.arange(9.0), np.arange(8.0), None, r"time \(9,\) and values \(8,\) do not fit"),
        (np.zeros(9), np.arange(9.0), None, "time does not strictly increase"),
        (np.arange(9.0), np.r_[np.nan, np.ones(8)], None, "1 of 9 values are NaN"),
        (np.arange(9.0), np.arange(9.0), 0.0, "quantisation step of 0.0 was given"),
    ],
)
def test_what_a_spline_refuses(time, values, step, message):
    with pytest.raises(DfsmError, match=message):
        smoothing_spline(time, values, step)
    if step is None:
        with pytest.raises(DfsmError, match=message):
            cubic_spline(time, values)

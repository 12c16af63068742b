"""The linear fit against numpy.linalg.lstsq, and the LPV fit on a system that it can represent."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from dfsm.errors import DfsmError
from dfsm.fitting.linear import LPV, LTI, LinearFit, fit_linear, schedule_windows
from dfsm.numerics.least_squares import correlation_length
from systems import wander

NAMES = ["torque", "pitch", "wind", "x3"]


def data(seed: int, n: int = 3000, m: int = 4, noise: float = 0.1):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, m)) @ rng.normal(size=(m, m)) + rng.normal(size=m)
    Y = X @ rng.normal(size=(m, 3)) + rng.normal(size=3) + noise * rng.normal(size=(n, 3))
    return X, Y


def reference(X: np.ndarray, Y: np.ndarray, affine: bool) -> tuple[np.ndarray, np.ndarray]:
    """L and b by lstsq; with an offset on centred data, which conditions it best."""
    if not affine:
        return np.linalg.lstsq(X, Y)[0].T, np.zeros(Y.shape[1])
    L = np.linalg.lstsq(X - X.mean(0), Y - Y.mean(0))[0].T
    return L, Y.mean(0) - L @ X.mean(0)


def coefficients(fit: LinearFit, point: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(fit.model.coefficients)[point], np.asarray(fit.model.offsets)[point]


# -- LTI ----------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000), affine=st.booleans())
def test_agrees_with_lstsq(seed, affine):
    X, Y = data(seed)
    fit = fit_linear([(X, Y)], NAMES, LTI(affine=affine))
    L, b = coefficients(fit)
    expected, offset = reference(X, Y, affine)
    np.testing.assert_allclose(L, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(b, offset, rtol=1e-8, atol=1e-8 * np.abs(Y).max())
    residual = Y - X @ expected.T - offset
    np.testing.assert_allclose(fit.residual_rms, np.sqrt(np.mean(residual**2, 0)), rtol=1e-6)
    np.testing.assert_allclose(fit.target_std, Y.std(0), rtol=1e-9)
    assert fit.samples.tolist() == [len(X)]


def test_without_offset_it_is_the_papers_formula():
    X, Y = data(5)
    fit = fit_linear([(X, Y)], NAMES, LTI(affine=False))
    np.testing.assert_allclose(
        coefficients(fit)[0], (Y.T @ X) @ np.linalg.inv(X.T @ X), rtol=1e-8, atol=1e-10
    )
    assert not coefficients(fit)[1].any()


def test_offsets_far_larger_than_the_variation_cost_few_digits():
    X, Y = data(1)
    X, Y = X + np.array([1e4, -3e4, 1e4, 2e4]), Y + 1e4
    L, b = coefficients(fit_linear([(X, Y)], NAMES, LTI()))
    expected, _ = reference(X, Y, True)
    np.testing.assert_allclose(L, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(X @ L.T + b, X @ expected.T + (Y - X @ expected.T).mean(0))


def test_units_of_the_inputs_do_not_matter():
    X, Y = data(2)
    scales = np.array([1e7, 1e-6, 1.0, 1e3])
    L, b = coefficients(fit_linear([(X, Y)], NAMES, LTI()))
    scaled, same = coefficients(fit_linear([(X * scales, Y)], NAMES, LTI()))
    np.testing.assert_allclose(scaled * scales, L, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(same, b, rtol=1e-8)
    np.testing.assert_allclose(scaled * scales, reference(X, Y, True)[0], rtol=1e-8, atol=1e-10)


@settings(deadline=None, max_examples=15)
@given(cuts=st.lists(st.integers(1, 2999), max_size=8, unique=True), affine=st.booleans())
def test_how_the_samples_are_cut_into_blocks_does_not_matter(cuts, affine):
    X, Y = data(3)
    whole = fit_linear([(X, Y)], NAMES, LTI(affine=affine))
    edges = [0, *sorted(cuts), len(X)]
    blocks = [(X[a:b], Y[a:b]) for a, b in pairwise(edges)]
    cut = fit_linear(iter(blocks), NAMES, LTI(affine=affine))
    for a, b in zip(coefficients(cut), coefficients(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(cut.residual_rms, whole.residual_rms, rtol=1e-8)


def test_a_first_block_unlike_the_rest_costs_few_digits():
    # The sums are taken about the first block's mean, here a thousand spreads from the data's.
    X, Y = data(4, noise=0.0)
    X[:50] += 1e3
    Y[:50] = 0.0
    blocks = [(X[:50], Y[:50]), (X[50:], Y[50:])]
    L, b = coefficients(fit_linear(blocks, NAMES, LTI()))
    expected, offset = reference(X, Y, True)
    np.testing.assert_allclose(L, expected, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(b, offset, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("choice", [LTI(), LPV(schedule="wind", points=5)])
def test_memory_does_not_grow_with_the_number_of_samples(choice):
    X, Y = data(6, 2000)
    windows = schedule_windows(X[:, 2], 5)
    fit_linear([(X, Y)], NAMES, choice, windows)

    def peak(blocks: int) -> int:
        tracemalloc.start()
        fit_linear(((X + 0, Y + 0) for _ in range(blocks)), NAMES, choice, windows)
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    few, many = peak(5), peak(200)
    # 195 more blocks hold 195 * 2000 * 7 * 8 bytes = 22 MB.
    assert many < few + 1e6


def test_a_pair_of_confounded_inputs_is_named_and_nothing_else():
    X, Y = data(7)
    X[:, 3] = 2 * X[:, 1]
    fit = fit_linear([(X, Y)], NAMES, LTI())
    (text,) = fit.warnings
    told = text.split("apart")[1].split("(condition")[0]
    assert "pitch" in told
    assert "x3" in told
    assert "torque" not in told
    assert "wind" not in told
    # Predictions agree with lstsq's minimum-norm ones although the coefficients are not unique.
    L, b = coefficients(fit)
    expected, offset = reference(X, Y, True)
    np.testing.assert_allclose(X @ L.T + b, X @ expected.T + offset, atol=1e-5)


def test_a_constant_input_is_named_and_gets_no_coefficient():
    X, Y = data(8)
    X[:, 1] = 7.5
    fit = fit_linear([(X, Y)], NAMES, LTI())
    (text,) = fit.warnings
    assert text.startswith("input 'pitch' has the same value in all samples, so nothing")
    z = (X - X.mean(0)) / np.where(X.std(0) > 1e-9, X.std(0), np.inf)
    np.testing.assert_allclose(fit.condition, np.linalg.cond(z[:, [0, 2, 3]]), rtol=1e-4)
    assert not coefficients(fit)[0][:, 1].any()
    rest = [0, 2, 3]
    expected, _ = reference(X[:, rest], Y, True)
    np.testing.assert_allclose(coefficients(fit)[0][:, rest], expected, rtol=1e-8, atol=1e-10)


def test_inputs_that_differ_enough_draw_no_warning():
    X, Y = data(9)
    X[:, 3] = X[:, 1] + 0.01 * X[:, 3]
    fit = fit_linear([(X, Y)], NAMES, LTI())
    assert fit.warnings == ()
    z = (X - X.mean(0)) / X.std(0)
    np.testing.assert_allclose(fit.condition, np.linalg.cond(z), rtol=1e-4)


def test_fewer_samples_than_unknowns_is_refused():
    X, Y = data(0)
    with pytest.raises(DfsmError, match="4 samples for 5 unknowns"):
        fit_linear([(X[:4], Y[:4])], NAMES, LTI())
    assert fit_linear([(X[:4], Y[:4])], NAMES, LTI(affine=False)).samples.tolist() == [4]
    with pytest.raises(DfsmError, match="no samples to fit"):
        fit_linear([], NAMES, LTI())


# -- LPV ----------------------------------------------------------------------------------------

WIND = NAMES.index("wind")


def scheduled(seed: int, n: int = 40_000):
    """Targets whose coefficients of inputs 0, 1, 3 are linear in the wind, and a linear offset."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, 4))
    X[:, WIND] = rng.uniform(5, 15, n)
    L0, L1 = rng.normal(size=(2, 2, 3))
    s = X[:, WIND, None]
    x = X[:, [0, 1, 3]]
    Y = x @ L0.T + s * (x @ L1.T) + 2.0 * s - 3.0
    return X, Y, L0, L1


@pytest.fixture(scope="module")
def lpv():
    X, Y, L0, L1 = scheduled(0)
    choice = LPV(schedule="wind", points=6)
    fit = fit_linear([(X, Y)], NAMES, choice, schedule_windows(X[:, WIND], 6))
    return fit, L0, L1


def test_lpv_recovers_coefficients_linear_in_the_schedule(lpv):
    fit, L0, L1 = lpv
    grid = np.asarray(fit.model.grid)
    assert (np.diff(grid) > 0).all()
    # Within a window the products s·x vary, so that the estimates carry sampling noise.
    for s in np.linspace(grid[0], grid[-1], 23):
        L, _ = (np.asarray(a) for a in fit.model.at(s))
        np.testing.assert_allclose(L[:, [0, 1, 3]], L0 + s * L1, atol=0.05)


def test_lpv_windows_each_solve_their_own_least_squares():
    X, Y, _, _ = scheduled(1, 20_000)
    windows = schedule_windows(X[:, WIND], 4)
    fit = fit_linear([(X, Y)], NAMES, LPV(schedule="wind", points=4), windows)
    s = X[:, WIND]
    for k, (low, high) in enumerate(windows):
        inside = (s >= (low if k else -np.inf)) & (s <= (high if k < 3 else np.inf))
        L, b = reference(X[inside], Y[inside], True)
        # They lean on the fit of all windows by one independent sample's worth of what is left.
        np.testing.assert_allclose(coefficients(fit, k)[0], L, rtol=0, atol=2e-3)
        np.testing.assert_allclose(coefficients(fit, k)[1], b, rtol=0, atol=2e-2)
        np.testing.assert_allclose(np.asarray(fit.model.grid)[k], s[inside].mean(), rtol=1e-12)
        assert fit.samples[k] == inside.sum()


def test_lpv_leans_on_all_windows_where_one_has_no_information():
    # In the upper half of the wind the pitch is stuck: its effect there is known from below.
    rng = np.random.default_rng(3)
    X = rng.normal(size=(20_000, 4))
    X[:, WIND] = rng.uniform(5, 15, 20_000)
    X[X[:, WIND] > 10, 1] = 0.5
    Y = X @ np.array([[1.0], [2.0], [0.3], [-1.0]]) + 0.1 * rng.normal(size=(20_000, 1))
    windows = schedule_windows(X[:, WIND], 6)
    fit = fit_linear([(X, Y)], NAMES, LPV(schedule="wind", points=6), windows)
    for k in range(6):
        np.testing.assert_allclose(coefficients(fit, k)[0], [[1, 2, 0.3, -1]], atol=0.05)
    assert fit.warnings == ()


def test_lpv_is_continuous_in_the_schedule(lpv):
    fit, _, _ = lpv
    edges = np.unique(np.concatenate([np.asarray(fit.model.grid), fit.windows.ravel()]))
    at = jax.jit(jax.vmap(fit.model.at))
    slope = np.abs(np.diff(np.asarray(fit.model.coefficients), axis=0)).max()
    for one, other in zip(at(edges - 1e-9), at(edges + 1e-9), strict=True):
        scale = slope if one.ndim == 3 else np.abs(np.diff(fit.model.offsets, axis=0)).max()
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 * scale)


def test_lpv_holds_the_last_coefficients_outside_its_grid(lpv):
    fit, _, _ = lpv
    grid = np.asarray(fit.model.grid)
    for value, k in ((-100.0, 0), (grid[0], 0), (grid[-1], -1), (1e3, -1)):
        L, b = fit.model.at(value)
        np.testing.assert_allclose(L, fit.model.coefficients[k], rtol=1e-12)
        np.testing.assert_allclose(b, fit.model.offsets[k], rtol=1e-12)


def test_lpv_at_a_grid_point_is_that_windows_fit(lpv):
    fit, _, _ = lpv
    for k, value in enumerate(np.asarray(fit.model.grid)):
        np.testing.assert_allclose(fit.model.at(value)[0], fit.model.coefficients[k], rtol=1e-12)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 1000), points=st.integers(2, 12), skew=st.floats(0.3, 3.0))
def test_windows_are_equally_wide_and_overlap_by_half(seed, points, skew):
    s = 5 + 20 * np.random.default_rng(seed).uniform(size=2000) ** skew
    windows = schedule_windows(s, points)
    widths = np.diff(windows, axis=1)[:, 0]
    np.testing.assert_allclose(widths, widths[0], rtol=1e-9)
    np.testing.assert_allclose(windows[1:, 0], windows[:-1].mean(axis=1), rtol=1e-9)
    np.testing.assert_allclose(
        [windows[0, 0], windows[-1, 1]], np.percentile(s, [0.5, 99.5]), rtol=1e-12
    )


def test_no_sample_is_left_out_at_the_ends():
    X, Y, _, _ = scheduled(2, 3000)
    windows = schedule_windows(X[:, WIND], 2)
    fit = fit_linear([(X, Y)], NAMES, LPV(schedule="wind", points=2), windows)
    twice = ((X[:, WIND] >= windows[1, 0]) & (X[:, WIND] <= windows[0, 1])).sum()
    assert fit.samples.sum() == 3000 + twice


def test_a_window_with_too_few_samples_is_refused():
    X, Y, _, _ = scheduled(3, 2000)
    X[:, WIND] = np.where(np.arange(2000) < 1000, 5, 15) + 0.1 * X[:, 0]
    with pytest.raises(DfsmError, match=r"0 samples in the window .* for 5 unknowns .*points"):
        fit_linear(
            [(X, Y)],
            NAMES,
            LPV(schedule="wind", points=8),
            schedule_windows(X[:, WIND], 8),
        )


def test_a_constant_schedule_and_a_single_window_are_refused():
    with pytest.raises(DfsmError, match=r"schedule does not vary \(always 8\)"):
        schedule_windows(np.full(100, 8.0), 5)
    with pytest.raises(DfsmError, match=r"linear\.points is 1, an LPV fit needs at least 2"):
        schedule_windows(np.arange(100.0), 1)


def test_lpv_names_inputs_confounded_in_all_windows():
    X, Y, _, _ = scheduled(4)
    X[:, 3] = 2 * X[:, 1]
    windows = schedule_windows(X[:, WIND], 5)
    fit = fit_linear([(X, Y)], NAMES, LPV(schedule="wind", points=5), windows)
    (text,) = fit.warnings
    assert "apart: pitch, x3 (" in text or "apart: x3, pitch (" in text


def test_a_schedule_of_few_distinct_values_gives_a_finite_model():
    rng = np.random.default_rng(5)
    X = rng.normal(size=(3000, 4))
    X[:, WIND] = rng.choice([6.0, 12.0, 18.0], 3000)
    Y = X[:, :1] * X[:, WIND, None]
    windows = schedule_windows(X[:, WIND], 5)
    fit = fit_linear([(X, Y)], NAMES, LPV(schedule="wind", points=5), windows)
    for value in (6.0, 8.0, 12.0, 15.0, 18.0, 30.0):
        L, b = (np.asarray(a) for a in fit.model.at(value))
        assert np.isfinite(L).all()
        assert np.isfinite(b).all()
    for value in (6.0, 12.0, 18.0):
        np.testing.assert_allclose(fit.model.at(value)[0][0, 0], value, atol=1e-4)


# -- how many samples are independent ------------------------------------------------------------


def coloured(rng: np.random.Generator, n: int, memory: float) -> np.ndarray:
    """First-order autoregressive noise of variance one; `memory` in samples."""
    a = np.exp(-1 / memory)
    return lfilter([np.sqrt(1 - a**2)], [1, -a], rng.normal(size=n + 2000))[2000:]


def test_white_noise_counts_sample_by_sample():
    noise = np.random.default_rng(0).normal(size=(20_000, 5))
    np.testing.assert_allclose(correlation_length(noise), 1.0, atol=0.05)
    alternating = noise[1:] - noise[:-1]
    np.testing.assert_allclose(correlation_length(alternating), 1.0)


@pytest.mark.parametrize("memory", [3.0, 30.0])
def test_coloured_noise_counts_by_its_autocorrelation(memory):
    rng = np.random.default_rng(0)
    a = np.exp(-1 / memory)
    noise = np.stack([coloured(rng, 100_000, memory) for _ in range(6)], axis=1)
    expected = (1 + a) / (1 - a)
    np.testing.assert_allclose(correlation_length(noise), expected, rtol=0.2)
    # The variance of a mean is what it says.
    means = noise[: 100_000 // 2000 * 2000].reshape(-1, 2000, 6).mean(axis=1)
    assert means.var() == pytest.approx(expected / 2000, rel=0.3)


def test_a_series_that_never_forgets_counts_once():
    ramp = np.linspace(-1, 1, 500)[:, None]
    assert 100 < correlation_length(ramp)[0] <= 500
    np.testing.assert_array_equal(correlation_length(np.zeros((10, 2))), 1.0)


def starved(rate: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Six runs in which the pitch hardly moves in strong wind, at so many samples per second.

    The runs are the same at any rate: sums of sines, and noise that remembers two seconds.
    """
    blocks = []
    time, fine = np.arange(0, 200, 1 / rate), np.arange(0, 201, 0.1)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        drive = [wander(rng, 0.0, 3.0, 1.5)(time) for _ in range(3)]
        wind = 10 + wander(rng, 0.0, 12.0, 0.3)(time)
        drive[1] = np.where(wind > 9.5, 0.02, 1.0) * drive[1]
        noise = CubicSpline(fine, coloured(rng, len(fine), 20.0))(time)
        X = np.stack([drive[0], drive[1], wind, drive[2]], axis=1)
        y = X[:, 0] + (4 - 0.2 * wind) * X[:, 1] - X[:, 3] + noise
        blocks.append((X, y[:, None]))
    return blocks


def test_the_sampling_rate_hardly_matters_to_a_window_that_starves():
    windows = np.array([[0.0, 10.0], [7.0, 13.0], [10.0, 20.0]])
    choice = LPV(schedule="wind", points=3)
    fits = {rate: fit_linear(starved(rate), NAMES, choice, windows) for rate in (10, 20, 40)}
    found = {rate: np.asarray(f.model.coefficients) for rate, f in fits.items()}
    for rate in (10, 40):
        np.testing.assert_allclose(found[rate], found[20], rtol=0, atol=0.02)
    # It is one that leans: its own least squares are somewhere else.
    X, y = (np.concatenate(part) for part in zip(*starved(20), strict=True))
    inside = X[:, WIND] >= 10
    own, _ = reference(X[inside], y[inside], True)
    assert abs(found[20][2, 0, 1] - own[0, 1]) > 0.1
    independent = {rate: f.equations[2].independent for rate, f in fits.items()}
    assert independent[40] == pytest.approx(independent[10], rel=0.1)
    assert independent[20] < 0.1 * fits[20].samples[2]


def test_the_residual_that_remembers_longest_counts_for_all_targets():
    """White noise in one target must not pass for information where another one remembers."""
    windows = np.array([[0.0, 10.0], [7.0, 13.0], [10.0, 20.0]])
    choice, rng = LPV(schedule="wind", points=3), np.random.default_rng(0)
    slow = starved(20)
    both = [(X, np.hstack([y, rng.standard_normal(y.shape)])) for X, y in slow]
    alone = fit_linear(slow, NAMES, choice, windows).equations[2].independent
    # Sums of other shapes round differently in some libraries.
    found = fit_linear(both, NAMES, choice, windows).equations[2].independent
    assert found == pytest.approx(alone, rel=1e-9)

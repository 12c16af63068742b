"""Input signals: known at every time, inside their bounds, with energy where it was asked for."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.signal import periodogram

from dfsm import Chirp, DfsmError, Multisine, RandomKnots, RandomSteps, Uniform, excite
from dfsm.simulators.waveforms import held, interpolated

KINDS = [
    RandomKnots(low=-1.0, high=2.0, spacing=0.3),
    RandomSteps(low=-1.0, high=2.0, hold=(0.2, 0.7)),
    Multisine(low=-1.0, high=2.0, frequencies=(0.5, 4.0)),
    Chirp(low=-1.0, high=2.0, frequencies=(0.5, 4.0)),
    Chirp(low=-1.0, high=2.0, frequencies=(4.0, 0.5), sweep="logarithmic"),
]
each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.kind)
FINE = np.linspace(0, 10, 20001)


@each_kind
def test_the_same_seed_gives_the_same_signal(kind):
    a, b, c = (excite(kind, 2, 10.0, seed)(FINE) for seed in (3, 3, 4))
    assert a.shape == (len(FINE), 2)
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    # Channels differ too.
    assert abs(np.corrcoef(a.T)[0, 1]) < 1 - 1e-6


@each_kind
def test_compiled_code_sees_the_same_signal(kind):
    signal = excite(kind, 3, 10.0, 1)
    times = np.random.default_rng(0).uniform(0, 10, 50)
    expected = signal(times)
    assert isinstance(expected, np.ndarray)
    as_argument = jax.jit(lambda signal, t: signal(t))
    assert np.abs(as_argument(signal, times) - expected).max() < 1e-12
    one_by_one = jax.vmap(jax.jit(lambda t: signal(t)))(times)
    assert np.abs(one_by_one - expected).max() < 1e-12
    assert signal(times[7]).shape == (3,)
    assert np.abs(signal(times[7]) - expected[7]).max() < 1e-14


@each_kind
def test_signals_never_change(kind):
    signal = excite(kind, 1, 10.0)
    with pytest.raises(dataclasses.FrozenInstanceError):
        signal.span = np.zeros(2)
    for leaf in jax.tree.leaves(signal):
        with pytest.raises(ValueError, match="read-only"):
            leaf[...] = 0


@each_kind
def test_times_outside_the_duration_are_refused(kind):
    signal = excite(kind, 1, 10.0)
    signal([0.0, 10.0])
    with pytest.raises(DfsmError, match=r"lasts from 0 s to 10 s, it was asked for at 10\.1 s"):
        signal([3.0, 10.1])


@each_kind
def test_bounds_may_differ_between_channels(kind):
    kind = dataclasses.replace(kind, low=(0.0, -5.0, 7.0), high=(1.0, 5.0, 7.0))
    values = excite(kind, 3, 10.0, 2)(np.arange(0, 10.01, 0.3))
    assert (values >= np.array([0, -5, 7]) - 1e-9).all()
    assert (values <= np.array([1, 5, 7]) + 1e-9).all()
    assert (np.ptp(values, axis=0)[:2] > [0.5, 5]).all()
    assert np.allclose(values[:, 2], 7, rtol=0, atol=1e-12)


# -- one kind at a time -------------------------------------------------------------------------


def test_random_knots_are_joined_by_a_cubic_spline():
    signal = excite(RandomKnots(low=-1.0, high=2.0, spacing=0.25), 2, 10.0, 5)
    knots = 0.25 * np.arange(41)
    at_knots = signal(knots)
    assert at_knots.min() >= -1
    assert at_knots.max() <= 2
    assert np.ptp(at_knots) > 2.5
    assert np.abs(signal(FINE) - CubicSpline(knots, at_knots)(FINE)).max() < 1e-12
    assert np.allclose(signal.corners[:39], knots[1:40])


def test_knots_cover_a_duration_that_is_no_multiple_of_their_spacing():
    signal = excite(RandomKnots(low=0.0, high=1.0, spacing=0.7), 1, 1.0)
    knots = 0.7 * np.arange(3)
    assert np.isfinite(signal(np.linspace(0, 1, 11))).all()
    assert np.allclose(signal.breaks, knots[:2])
    # A spacing beyond the duration leaves a straight line.
    line = excite(RandomKnots(low=0.0, high=1.0, spacing=5.0), 1, 1.0)(np.linspace(0, 1, 5))
    assert np.allclose(np.diff(line, 2, axis=0), 0, atol=1e-12)


def test_commensurate_spacings_share_their_knots():
    a, b = (
        excite(RandomKnots(low=0.0, high=1.0, spacing=s), 1, 30.0).corners[:50] for s in (0.1, 0.3)
    )
    assert set(b[:10]) <= set(a)


def test_random_steps_hold_their_levels():
    signal = excite(RandomSteps(low=-1.0, high=2.0, hold=(0.2, 0.7)), 2, 10.0, 1)
    values = signal(FINE)
    assert values.min() >= -1
    assert values.max() <= 2
    changes = [FINE[1:][np.diff(v) != 0] for v in values.T]
    for times in changes:
        assert 10 / 0.7 - 1 <= len(times) <= 10 / 0.2
        assert (np.diff(times) >= 0.2 - 1e-3).all()
        assert (np.diff(times) <= 0.7 + 1e-3).all()
    assert not set(changes[0]) & set(changes[1])
    # A level holds from its corner on, and the one before it until just before.
    inside = signal.corners[signal.corners < 10]
    assert len(inside) == len(changes[0]) + len(changes[1])
    assert (signal(inside) != signal(np.nextafter(inside, 0))).any(axis=1).all()
    assert np.array_equal(signal(inside), signal(np.nextafter(inside, 10)))


def test_random_steps_can_have_few_levels():
    kind = RandomSteps(low=0.0, high=3.0, hold=(0.1, 0.2), levels=4)
    assert np.array_equal(np.unique(excite(kind, 2, 50.0)(5 * FINE)), [0, 1, 2, 3])


def test_all_draws_of_steps_have_the_same_shapes():
    def shapes(hold, seed):
        signal = excite(RandomSteps(low=0.0, high=1.0, hold=hold), 2, 10.0, seed)
        return [leaf.shape for leaf in jax.tree.leaves(signal)]

    assert shapes((0.2, 0.7), 1) == shapes((0.2, 0.7), 2)
    assert shapes((0.3, 0.3), 1) == shapes((0.3, 0.3), 2)


def test_multisine_has_its_energy_in_its_range():
    signal = excite(Multisine(low=-1.0, high=2.0, frequencies=(1.0, 3.0), lines=15), 2, 100.0, 1)
    values = signal(10 * FINE)
    assert values.min() >= -1
    assert values.max() <= 2
    # It fills the range on one side at least.
    assert (np.maximum(values.max(axis=0) - 0.5, 0.5 - values.min(axis=0)) > 0.95 * 1.5).all()
    for channel in values.T:
        frequency, power = periodogram(channel, fs=1 / 0.005, window="hann")
        inside = (frequency > 0.95) & (frequency < 3.05)
        assert power[inside].sum() > 0.999 * power.sum()
        # Energy in every part of the range.
        thirds = [power[(frequency > a) & (frequency < a + 2 / 3)].sum() for a in (1, 5 / 3, 7 / 3)]
        assert min(thirds) > 0.2 * power[inside].sum()
    assert np.unique(signal.rate).size == 30


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0, 2), st.floats(0.01, 5), st.integers(1, 30), st.floats(0.1, 20), st.integers(0, 99)
)
def test_multisines_stay_inside_their_bounds(first, width, lines, duration, seed):
    kind = Multisine(low=-2.0, high=1.0, frequencies=(first, first + width), lines=lines)
    values = excite(kind, 2, duration, seed)(np.linspace(0, duration, 5003))
    assert values.min() >= -2 - 1e-12
    assert values.max() <= 1 + 1e-12


@pytest.mark.parametrize("sweep", ["linear", "logarithmic"])
@pytest.mark.parametrize("ends", [(0.5, 8.0), (8.0, 0.5)])
def test_chirps_sweep_as_they_say(sweep, ends):
    first, last = ends
    signal = excite(Chirp(low=-1.0, high=3.0, frequencies=ends, sweep=sweep), 2, 10.0, 1)
    values = signal(FINE)
    assert -1 <= values.min() < -0.99
    assert 2.99 < values.max() <= 3

    def frequency(t):
        return (
            first + (last - first) * t / 10
            if sweep == "linear"
            else first * (last / first) ** (t / 10)
        )

    for a, b in ((0, 3), (3, 7), (7, 10)):
        cycles = quad(frequency, a, b)[0]
        inside = values[(a <= FINE) & (b >= FINE)] - 1
        crossings = (np.diff(np.sign(inside), axis=0) != 0).sum(axis=0)
        assert (np.abs(crossings - 2 * cycles) <= 1).all()


def test_samples_can_be_held_or_joined():
    steps = held([0.0, 1.0, 2.5], [[1.0], [-1.0], [0.5]], 4.0)
    assert steps([0.0, 0.999, 1.0, 2.5, 4.0])[:, 0].tolist() == [1, 1, -1, 0.5, 0.5]
    assert steps.corners.tolist() == [1, 2.5]
    times = np.array([0.0, 0.4, 1.0, 1.1, 2.0])
    joined = interpolated(times, np.sin(times)[:, None])
    assert np.allclose(joined(times)[:, 0], np.sin(times))
    between = np.linspace(0, 2, 33)
    assert np.allclose(joined(between)[:, 0], CubicSpline(times, np.sin(times))(between))


def test_uniform_values_fill_their_box():
    box = Uniform(low=(0.0, 2.0), high=(1.0, 2.0))
    values = np.stack([box.draw(2, (0, k)) for k in range(200)])
    assert values[:, 0].min() >= 0
    assert values[:, 0].max() <= 1
    assert np.ptp(values[:, 0]) > 0.9
    assert (values[:, 1] == 2).all()
    assert np.array_equal(box.draw(2, 7), box.draw(2, 7))


# -- bad input ----------------------------------------------------------------------------------

BASE = {"low": 0.0, "high": 1.0}


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        (RandomKnots(low=1.0, high=0.0, spacing=1.0), "low is 1 and high is 0: swap the two"),
        (RandomKnots(low=(0.0, 0.0, 0.0), high=1.0, spacing=1.0), "one for each of the 2 channels"),
        (RandomKnots(low=0.0, high=np.inf, spacing=1.0), "high is inf, expected .* finite"),
        (RandomKnots(**BASE, spacing=0.0), "spacing is 0.0, expected at least 1e-06 s"),
        (RandomSteps(**BASE, hold=(0.5, 0.2)), r"hold is \(0.5, 0.2\), expected two rising times"),
        (RandomSteps(**BASE, hold=(0.0, 0.2)), "hold is"),
        (RandomSteps(**BASE, hold=(0.1, 0.2), levels=1), "levels is 1, expected at least 2"),
        (Multisine(**BASE, frequencies=(2.0, 1.0)), "frequencies is .* expected two rising ones"),
        (Multisine(**BASE, frequencies=(-1.0, 1.0)), "none negative"),
        (Multisine(**BASE, frequencies=(0.1, 1.0), lines=0), "lines is 0, expected at least 1"),
        (Chirp(**BASE, frequencies=(1.0, 1.0)), "expected two different ones in Hz above 0"),
        (Chirp(**BASE, frequencies=(0.0, 1.0)), "expected two different ones in Hz above 0"),
        (Chirp(**BASE, frequencies=(0.1, 1.0), sweep="up"), "sweep is up, expected linear or log"),
        ("noise", "the signal is a str, expected one of RandomKnots, RandomSteps"),
    ],
)
def test_settings_that_make_no_sense(kind, sentence):
    with pytest.raises(DfsmError, match=sentence) as caught:
        excite(kind, 2, 10.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("channels", "duration", "seed", "sentence"),
    [
        (0, 1.0, 0, "channels is 0, expected at least 1"),
        (1, 0.0, 0, "duration is 0.0, expected a time in s above 0"),
        (1, np.inf, 0, "duration is inf"),
        (1, 1.0, -1, "seed is -1, expected 0 or more"),
    ],
)
def test_arguments_that_make_no_sense(channels, duration, seed, sentence):
    with pytest.raises(DfsmError, match=sentence):
        excite(KINDS[0], channels, duration, seed)

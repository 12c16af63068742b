"""Error figures, spectra and fatigue loads against closed forms and counting by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import periodogram

from dfsm.data.derivatives import StateSpec, differentiate
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.numerics.fatigue import damage_equivalent_load
from dfsm.numerics.spectra import Band, spectrum
from dfsm.simulation.simulate import Status, simulate
from dfsm.validation.validate import compared, validate
from systems import OSCILLATOR, OSCILLATOR_A, OSCILLATOR_B, driving_run, linear_model

EXPONENTS = (3.0, 4.0, 5.0, 10.0)

# -- spectra ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frequency", "amplitude"), [(0.03, 2.0), (0.1, 0.5), (1.2, 7.0)])
def test_spectrum_of_a_sine(frequency, amplitude):
    time = np.arange(0, 600, 0.05)
    found = spectrum(time, 5 + amplitude * np.sin(2 * np.pi * frequency * time))
    around = Band("sine", frequency - 0.02, frequency + 0.02)
    assert abs(found.peak(around) - frequency) <= 1 / 200
    np.testing.assert_allclose(found.power(around), amplitude**2 / 2, rtol=1e-3)
    away = Band("elsewhere", frequency + 0.03, frequency + 0.5)
    assert found.power(away) < 1e-4 * amplitude**2


def test_power_of_noise_in_a_band_is_its_share_of_the_variance():
    rng = np.random.default_rng(0)
    time = np.arange(0, 4000, 0.1)
    found = spectrum(time, 3.0 * rng.normal(size=len(time)))
    # White up to 5 Hz with variance 9: each Hz holds 1.8.
    np.testing.assert_allclose(found.power(Band("one", 1.0, 2.0)), 1.8, rtol=0.05)
    np.testing.assert_allclose(found.power(Band("all", 0.0, 5.0)), 9.0, rtol=0.05)


def test_a_record_shorter_than_a_segment_is_one_segment():
    time = np.arange(0, 50, 0.05)
    values = np.random.default_rng(1).normal(size=1000)
    found = spectrum(time, values)
    frequency, density = periodogram(values, fs=20, window="hann", detrend="constant")
    np.testing.assert_allclose(found.frequency, frequency, atol=1e-9)
    np.testing.assert_allclose(found.density, density, rtol=1e-6, atol=1e-12)


def test_a_band_without_bins_has_no_peak_and_no_power():
    time = np.arange(0, 10, 0.1)
    found = spectrum(time, np.sin(time))
    assert found.peak(Band("slow", 0.001, 0.002)) is None
    assert found.power(Band("slow", 0.001, 0.002)) == 0


def test_a_spectrum_of_an_irregular_mesh_is_refused():
    time = np.sort(np.random.default_rng(0).uniform(0, 10, 200))
    with pytest.raises(DfsmError, match="equidistant time mesh"):
        spectrum(time, np.sin(time))


# -- fatigue ------------------------------------------------------------------------------------


def counted(values: np.ndarray) -> np.ndarray:
    """Ranges by ASTM E1049, 5.4.5: rainflow counting of a repeating history, step by step."""
    start = int(np.argmax(values))
    closed = np.concatenate([values[start:], values[: start + 1]])
    closed = closed[np.concatenate([[True], np.diff(closed) != 0])]
    ranges, open_points = [], []
    for value in closed:
        while (
            len(open_points) > 1
            and (value - open_points[-1]) * (open_points[-1] - open_points[-2]) > 0
        ):
            open_points.pop()
        open_points.append(value)
        while len(open_points) > 2:
            x = abs(open_points[-1] - open_points[-2])
            y = abs(open_points[-2] - open_points[-3])
            if x < y:
                break
            ranges.append(y)
            del open_points[-3:-1]
    return np.array(ranges)


def test_counting_by_hand_reproduces_the_standard():
    # ASTM E1049 Fig. 7, the history A to I: ranges 3, 4, 7 and 9 once each.
    history = np.array([-2, 1, -3, 5, -1, 3, -4, 4, -2], dtype=float)
    assert sorted(counted(history)) == [3, 4, 7, 9]


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_damage_of_the_standards_example(exponent):
    history = np.array([-2, 1, -3, 5, -1, 3, -4, 4, -2], dtype=float)
    expected = (sum(s**exponent for s in (3, 4, 7, 9)) / 20.0) ** (1 / exponent)
    found = damage_equivalent_load(history, 20.0, exponent)
    np.testing.assert_allclose(found, expected, rtol=5e-3)


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("frequency", [0.1, 0.5])
def test_damage_of_a_sine_has_a_closed_form(exponent, frequency):
    time = np.arange(0, 600, 0.05)
    load = 5e6 + 2e6 * np.sin(2 * np.pi * frequency * time)
    found = damage_equivalent_load(load, 600.0, exponent)
    # 600 f cycles of range 2 A do the damage of 600 cycles of this range.
    np.testing.assert_allclose(found, 4e6 * frequency ** (1 / exponent), rtol=5e-3)
    slower = damage_equivalent_load(load, 600.0, exponent, frequency=frequency)
    np.testing.assert_allclose(slower, 4e6, rtol=5e-3)


@settings(deadline=None, max_examples=60)
@given(
    history=st.lists(st.integers(-100, 100), min_size=2, max_size=40).filter(
        lambda h: max(h) > min(h)
    ),
    exponent=st.sampled_from(EXPONENTS),
)
def test_damage_agrees_with_counting_step_by_step(history, exponent):
    values = np.array(history, dtype=float)
    expected = (np.sum(counted(values) ** exponent) / 60.0) ** (1 / exponent)
    # Loads are counted in 256 classes, so that each range is known to half a per cent of all.
    found = damage_equivalent_load(values, 60.0, exponent)
    np.testing.assert_allclose(found, expected, rtol=0.03)


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_damage_of_a_record_that_drifts(exponent, seed):
    values = np.cumsum(np.random.default_rng(seed).normal(size=5000))
    expected = (np.sum(counted(values) ** exponent) / 250.0) ** (1 / exponent)
    found = damage_equivalent_load(values, 250.0, exponent)
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_damage_of_loads_that_hardly_cycle():
    assert damage_equivalent_load(np.full(50, 3.0), 10.0, 4.0) == 0
    ramp = damage_equivalent_load(np.linspace(0, 2, 100), 10.0, 4.0)
    np.testing.assert_allclose(ramp, 2 * 10 ** (-1 / 4), rtol=5e-3)
    assert np.isfinite(damage_equivalent_load(1e100 * np.sin(np.arange(100.0)), 10.0, 10.0))


# -- validation ---------------------------------------------------------------------------------

TIME = np.arange(0, 60.01, 0.05)
CHOICES = FitSettings(
    states=(StateSpec(name="q"), StateSpec(name="v")),
    controls=("u",),
    disturbances=("w",),
    outputs=("y",),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


@pytest.fixture(scope="module")
def runs():
    return OSCILLATOR.many(4, [(1, 2), (8, 3)], TIME)


@pytest.fixture(scope="module")
def model(runs):
    return fit(runs[:3], CHOICES).model


@pytest.fixture(scope="module")
def perfect(model, runs):
    return validate(model, runs[3:])


def test_a_perfect_model_has_no_errors(perfect):
    assert list(perfect.models) == ["linear-fit", "multi-fidelity"]
    (run,) = perfect.runs
    for name in perfect.models:
        result = run.models[name]
        assert result.simulation.status is Status.COMPLETED
        assert set(result.errors) == {"q", "v", "y"}
        # What remains is linear interpolation of the inputs between samples.
        assert max(e.nrmse for e in result.errors.values()) < 2e-3
        assert max(result.derivative_errors.values()) < 1e-4
        assert perfect.mean_nrmse(name, "q") == result.errors["q"].nrmse
        assert perfect.completed(name) == 1
        for channel, figures in result.statistics.items():
            np.testing.assert_allclose(figures.std, run.statistics[channel].std, rtol=1e-2)
    assert perfect.warnings == ()


def test_statistics_are_those_of_the_recorded_signal(perfect, runs):
    figures = perfect.runs[0].statistics["y"]
    y = runs[3]["y"]
    np.testing.assert_allclose(
        [figures.minimum, figures.mean, figures.maximum, figures.std],
        [y.min(), y.mean(), y.max(), y.std()],
    )
    for exponent in EXPONENTS:
        expected = (np.sum(counted(y) ** exponent) / 60.0) ** (1 / exponent)
        np.testing.assert_allclose(figures.damage[f"{exponent:g}"], expected, rtol=1e-2)
    assert perfect.runs[0].statistics["q"].damage == {}
    assert set(figures.power) == {"platform", "wave", "0-0.3 Hz"}


def test_errors_by_hand(model, runs):
    # A model whose y is off by a factor and an offset has errors that can be written down.
    wrong = replace(model, g=replace(model.g, offsets=model.g.offsets + 2.0))
    result = validate({"off": wrong}, runs[3:]).runs[0].models["off"]
    exact = validate({"on": model}, runs[3:]).runs[0].models["on"]
    offset = result.errors["y"]
    assert abs(offset.rmse - 2.0) < 2 * exact.errors["y"].maximum
    np.testing.assert_allclose(offset.nrmse, offset.rmse / runs[3]["y"].std(), rtol=1e-12)
    assert abs(offset.maximum - 2.0) < 2 * exact.errors["y"].maximum
    difference = simulate(model, runs[3]).trajectory["q"] - runs[3]["q"]
    np.testing.assert_allclose(result.errors["q"].rmse, np.sqrt(np.mean(difference**2)), rtol=1e-6)


def test_derivative_errors_by_hand(model, runs):
    biased = replace(model, f=replace(model.f, offsets=model.f.offsets + np.array([[0.0, 0.3]])))
    found = validate({"biased": biased}, runs[3:]).runs[0].models["biased"].derivative_errors
    spread = differentiate(runs[3], CHOICES.states).derivatives[:, 1].std()
    np.testing.assert_allclose(found["v"], 0.3 / spread, rtol=1e-3)
    assert found["q"] < 1e-4


def test_histograms_hold_every_sample_of_every_model(perfect):
    for channel in ("q", "v", "y"):
        histogram = perfect.histograms[channel]
        for counts in histogram.counts.values():
            assert counts.sum() == len(TIME)
        np.testing.assert_allclose(histogram.edges, -histogram.edges[::-1])


def test_a_window_limits_what_is_compared(model, runs):
    found = validate({"m": model}, runs[3:], start=20.0, stop=50.0)
    recorded = found.runs[0].recorded
    assert recorded.time[0] == pytest.approx(20.0)
    assert recorded.time[-1] == pytest.approx(50.0)
    np.testing.assert_array_equal(
        found.runs[0].models["m"].simulation.trajectory.time, recorded.time
    )
    assert found.runs[0].models["m"].errors["q"].nrmse < 2e-3
    assert recorded.wall_time == pytest.approx(50.0)


def test_speed_up_compares_recorded_and_own_wall_time(perfect, model, runs):
    own = perfect.runs[0].models["linear-fit"].simulation.wall_time
    np.testing.assert_allclose(perfect.speed_up("linear-fit"), 100.0 / own)
    unknown = replace(runs[3], wall_time=None)
    assert validate({"m": model}, [unknown]).speed_up("m") is None


def test_training_runs_among_the_test_runs_are_told(model, runs):
    found = validate({"m": model}, [runs[0], runs[3]])
    assert len(found.warnings) == 1
    assert "1 of the 2 test runs were used in training (runs/run0_0.csv)" in found.warnings[0]


def test_a_rollout_that_ends_early_has_no_errors(runs):
    good = fit(runs[:3], CHOICES).model
    A = np.asarray(good.f.coefficients).copy()
    A[0, 1, 3] = 3.0  # negative damping
    bad = replace(good, f=replace(good.f, coefficients=A))
    found = validate({"good": good, "bad": bad}, runs[2:])
    for run in found.runs:
        assert run.models["bad"].errors == {}
        assert run.models["bad"].statistics == {}
        assert run.models["bad"].derivative_errors["v"] > 0.1
        assert set(run.models["good"].errors) == {"q", "v", "y"}
    assert found.mean_nrmse("bad", "q") is None
    assert (found.mean_nrmse("good", "q") or np.inf) < 2e-3
    assert found.completed("bad") == 0
    assert found.completed("good") == 2
    # A model that completed nothing does not take the others' errors out of the histogram.
    assert found.histograms["q"].counts["good"].sum() == 2 * len(TIME)
    assert "bad" not in found.histograms["q"].counts
    values = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert values["models"]["bad"]["mean_nrmse"]["q"] is None
    assert values["runs"][0]["models"]["bad"]["status"] == "left_region"
    assert "factor of ten" in values["runs"][0]["models"]["bad"]["message"]


def test_a_validation_prints_in_a_few_lines(perfect, model, runs):
    head, *lines = repr(perfect).split("\n")
    assert head == "<Validation on 1 run, 3 channels"
    for line, name in zip(lines, ("linear-fit", "multi-fidelity"), strict=True):
        assert line.startswith(f"  {name}: 1 of 1 rollouts completed, mean NRMSE 0.00 (")
    assert repr(perfect).endswith(")>")
    unstable = linear_model(OSCILLATOR_A + 5 * np.eye(2), OSCILLATOR_B, names=["q", "v"], span=1e-2)
    signals = replace(model.signals, outputs=())
    unstable = replace(unstable, signals=signals)
    assert repr(validate({"bad": unstable}, runs[2:])) == (
        "<Validation on 2 runs, 2 channels\n  bad: 0 of 2 rollouts completed>"
    )


def test_to_dict_survives_json(perfect):
    values = json.loads(json.dumps(perfect.to_dict(), allow_nan=False))
    assert values["runs"][0]["models"]["multi-fidelity"]["errors"]["q"]["nrmse"] == (
        perfect.mean_nrmse("multi-fidelity", "q")
    )
    assert [c["name"] for c in values["channels"]] == ["q", "v", "y"]
    assert values["models"]["linear-fit"]["of"] == 1


@pytest.mark.parametrize("level", [0.0, 3.3])
def test_a_recorded_channel_that_does_not_vary_has_no_nrmse(model, runs, level):
    values = runs[3].values.copy()
    values[:, runs[3].column("y")] = level
    found = validate({"m": model}, [replace(runs[3], values=values)])
    written = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert written["runs"][0]["models"]["m"]["errors"]["y"]["nrmse"] is None
    assert written["runs"][0]["models"]["m"]["errors"]["y"]["rmse"] > 1
    assert written["models"]["m"]["mean_nrmse"]["y"] is None


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_confounded_inputs_do_not_spoil_the_json(runs):
    same = [replace(r, values=r.values[:, [0, 1, 2, 3, 4, 3]], channels=(
        *r.channels, Channel("copy", "m/s"))) for r in runs]  # fmt: skip
    constant = [replace(r, values=np.column_stack([r.values[:, :5], 0 * r.time + 2])) for r in same]
    for run, inputs in (
        (same, {"disturbances": ("w", "copy")}),
        (constant, {"parameters": ("copy",)}),
    ):
        model = fit(run[:3], replace(CHOICES, **inputs)).model
        json.dumps(validate({"m": model}, run[3:]).to_dict(), allow_nan=False)


def test_an_irregular_mesh(model):
    rng = np.random.default_rng(0)
    mesh = np.cumsum(rng.uniform(0.02, 0.08, 1000))
    (run,) = OSCILLATOR.many(1, [(1, 2), (8, 3)], mesh, seed=5)
    found = validate({"m": model}, [run])
    assert found.runs[0].models["m"].errors["q"].nrmse < 2e-3
    figures = found.runs[0].statistics["q"]
    np.testing.assert_allclose(figures.std, run["q"].std(), rtol=0.05)
    assert np.isfinite(figures.spectrum.density).all()
    step = float(np.median(np.diff(run.time)))
    values = np.interp(np.arange(mesh[0], mesh[-1], step), run.time, run["q"])
    assert (figures.std, figures.maximum) == (values.std(), values.max())


def test_blade_passing_gets_a_band():
    model = linear_model(
        np.diag([-0.1, -1.0]), np.array([[0.1], [1.0]]), names=["speed", "x"], units=["rpm", "m"]
    )
    time = np.arange(0, 100, 0.1)
    speed = 7.5 + 0.1 * np.sin(time)
    run = driving_run(model, time, np.full((1000, 1), 7.5), np.stack([speed, np.cos(time)], 1))
    found = validate({"m": model}, [run])
    # Three blades at 7.5 rpm pass 0.375 times a second.
    assert set(found.runs[0].statistics["speed"].peaks) == {"platform", "wave", "3P"}
    peak = found.runs[0].statistics["x"].peaks["3P"]
    assert peak is not None
    assert 0.8 * 0.375 <= peak <= 1.2 * 0.375


def test_the_models_compared_by_default(model):
    assert list(compared(model)) == ["linear-fit", "multi-fidelity"]
    assert list(compared(model, model)) == ["linear-fit", "multi-fidelity", "nonlinear-only"]
    other = linear_model(OSCILLATOR_A, OSCILLATOR_B)
    assert compared(other)["linear-fit"].e is None


def test_bad_test_runs_are_refused(model, runs):
    with pytest.raises(DfsmError, match="no test runs were given"):
        validate(model, [])
    with pytest.raises(DfsmError, match=r"run0_3\.csv: no channel 'y'"):
        validate(model, [runs[3].select(["q", "v", "u", "w"])])
    short = Trajectory(runs[3].time[:30], runs[3].values[:30], runs[3].channels, name="short")
    with pytest.raises(DfsmError, match=r"short: runs from 0 s to 1\.45 s, shorter than"):
        validate(model, [short], start=10.0)

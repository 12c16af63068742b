"""Features of disturbances against closed forms, and through the whole chain."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dfsm.data.derivatives import StateSpec
from dfsm.data.features import Feature, unknown_ends, with_features
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LTI
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import load, save
from dfsm.simulation.simulate import simulate
from dfsm.validation.validate import validate

RATE = Feature(source="w")
LAG = Feature(source="w", kind="lag", time_constant=1.5)
TIME = np.arange(0, 30.01, 0.05)


def wave(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.05, 0.4, 6), rng.uniform(0, 2 * np.pi, 6)
    return np.sin(2 * np.pi * f * TIME[:, None] + phase).sum(1)


@cache
def driven(seed: int) -> Trajectory:
    """x' = -0.5 x + w' + 2 lag(w): what w alone, at one time, cannot tell."""
    w = wave(seed)
    slope, lag = np.gradient(w, TIME, edge_order=2), lagged(w, 1.5)

    def f(t: float, x: np.ndarray) -> np.ndarray:
        return -0.5 * x + np.interp(t, TIME, slope) + 2 * np.interp(t, TIME, lag)

    x = solve_ivp(f, (0, TIME[-1]), [0.0], t_eval=TIME, rtol=1e-9, atol=1e-9, max_step=0.05).y[0]
    channels = (Channel("x", "m"), Channel("w", "m"))
    return Trajectory(TIME, np.stack([x, w], axis=1), channels, name=f"run{seed}")


def lagged(w: np.ndarray, tau: float) -> np.ndarray:
    solved = solve_ivp(
        lambda t, z: (np.interp(t, TIME, w) - z) / tau,
        (0, TIME[-1]),
        w[:1],
        t_eval=TIME,
        rtol=1e-10,
        atol=1e-12,
        max_step=0.05,
    )
    return solved.y[0]


def test_names_and_units():
    run = with_features(driven(0), [RATE, LAG])
    assert run.names == ("x", "w", "w_dot", "w_lag1.5")
    assert [run.channel(n).unit for n in ("w_dot", "w_lag1.5")] == ["m/s", "m"]
    assert {run.channel(n).role for n in ("w_dot", "w_lag1.5")} == {"disturbance"}


def test_a_difference_is_one():
    run = driven(0)
    channels = (Channel("v", "m"), Channel("f", "Hz"))
    wide = run.with_channels(channels, np.stack([run["w"] ** 2, run["w"]], axis=1))
    made = with_features(wide, [Feature(source="v", kind="difference", less="w")])
    np.testing.assert_array_equal(made["v-w"], run["w"] ** 2 - run["w"])
    assert made.channel("v-w").unit == "m"
    with pytest.raises(DfsmError, match=r"takes 'f' \(Hz\) off 'v' \(m\): name two channels in"):
        with_features(wide, [Feature(source="v", kind="difference", less="f")])
    for wrong in ({"kind": "difference"}, {"less": "w"}):
        with pytest.raises(DfsmError, match=r"features\.less"):
            Feature(source="v", **wrong)


def test_a_rate_is_the_derivative():
    w = np.sin(TIME)
    run = Trajectory(TIME, w[:, None], (Channel("w", "m"),))
    np.testing.assert_allclose(with_features(run, [RATE])["w_dot"], np.cos(TIME), atol=1e-5)


def test_a_lag_is_exact_for_inputs_linear_between_samples():
    run = driven(1)
    found = with_features(run, [LAG])["w_lag1.5"]
    np.testing.assert_allclose(found, lagged(run["w"], 1.5), atol=5e-7)


def test_a_lag_starts_at_rest():
    run = Trajectory(TIME, np.full((len(TIME), 1), 3.0), (Channel("w", "m"),))
    np.testing.assert_allclose(with_features(run, [LAG])["w_lag1.5"], 3.0, rtol=1e-14)


def test_features_of_features_and_again():
    chain = [LAG, Feature(source="w_lag1.5")]
    once = with_features(driven(0), chain)
    assert once.names[-1] == "w_lag1.5_dot"
    again = with_features(once, chain)
    assert again.names == once.names
    np.testing.assert_array_equal(again.values, once.values)


SETTINGS = FitSettings(
    states=(StateSpec(name="x"),),
    disturbances=("w",),
    features=(RATE, LAG),
    linear=LTI(),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def test_a_model_learns_through_features_and_keeps_them(tmp_path):
    runs, test = [driven(s) for s in range(4)], driven(9)
    model = fit(runs, SETTINGS).model
    assert model.signals.names("disturbances") == ("w", "w_dot", "w_lag1.5")
    np.testing.assert_allclose(
        np.asarray(model.f.coefficients)[0, 0], [0.0, 1.0, 2.0, -0.5], atol=0.02
    )
    rollout = simulate(model, test).trajectory["x"]
    assert np.sqrt(np.mean((rollout - test["x"]) ** 2)) < 0.02 * test["x"].std()
    bare = fit(runs, replace(SETTINGS, features=())).model
    without = simulate(bare, test).trajectory["x"]
    assert np.sqrt(np.mean((without - test["x"]) ** 2)) > 0.2 * test["x"].std()
    save(model, tmp_path / "m")
    again = simulate(load(tmp_path / "m"), test).trajectory["x"]
    np.testing.assert_array_equal(again, rollout)
    assert "run9" in validate(model, [test]).to_dict()["runs"][0]["name"]


def test_what_is_computed_does_not_decide_the_order_of_runs():
    """Its last digits differ from one processor to the next."""
    runs = [with_features(driven(s), [RATE]) for s in range(5)]
    rounding = 1 + 1e-12 * np.array([False, False, True])
    other = [replace(r, values=r.values * rounding) for r in runs]
    assert [r.digest for r in other] == [r.digest for r in runs]
    assert [r.digest for r in runs] == [driven(s).digest for s in range(5)]
    assert runs[0].select(["w_dot"]).digest != other[0].select(["w_dot"]).digest
    moved = runs[0].values.copy()
    moved[0, 0] += 1e-12
    assert replace(runs[0], values=moved).digest != runs[0].digest


def test_a_training_run_is_known_again_without_its_features():
    runs = [driven(s) for s in range(3)]
    model = fit(runs, SETTINGS).model
    told = validate(model, [driven(1), driven(9)]).warnings
    assert any("1 of the 2 test runs were used in training (run1)" in text for text in told)


def test_features_come_from_the_record_before_the_start():
    model = fit([driven(s) for s in range(2)], SETTINGS).model
    whole = simulate(model, driven(9), start=10.0).trajectory
    cut = simulate(model, driven(9).window(10.0, None)).trajectory
    assert np.abs(whole["x"] - cut["x"]).max() > 1e-3  # the lag starts at rest in the cut record


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"kind": "lag"}, "features.time_constant is None, expected a positive number"),
        ({"kind": "lag", "time_constant": -1.0}, "features.time_constant is -1"),
        ({"time_constant": 2.0}, "features.time_constant is 2.0, expected none for a rate"),
    ],
)
def test_settings_that_make_no_sense(changes, said):
    with pytest.raises(DfsmError, match=said):
        Feature(source="w", **changes)


def test_responses_are_no_source():
    settings = replace(SETTINGS, features=(Feature(source="x", kind="lag", time_constant=1.0),))
    with pytest.raises(DfsmError, match="feature 'x_lag1' is made of the state 'x'"):
        fit([driven(0)], settings)


def test_a_missing_source():
    with pytest.raises(DfsmError, match="no channel 'wave'"):
        with_features(driven(0), [Feature(source="wave")])


def test_a_lag_needs_an_equidistant_mesh():
    run = driven(0)
    irregular = replace(run, time=run.time**1.01)
    with pytest.raises(DfsmError, match=r"feature 'w_lag1\.5' needs an equidistant mesh"):
        with_features(irregular, [LAG])


# -- what acts before it arrives ------------------------------------------------------------------

LEAD = Feature(source="w", kind="lead", seconds=1.5)


@cache
def led(seed: int) -> Trajectory:
    """x' = -0.5 x + w(t + 1.5 s): waves whose force begins before they are told."""
    w, ahead = wave(seed), np.interp(TIME + 1.5, TIME, wave(seed))
    solved = solve_ivp(
        lambda t, x: -0.5 * x + np.interp(t, TIME, ahead),
        (0, TIME[-1]),
        [0.0],
        t_eval=TIME,
        rtol=1e-9,
        atol=1e-9,
        max_step=0.05,
    )
    values = np.stack([solved.y[0], w], axis=1)
    return Trajectory(TIME, values, (Channel("x", "m"), Channel("w", "m")), name=f"led{seed}")


def test_a_lead_is_what_comes(tmp_path):
    run = with_features(led(1), [LEAD])
    shifted = run["w_lead1.5"]
    np.testing.assert_allclose(shifted[:-30], run["w"][30:], atol=1e-12)
    np.testing.assert_array_equal(shifted[-30:], run["w"][-1])
    settings = FitSettings(
        states=(StateSpec(name="x"),),
        disturbances=("w",),
        features=(LEAD,),
        linear=LTI(),
        corrective=NoCorrection(),
        nonlinear_only=False,
    )
    model = fit([led(seed) for seed in range(1, 6)], settings).model
    row = dict(zip([c.name for c in model.signals.inputs], model.f.coefficients[0, 0], strict=True))
    assert abs(row["w_lead1.5"] - 1) < 2e-3
    assert abs(row["w"]) < 2e-3
    save(model, tmp_path / "m")
    loaded, run = load(tmp_path / "m"), led(6)
    outcome = simulate(loaded, run)
    assert outcome.message.endswith("leading inputs hold their last value for the last 1.5 s")
    rollout = outcome.trajectory
    known = rollout.time < TIME[-1] - 1.5
    error = rollout["x"] - run["x"]
    assert np.abs(error[known]).max() < 0.01 * run["x"].std()
    assert simulate(loaded, run, stop=20).guessed == (0, 0)
    (told,) = validate(loaded, [run]).warnings
    assert "compared up to 28.5 s" in told


def test_a_rate_over_some_seconds_is_a_slope_between_two_samples():
    run = led(1)
    rate = Feature(source="w", kind="rate", seconds=1.0)
    assert rate.name == "w_dot1"
    made = with_features(run, [rate])
    assert made.channel("w_dot1").unit == "m/s"
    slope = (run["w"][40:] - run["w"][:-40]) / 2
    np.testing.assert_allclose(made["w_dot1"][20:-20], slope, atol=1e-12)
    assert unknown_ends([rate]) == (1.0, 1.0)
    with pytest.raises(DfsmError, match=r"features\.seconds is -1\.0, expected a positive number"):
        Feature(source="w", kind="rate", seconds=-1.0)


def test_what_a_lead_does_not_know_is_left_out_of_a_fit():
    settings = FitSettings(
        states=(StateSpec(name="x"),),
        disturbances=("w",),
        features=(LEAD, replace(LEAD, source="w_lead1.5", seconds=2.0)),
        corrective=NoCorrection(),
    )
    with pytest.raises(DfsmError, match=r"not known in its first 0 s and its last 3\.5 s"):
        fit([led(1).window(0, 3.5), led(2).window(0, 3.5)], settings)
    with pytest.raises(DfsmError, match=r"features\.seconds"):
        Feature(source="w", kind="lead")

"""Other inputs for a recorded run, parameters from a table, and recorded starts with features."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from conftest import write_config
from dfsm.config.control import load_problem
from dfsm.config.fit import load_config
from dfsm.data.derivatives import StateSpec
from dfsm.data.features import Feature
from dfsm.data.parameters import read_parameters, with_parameters
from dfsm.data.readers.tables import read_table, write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import save
from dfsm.models.what_if import with_changes, with_inputs
from dfsm.simulation.simulate import initial_state, simulate

pytestmark = pytest.mark.filterwarnings("ignore:.*outside the training range")

TIME = np.arange(0, 20.01, 0.1)


def recorded(seed: int, ballast: float = 1.0) -> Trajectory:
    """x' = -0.5 x + u + 0.3 w', exactly."""
    rng = np.random.default_rng(seed)
    f = rng.uniform(0.05, 0.3, 3)
    x, w = np.sin(2 * np.pi * f[0] * TIME), np.cos(2 * np.pi * f[1] * TIME)
    slope = [2 * np.pi * f[0] * np.cos(2 * np.pi * f[0] * TIME)]
    slope += [-2 * np.pi * f[1] * np.sin(2 * np.pi * f[1] * TIME)]
    u = slope[0] + 0.5 * x - 0.3 * slope[1] + 0.2 * (ballast - 1)
    channels = (Channel("x", "deg"), Channel("u", "kN-m"), Channel("w", "m"))
    values = np.stack([x, u, w], axis=1)
    return Trajectory(TIME, values, channels, name=f"run{seed}", source=f"here/run{seed}.csv")


@pytest.fixture(scope="module")
def model():
    settings = FitSettings(
        states=(StateSpec(name="x"),),
        controls=("u",),
        disturbances=("w",),
        features=(Feature(source="w"),),
        corrective=NoCorrection(),
        nonlinear_only=False,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fit([recorded(0), recorded(1), recorded(2)], settings).model


def test_channels_are_replaced_by_name():
    run = recorded(0)
    new = run.with_channels(["u", "more"], np.stack([TIME, 2 * TIME], axis=1), replace=True)
    assert new.names == ("x", "u", "w", "more")
    assert new.channel("u") == run.channel("u")
    np.testing.assert_array_equal(new["u"], TIME)
    np.testing.assert_array_equal(new["w"], run["w"])
    once = run.with_channels("x", 4.5, replace=True)
    assert (once["x"] == 4.5).all()
    stepped = replace(run, channels=(Channel("x", "deg", step=0.1), *run.channels[1:]))
    assert stepped.with_channels("x", TIME, replace=True).channel("x").step is None
    with pytest.raises(DfsmError, match=r"'u' stands there twice: rename one, or .*replace=True"):
        run.with_channels("u", TIME)
    with pytest.raises(DfsmError, match=r"samples of u have shape \(7,\), expected \(201, 1\)"):
        run.with_channels(["u"], np.zeros(7), replace=True)
    with pytest.raises(DfsmError, match="samples of u are no numbers"):
        run.with_channels("u", "fast", replace=True)
    with pytest.raises(DfsmError, match="3 is no channel"):
        run.with_channels([3], TIME)  # pyright: ignore[reportArgumentType]


def test_changes_are_made_in_turn_and_reach_features(model):
    run = recorded(3)
    found = with_changes(run, ["u += 1", "w*=2", " w -= 0.5e0", "x = 2"], model.signals)
    np.testing.assert_allclose(found["u"], run["u"] + 1)
    np.testing.assert_allclose(found["w"], 2 * run["w"] - 0.5)
    assert initial_state(model, found, 0.0)[0] == 2
    twice = simulate(model, with_changes(run, ["w *= 2"], model.signals)).trajectory
    once, none = (
        simulate(model, with_changes(run, [f"w *= {k}"], model.signals)).trajectory for k in (1, 0)
    )
    np.testing.assert_allclose(twice["x"] - once["x"], once["x"] - none["x"], atol=1e-9)
    assert np.abs(twice["x"] - once["x"]).max() > 0.1
    bare = run.select(["x", "w"])
    assert with_changes(bare, ["u = 3"], model.signals).channel("u").unit == "kN-m"


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ("u + 1", "is no change of a channel: write NAME = NUMBER"),
        ("u = fast", "'fast' is no finite number"),
        ("u *= nan", "'nan' is no finite number"),
        ("v = 1", r"would have no effect, the model takes no 'v' from a run; known are: u, w, x"),
        ("w_dot += 1", "'w_dot' is computed from w: change that"),
    ],
)
def test_changes_without_effect_earn_a_sentence(model, change, match):
    with pytest.raises(DfsmError, match=match):
        with_changes(recorded(3), [change], model.signals)


def test_inputs_of_another_table_replace_those_of_the_run(model):
    run, other = recorded(3), recorded(4)
    coarse = other.resample(np.arange(5, 20.01, 0.5))
    channels = (coarse.channels[0], Channel("u", "N-m"), coarse.channels[2])
    coarse = replace(coarse, values=coarse.values * [1, 1e3, 1], channels=channels)
    with pytest.warns(DfsmWarning) as told:
        found = with_inputs(run, coarse, model.signals, 5.0, 15.0)
    assert "run4.csv: x is no input of the model and not used" in str(told[0].message)
    assert "'u' from N-m to kN-m" in str(told[1].message)
    inside = TIME >= 5 - 1e-9
    for name in ("u", "w"):
        expected = np.interp(TIME, coarse.time, other.resample(coarse.time)[name])
        np.testing.assert_allclose(found[name][inside], expected[inside], rtol=1e-12)
        np.testing.assert_array_equal(found[name][~inside], run[name][~inside])
    np.testing.assert_array_equal(found["x"], run["x"])
    with pytest.raises(DfsmError, match="last from 5 s to 20 s, the simulation from 0 s to 20 s"):
        with_inputs(run, coarse.select(["u"]), model.signals)
    with pytest.raises(DfsmError, match="none of its columns is an input of the model"):
        with_inputs(run, coarse.select(["x"]), model.signals, 5.0)
    fine = other.select(["u"]).resample(np.arange(0, 20.001, 0.02))
    with pytest.warns(DfsmWarning, match=r"every 0.02 s, but .* every 0.1 s: what lies between"):
        with_inputs(run, fine, model.signals)


def test_the_command_takes_other_inputs(model, tmp_path, dfsm):
    run, out = recorded(3), tmp_path / "out.parquet"
    save(model, tmp_path / "m")
    write_table(run, tmp_path / "run.csv")
    write_table(recorded(4).select(["u"]), tmp_path / "u.csv")
    asked = ("--inputs", tmp_path / "u.csv", "--set", "w *= 0.5", "--set", "u += 0.25")
    shown = dfsm("simulate", tmp_path / "m", tmp_path / "run.csv", "-o", out, *asked)
    assert shown.code == 0, shown
    changed = run.with_channels("u", recorded(4)["u"] + 0.25, replace=True)
    changed = changed.with_channels("w", 0.5 * run["w"], replace=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = simulate(model, changed).trajectory["x"]
    np.testing.assert_allclose(read_table(out)["x"], expected, rtol=1e-12, atol=1e-12)
    wrong = dfsm("simulate", tmp_path / "m", tmp_path / "run.csv", "-o", out, "--set", "uu += 1")
    assert "did you mean 'u'?" in wrong.sentence


def test_a_recorded_start_works_with_features(model, tmp_path):
    save(model, tmp_path / "m")
    run = recorded(3)
    write_table(run, tmp_path / "run.csv")
    write_config(
        tmp_path / "p.yaml",
        {
            "model": "m", "disturbances": "run.csv", "horizon": [5, 10], "initial": "recorded",
            "cost": [{"square": "u", "weight": 1}],
        },
    )  # fmt: skip
    problem = load_problem(tmp_path / "p.yaml")[0]
    assert problem.initial["x"] == pytest.approx(run["x"][50], abs=1e-6)
    slope = np.gradient(run["w"], TIME)[50]
    assert problem.scenarios[0]["w_dot"][50] == pytest.approx(slope, rel=0.01)


# -- parameters of runs -------------------------------------------------------------------------


def configuration(parameters: object) -> dict[str, object]:
    signals = {"states": [{"name": "x"}], "controls": ["u"], "parameters": parameters}
    return {"data": {"train": ["run*.csv"]}, "signals": signals, "corrective": {"kind": "none"}}


def test_parameters_come_from_the_configuration_or_a_table(tmp_path):
    for seed in (0, 1):
        write_table(recorded(seed), tmp_path / f"run{seed}.csv")
    values = {
        "Ballast [t]": {"run0.csv": 1.5, "run1": 2, "test.csv": 9},
        "k": {"run0": 3, "run1": 4},
    }
    (tmp_path / "p.csv").write_text("run;Ballast [t];k\nrun0.csv;1.5;3\nrun1.csv;2;4\n")
    for given in (values, "p.csv"):
        config, runs = load_config(write_config(tmp_path / "c.yaml", configuration(given)))
        assert config.fit_settings().parameters == ("Ballast", "k")
        assert [float(r["Ballast"][0]) for r in runs] == [1.5, 2]
        assert [float(r["k"].max()) for r in runs] == [3, 4]
        assert runs[0].channel("Ballast").unit == "t"
    assert read_parameters(tmp_path / "p.csv")["k"] == {"run0.csv": 3, "run1.csv": 4}


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"B": {"run0.csv": 1}}, r"run1\.csv: no value of parameter 'B' for this run"),
        ({"B": {"run0": 1, "run0.csv": 2, "run1": 1}}, r"2 values \(run0, run0.csv\) of parameter"),
        ({"w": {"run0": 1, "run1": 2}}, "parameter 'w' is a channel of the run already"),
        ({"B": {"run0": float("nan"), "run1": 1}}, "parameter 'B' is 'nan', expected a finite"),
        ({"B": 3}, r"'signals.parameters': 'B' is 3, expected its value in every run"),
        (3, r"'signals.parameters' is 3, expected a list of channels, values of runs"),
        ("no.csv", r"no\.csv"),
        ("bad.csv", r"bad.csv, row 2: B is 'x', expected a finite number"),
    ],
)
def test_parameters_that_are_missing_or_wrong_earn_a_sentence(tmp_path, given, match):
    for seed in (0, 1):
        write_table(recorded(seed), tmp_path / f"run{seed}.csv")
    (tmp_path / "bad.csv").write_text("run,B\nrun0,x\n")
    path = write_config(tmp_path / "c.yaml", configuration(given))
    with pytest.raises(DfsmError, match=match):
        load_config(path)


def test_a_folder_tells_runs_of_one_name_apart():
    runs = [replace(recorded(k), source=f"a{k}/run.csv", name="run") for k in (0, 1)]
    found = with_parameters(runs, {"B": {"a0/run.csv": 1.0, "a1/run.csv": 2.0}})
    assert [r["B"][0] for r in found] == [1, 2]

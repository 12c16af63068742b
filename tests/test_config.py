"""`config.yaml`: what it accepts, and what it says about what it does not."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import CONFIG, changed, write_config
from dfsm.config.fit import Config, load_config, parse_config
from dfsm.data.derivatives import Filter, StateSpec
from dfsm.data.features import Feature
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.corrective.rbf import RBF, IncrementalRBF
from dfsm.fitting.linear import LPV, LTI
from dfsm.fitting.samples import extract, only_read, select
from dfsm.fitting.settings import FitSettings
from dfsm.models.signals import Azimuth


def parsed(tmp_path, content):
    return parse_config(write_config(tmp_path / "c.yaml", content))


def complaint(tmp_path, content) -> str:
    """What is said about a configuration, without the file's name."""
    path = write_config(tmp_path / "c.yaml", content)
    with pytest.raises(DfsmError) as caught:
        load_config(path)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


def test_every_key_reaches_the_fit(tmp_path):
    content = {
        "data": {"train": ["a"], "start": 1, "stop": 9.5, "hub_height": 150, "outliers": "drop"},
        "signals": {
            "states": [
                {"name": "q", "order": 2, "rate": "v", "acceleration": "a"},
                {"name": "s"},
            ],
            "controls": ["u"],
            "disturbances": ["w"],
            "parameters": ["p"],
            "outputs": ["y"],
        },
        "derivatives": {
            "method": "cubic_spline",
            "filters": {"q": {"kind": "low_pass", "cutoff": 0.5}},
        },
        "linear": {"kind": "LPV", "schedule": "w", "points": 3, "affine": False},
        "corrective": {"kind": "mlp", "hidden": [3, 4], "iterations": 7, "weight_decay": 0.5},
        "gate": 0.5,
        "azimuth": {"speed": "s", "angle": "psi", "blades": 2},
        "nonlinear_only": False,
        "seed": 42,
    }
    settings = parsed(tmp_path, content).fit_settings()
    assert settings.states == (
        StateSpec(name="q", order=2, rate="v", acceleration="a"),
        StateSpec(name="s"),
    )
    groups = ("controls", "disturbances", "parameters", "outputs")
    assert [getattr(settings, g) for g in groups] == [("u",), ("w",), ("p",), ("y",)]
    assert (settings.start, settings.stop, settings.hub_height) == (1.0, 9.5, 150.0)
    assert settings.outliers == "drop"
    assert settings.derivatives.method == "cubic_spline"
    assert settings.derivatives.filters == {"q": Filter(kind="low_pass", cutoff=0.5)}
    assert settings.linear == LPV(schedule="w", points=3, affine=False)
    assert settings.corrective == MLP(hidden=(3, 4), iterations=7, weight_decay=0.5)
    assert settings.azimuth == Azimuth(speed="s", angle="psi", blades=2)
    assert (settings.gate, settings.nonlinear_only, settings.seed) == (0.5, False, 42)


def test_defaults_are_those_of_the_fit(tmp_path):
    content = {"data": {"train": ["a"]}, "signals": {"states": [{"name": "q"}]}}
    assert parsed(tmp_path, content).fit_settings() == FitSettings(states=(StateSpec(name="q"),))


def test_no_setting_of_the_fit_is_out_of_reach():
    known = set(Config.model_fields) | {"states", "controls", "disturbances", "parameters"}
    known |= {"features", "outputs", "start", "stop", "hub_height", "slower", "outliers"}
    assert {f.name for f in fields(FitSettings)} <= known


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("rbf", RBF()),
        ("rbf_incremental", IncrementalRBF()),
        ("gp", GP()),
        ("mlp", MLP()),
        ("none", NoCorrection()),
    ],
)
def test_every_kind_of_correction(tmp_path, kind, expected):
    config = parsed(tmp_path, changed("corrective", value={"kind": kind}))
    assert config.fit_settings().corrective == expected


def test_files_are_found_from_the_folder_of_the_config(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config, runs = load_config(folder / "config.yaml")
    assert config.linear == LTI()
    assert [Path(r.source or "").name for r in runs] == ["a.csv", "b.parquet", "c.outb"]
    assert runs[1].time is runs[0].time  # the same times, held once


def test_a_fit_keeps_only_the_channels_that_it_reads(folder):
    config, whole = load_config(folder / "config.yaml")
    settings = replace(config.fit_settings(), outputs=("y",))
    few = [only_read(run, settings) for run in whole]
    assert all(run.names == ("q", "u", "w", "y") for run in few)
    assert all("z" in run for run in whole)
    data = select(few, settings)
    # No second copy of the records, and the same samples as with all channels.
    assert all(any(np.shares_memory(r.values, f.values) for f in few) for r in data)
    ours, theirs = extract(data, settings), extract(select(whole, settings), settings)
    for name in ("inputs", "derivatives", "outputs", "time", "psi", "runs"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
    # Nor of what samples only repeat.
    for run, time, recorded in zip(data, ours.times, ours.recorded, strict=True):
        assert np.shares_memory(time, run.time)
        assert np.shares_memory(recorded, run.values)
    # Where one is lacking all are kept, for the message that names the near ones.
    lacking = replace(settings, controls=("uu",))
    assert only_read(whole[0], lacking) is whole[0]
    delayed = replace(settings, features=(Feature(source="w", kind="delay", seconds=0.1),))
    assert only_read(whole[0], delayed).names == ("q", "u", "w", "y")


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        (("sed",), 1, "unknown key 'sed'; did you mean 'seed'?"),
        (("data", "strat"), 1, "unknown key 'data.strat'; did you mean 'start' or 'train'?"),
        (("signals", "control"), ["u"], "unknown key 'signals.control'; did you mean 'controls'?"),
        (
            ("signals", "states", 0, "ordre"),
            2,
            "unknown key 'signals.states[0].ordre'; did you mean 'order'?",
        ),
        (
            ("corrective", "sample"),
            2,
            "unknown key 'corrective.sample'; did you mean 'samples' or 'sampling'?",
        ),
        (
            ("derivatives", "filters", "q"),
            {"kind": "low_pass", "cutof": 1},
            "unknown key 'derivatives.filters.q.cutof'; did you mean 'cutoff'?",
        ),
        (("azimuth",), {"sped": "q"}, "key 'azimuth.speed' is missing"),
        (("a\nb",), 1, None),
    ],
)
def test_unknown_keys_are_told_with_their_path(tmp_path, path, value, expected):
    config = changed(*path, value=value)
    if expected is None:
        with pytest.raises(DfsmError, match="unknown key 'a\nb'; known are: data, signals"):
            parsed(tmp_path, config)
    else:
        assert complaint(tmp_path, config) == expected


def test_a_key_of_another_kind_is_not_suggested(tmp_path):
    said = complaint(tmp_path, changed("linear", value={"kind": "LTI", "points": 4}))
    assert said.startswith("unknown key 'linear.points'; known are: kind, affine")


@pytest.mark.parametrize(
    ("path", "value", "start"),
    [
        (("gate",), "wide", "'gate': input should be a valid number"),
        (("seed",), 1.5, "'seed': input should be a valid integer"),
        (("nonlinear_only",), "perhaps", "'nonlinear_only': input should be a valid boolean"),
        (("data", "train"), "a.csv", "'data.train': a list was expected, as [a, b], not 'a.csv'"),
        (("data", "start"), "late", "'data.start': input should be a valid number"),
        (("signals", "controls"), [7], "'signals.controls[0]': input should be a valid string"),
        (("signals", "states"), ["q"], "'signals.states[0]': keys and values were expected"),
        (("signals", "states", 0, "order"), 3, "'signals.states[0].order': input should be 1 or 2"),
        (("linear",), "LTI", "'linear': keys and values were expected"),
        (("linear",), {}, "'linear' needs a key 'kind', one of 'LTI', 'LPV'"),
        (("linear",), {"kind": "lti"}, "'linear.kind' is 'lti', expected one of 'LTI', 'LPV'; did"),
        (("linear",), {"kind": "LPV"}, "key 'linear.schedule' is missing"),
        (("corrective",), {"samples": 3}, "'corrective' needs a key 'kind', one of 'rbf', "),
        (("corrective",), {"kind": "mlp", "hidden": 4}, "'corrective.hidden': a list was expected"),
        (("corrective", "sampling"), "best", "'corrective.sampling': input should be 'kmeans', "),
        (("derivatives", "method"), "euler", "'derivatives.method': input should be 'smoothing_"),
        (("azimuth",), "q", "'azimuth': keys and values were expected"),
        (("data",), None, "'data': keys and values were expected"),
    ],
)
def test_wrong_types_are_told_with_their_path(tmp_path, path, value, start):
    assert complaint(tmp_path, changed(*path, value=value)).startswith(start)


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        (("gate",), -0.1, "gate is -0.1, expected 0 or more"),
        (("gate",), float("nan"), "gate is nan, expected 0 or more"),
        (("seed",), -1, "seed is -1, expected 0 or more"),
        (("corrective", "samples"), 0, "corrective.samples is 0, expected at least 1"),
        (("corrective", "samples"), -5, "corrective.samples is -5, expected at least 1"),
        (("corrective", "width"), 0, "corrective.width is 0.0, expected a positive number"),
        (
            ("corrective",),
            {"kind": "gp", "samples": 0},
            "corrective.samples is 0, expected at least 1",
        ),
        (
            ("corrective",),
            {"kind": "rbf_incremental", "neurons": 0},
            "corrective.neurons is 0, expected at least 1",
        ),
        (
            ("corrective",),
            {"kind": "rbf_incremental", "goal": -1},
            "corrective.goal is -1.0, expected 0 or more",
        ),
        (
            ("corrective",),
            {"kind": "mlp", "hidden": [4, 0]},
            "corrective.hidden is [4, 0], expected at least 1 unit per layer",
        ),
        (
            ("corrective",),
            {"kind": "mlp", "iterations": 0},
            "corrective.iterations is 0, expected at least 1",
        ),
        (
            ("corrective",),
            {"kind": "mlp", "weight_decay": -1},
            "corrective.weight_decay is -1.0, expected 0 or more",
        ),
        (("azimuth",), {"speed": "q", "blades": 0}, "azimuth.blades is 0, expected at least 1"),
        (("data", "train"), [], "'data.train' names no files: list the runs to train with"),
        (
            ("signals", "states"),
            [],
            "no states were given: name at least one channel as a state",
        ),
        (
            ("signals", "states"),
            [{"name": "q"}, {"name": "q"}],
            "state 'q' was given twice: name each state once",
        ),
        (
            ("signals", "controls"),
            ["u", "u"],
            "channel 'u' is listed twice as control: name it once",
        ),
        (
            ("signals", "disturbances"),
            ["w", "u"],
            "channel 'u' is listed as control and as disturbance: choose one",
        ),
    ],
)
def test_values_without_sense_are_told_before_any_file_is_read(tmp_path, path, value, expected):
    # The runs that CONFIG names do not exist here.
    assert complaint(tmp_path, changed(*path, value=value)) == expected


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "holds no keys"),
        ("# only a comment\n", "holds no keys"),
        ("- a\n- b\n", "holds no keys"),
        ("data: [", "line 1: not valid YAML"),
        ("a: 1\nb: c: d\n", "line 2: not valid YAML"),
        ("data: {}\ndata: {}\n", "line 2: not valid YAML .found duplicate key"),
        ("!!python/object/apply:os.system [ls]", "not valid YAML .could not determine a constr"),
        ("data: " + "[" * 1500, "nested too deeply"),
        ("data: &a {train: [*a]}\nsignals: {states: []}", "nested too deeply"),
        ("1: 2\n", "key 'data' is missing"),
    ],
)
def test_what_is_no_configuration(tmp_path, text, match):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(DfsmError, match=match) as caught:
        parse_config(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))


@given(raw=st.binary(max_size=40))
def test_any_bytes_are_a_sentence(tmp_path_factory, raw):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(raw)
    with pytest.raises(DfsmError, match=r"any\.yaml"):
        parse_config(path)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(DfsmError, match=r"none\.yaml cannot be read .*: make one with dfsm init"):
        parse_config(tmp_path / "none.yaml")
    folder = re.escape(f"{tmp_path} is a folder, a configuration file was expected: ")
    with pytest.raises(DfsmError, match=folder + "name one, or make one with dfsm init"):
        parse_config(tmp_path)
    for name in ("other.yml", "config.yaml", "third.yaml"):  # config.yaml wins over any other
        (tmp_path / name).touch()
        meant = "other.yml" if name == "other.yml" else "config.yaml"
        with pytest.raises(DfsmError, match=folder + rf"did you mean .*{meant}\?"):
            parse_config(tmp_path)


def test_the_example_of_these_tests_is_complete(tmp_path):
    assert parsed(tmp_path, CONFIG).signals.outputs == ["y", "z"]

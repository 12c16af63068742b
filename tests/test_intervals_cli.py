"""Prediction intervals at the command line: made, drawn on, and refused in one sentence."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import changed, files_of, write_config
from dfsm.core.bundle import checksum
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.models.model_folder import load
from dfsm.simulation.simulate import simulate
from dfsm.validation.intervals import load_intervals
from systems import DUFFING


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """Folder with three runs that no model has seen, and one more to test with."""
    base = tmp_path_factory.mktemp("fresh")
    time = np.arange(0, 15.01, 0.05)
    runs = DUFFING.many(4, [(0.3, 1.0), (0.0, 1.0)], time, seed=7)
    for name, run in zip(("c1", "c2", "c3", "new"), runs, strict=True):
        write_table(replace(run, name=name), base / f"{name}.parquet")
    return base


@pytest.fixture
def intervals(here, dfsm, fitted, fresh):
    """File of intervals of the fitted model, in the working folder."""
    shown = dfsm("calibrate", fitted, fresh / "c?.parquet", "-o", "i.json", "--quiet")
    assert (shown.code, shown.out, shown.err) == (0, "", "")
    return Path("i.json")


def test_calibrate_prints_half_widths_and_writes_them(here, dfsm, fitted, fresh):
    shown = dfsm("calibrate", fitted, fresh / "c?.parquet", "-o", "i.json", "--level", "0.8")
    assert (shown.code, shown.err) == (0, "")
    assert "a new run is expected inside 80 % of the time" in shown.out
    found = load_intervals("i.json")
    assert (found.level, found.runs, found.warnings) == (0.8, ("c1", "c2", "c3"), ())
    row = next(line.split() for line in shown.out.splitlines() if line.startswith("y "))
    half = found.half_width[:, found.channels.index("y")]
    assert row == ["y", f"{half.min():.4g}", f"{half.max():.4g}", "kN"]
    assert shown.out.splitlines()[-1].startswith("wrote i.json: ")
    # The window is that of the fit unless another is asked for.
    again = ("-o", "j.json", "--start", "1", "--level", "0.8")
    assert dfsm("calibrate", fitted, fresh / "c?.parquet", *again).code == 0
    assert (load_intervals("j.json").half_width == found.half_width).all()


def test_calibrate_names_runs_of_the_fit(here, dfsm, fitted, fresh):
    shown = dfsm("calibrate", fitted, fresh / "c1.parquet", "train/*.csv", "test/*", "-o", "i.json")
    assert shown.code == 0
    assert "1 of the 3 calibration runs were used in training (train/a.csv)" in shown.out


def test_simulate_writes_the_ends_too(here, dfsm, fitted, fresh, intervals):
    new = fresh / "new.parquet"
    shown = dfsm("simulate", fitted, new, "-o", "o.csv", "--intervals", intervals)
    assert (shown.code, shown.err) == (0, "")
    written, plain = read("o.csv"), ("q", "q_dot", "y", "z")
    assert written.names == (*plain, *(f"{n}_{end}" for n in plain for end in ("low", "high")))
    found, begin = load_intervals(intervals), float(written.time[0])
    rollout = simulate(load(fitted), read(new), start=begin)
    factor = found.growth.factor(written.time - begin, rollout.distance)
    assert (factor[0] < factor[-1]).all()
    for name, width in zip(plain, (found.half_width[0] * factor).T, strict=True):
        np.testing.assert_allclose(written[name] - written[f"{name}_low"], width, rtol=1e-6)
        np.testing.assert_allclose(written[f"{name}_high"] - written[name], width, rtol=1e-6)


def test_validate_shows_the_coverage(here, dfsm, fitted, fresh, intervals):
    options = ("--intervals", intervals, "-o", "r.html", "--json", "m.json")
    shown = dfsm("validate", fitted, fresh / "new.parquet", *options)
    assert (shown.code, shown.err) == (0, "")
    told = json.loads(Path("m.json").read_text())["intervals"]
    assert (told["level"], told["runs"]) == (0.9, ["c1", "c2", "c3"])
    row = next(line.split() for line in shown.out.splitlines() if line.startswith("y "))
    assert row[-4:] == [f"{100 * told['mean_coverage']['y']:.1f}", "%", "90", "%"]
    page = Path("r.html").read_text(encoding="utf-8")
    assert "where the record of a new run is expected 90 % of the time" in page
    shown = dfsm("validate", fitted, fresh / "c1.parquet", "--intervals", intervals)
    assert "1 of the 1 test runs calibrated the intervals" in shown.out


def test_bad_input_is_told_and_costs_nothing(here, dfsm, fitted, fresh, intervals):
    shutil.copytree(fitted, "m")
    for name in ("c1", "c2", "c3"):
        shutil.copy(fresh / f"{name}.parquet", ".")
    Path("x.json").write_text('{"format": 1, "runs": []}')
    write_config(Path("other.yaml"), changed("data", "train", value=["c1.parquet", "c2.parquet"]))
    before = files_of(here)
    runs = ("c1.parquet", "c2.parquet", "c3.parquet")
    cases = {
        "at least 3 runs, 2 were given": ("calibrate", "m", *runs[:2], "-o", "n.json"),
        "give either files or --config": ("calibrate", "m", "-o", "n.json"),
        "not fitted to the runs of other.yaml: it knows 0 of these 2": (
            *("calibrate", "m", "-o", "n.json", "--config", "other.yaml"),
        ),
        "level is 90.0, expected a share": ("calibrate", "m", *runs, "-o", "n.json", "--level", 90),
        "c1.parquet: a file of intervals ends": ("calibrate", "m", *runs, "-o", "c1.parquet"),
        "manifest.json is one of the files": ("calibrate", "m", *runs, "-o", "m/manifest.json"),
        "there is no folder no": ("calibrate", "m", *runs, "-o", "no/n.json"),
        "i.jsn: no such file": ("simulate", "m", runs[0], "-o", "o.csv", "--intervals", "i.jsn"),
        "x.json is no file of": ("validate", "m", runs[0], "--intervals", "x.json"),
        "i.json is one of": ("validate", "m", runs[0], "--json", "i.json", "--intervals", "i.json"),
    }
    for said, command in cases.items():
        assert said in dfsm(*command).sentence
    content = json.loads(intervals.read_text())
    content["channels"][0]["name"] = "p"
    Path("x.json").write_text(json.dumps(content))
    said = dfsm("validate", "m", runs[0], "--intervals", "x.json").sentence
    assert "x.json is damaged, it is not as it was written" in said
    content["checksum"] = checksum(content)
    Path("x.json").write_text(json.dumps(content))
    for command in (("simulate", "m", runs[0], "-o", "o.csv"), ("validate", "m", runs[0])):
        said = dfsm(*command, "--intervals", "x.json").sentence
        assert said.startswith("the intervals are of another model: their channels are p (m), ")
    Path("x.json").write_bytes(before["x.json"])
    assert files_of(here) == before

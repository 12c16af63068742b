"""What a stranger does at the command line: the five commands, their output and exit codes."""

from __future__ import annotations

import json
import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from conftest import changed, renamed, write_config
from dfsm.config.fit import load_config, parse_config
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.models.model_folder import load

CONSOLE = re.compile(r"[\x00-\x09\x0b-\x1f\x7f]")
# Names that would do harm where a name is taken for markup, code or an instruction.
HOSTILE = (
    "<img src=x onerror=alert(1)>",
    "[red]x[/red]",
    "a: b # c",
    "two\nlines",
    "quote\"s'",
    "{name}",
    "\x1b[2Jgone",
)


# -- info ---------------------------------------------------------------------------------------


def test_info_lists_every_run_and_channel(here, dfsm):
    shown = dfsm("info", "--each", "train/a.csv", "train/*.outb")
    assert shown.code == 0
    assert shown.err == ""
    assert not CONSOLE.search(shown.out)
    lines = shown.out.splitlines()
    heads = [line for line in lines if line.startswith("train/")]
    assert heads == [
        f"train/{n}: 301 samples, 0 to 15 s, every 0.05 s" for n in ("a.csv", "c.outb")
    ]
    q = read("train/c.outb").channel("q")
    row = [line.split() for line in lines if line.split()[0] == "q"][1]
    assert row[1] == "m"
    assert float(row[-1]) == pytest.approx(q.step, rel=1e-2)


def test_info_json_is_json_and_nothing_else(here, dfsm):
    shown = dfsm("info", "train/*", "--json")
    assert (shown.code, shown.err) == (0, "")
    found = json.loads(shown.out)
    assert [Path(r["source"]).name for r in found] == ["a.csv", "b.parquet", "c.outb"]
    run = read("train/b.parquet")
    channel = next(c for c in found[1]["channels"] if c["name"] == "q")
    assert channel["max"] == run["q"].max()
    assert found[1]["interval"] == pytest.approx(0.05)


def test_info_warns_of_what_looks_wrong(here, dfsm):
    Path("odd.csv").write_text("Time,p,q,r\n0,1,2,\n1,1,3,5\n2,1,4,6\n")
    shown = dfsm("info", "odd.csv")
    assert shown.code == 0
    assert "warning: 'p' is constant (1)" in shown.out
    assert "warning: 'r' has 1 NaN or infinite samples, the first at 0 s" in shown.out


@pytest.mark.parametrize("command", [("info",), ("info", "--json")])
def test_info_shows_hostile_names_as_text(here, dfsm, command):
    run = read("train/a.csv")
    write_table(renamed(run, dict(zip(run.names, HOSTILE, strict=False))), "x.parquet")
    shown = dfsm(*command, "x.parquet")
    assert (shown.code, shown.err) == (0, "")
    assert not CONSOLE.search(shown.out)
    if "--json" in command:
        names = [c["name"] for c in json.loads(shown.out)[0]["channels"]]
        assert names == list(HOSTILE[: len(run.names)])
    else:
        rows = shown.out.splitlines()[2:]
        assert len(rows) == len(run.names)
        for row, name in zip(rows, HOSTILE, strict=False):
            assert row.startswith(name.replace("\n", "\\n"))


# -- init ---------------------------------------------------------------------------------------


def turbine(path, *names):
    time = np.arange(0, 10, 0.1)
    columns = [np.sin(time * (i + 1)) for i in range(len(names))]
    text = ",".join(["Time [s]", *names]) + "\n"
    rows = np.column_stack([time, *columns])
    path.write_text(text + "\n".join(",".join(f"{v:.6f}" for v in row) for row in rows) + "\n")


def test_init_writes_a_config_that_reads_back_and_fits(here, dfsm):
    names = [
        "PtfmPitch [deg]",
        "GenSpeed [rpm]",
        "GenTq [kN-m]",
        "BldPitch1 [deg]",
        "RotWind [m/s]",
    ]
    for i in range(3):
        turbine(Path(f"r{i}.csv"), *names, f"Extra{i} [m]", "Same [m]")
    shown = dfsm("init", "r*.csv")
    assert shown.code == 0
    assert "wrote config.yaml" in shown.out
    config = parse_config(Path("config.yaml"))
    assert config.data.train == ["r0.csv", "r1.csv", "r2.csv"]
    assert [(s.name, s.order) for s in config.signals.states] == [("PtfmPitch", 2), ("GenSpeed", 1)]
    assert config.signals.controls == ["GenTq", "BldPitch1"]
    assert config.signals.disturbances == ["RotWind"]
    assert config.linear.kind == "LPV"
    text = Path("config.yaml").read_text()
    # The channels that all runs share, with units, as comments.
    assert re.search(r"^#   Same +m +-", text, re.MULTILINE)
    assert "Extra0" not in text
    assert "RtVAvgxh is measured" not in text


def test_init_does_not_replace_a_file_unless_forced(here, dfsm):
    Path("config.yaml").write_text("mine")
    assert "config.yaml exists" in dfsm("init", "train/*").sentence
    assert Path("config.yaml").read_text() == "mine"
    assert dfsm("init", "train/*", "--force", "--quiet").out == ""
    assert parse_config(Path("config.yaml")).data.train


def test_init_never_replaces_a_run(here, dfsm):
    shutil.copy("train/a.csv", "a.csv")
    before = Path("a.csv").read_bytes()
    said = dfsm("init", "a.csv", "-o", "a.csv", "--force").sentence
    assert said == "a.csv is one of the files to read: choose another name to write to"
    assert Path("a.csv").read_bytes() == before


def test_init_offers_the_corrected_wind(here, dfsm):
    turbine(Path("r.csv"), "PtfmPitch [deg]", "PtfmRVyt [deg/s]", "RtVAvgxh [m/s]")
    assert dfsm("init", "r.csv").code == 0
    text = Path("config.yaml").read_text()
    assert "# RtVAvgxh is measured on the moving rotor" in text
    # Doing what the note says gives a configuration that reads.
    text = text.replace("hub_height: null", "hub_height: 150")
    text = text.replace("disturbances: [RtVAvgxh]", "disturbances: [RtVAvgxhCorr]")
    text = text.replace("schedule: RtVAvgxh\n", "schedule: RtVAvgxhCorr\n")
    Path("config.yaml").write_text(text)
    config, _ = load_config("config.yaml")
    assert config.data.hub_height == 150
    assert config.fit_settings().hub_height == 150
    assert config.linear.schedule == "RtVAvgxhCorr"


def test_choosing_the_relative_wind_draws_a_warning(here, dfsm):
    run = read("train/a.csv")
    write_table(renamed(run, {"w": "RtVAvgxh"}), "r.parquet")
    config = changed("data", "train", value=["r.parquet"])
    config["signals"]["disturbances"] = ["RtVAvgxh"]
    config |= {"corrective": {"kind": "none"}}
    write_config(Path("c.yaml"), config)
    loud, quiet = dfsm("fit", "c.yaml", "-o", "m"), dfsm("fit", "c.yaml", "-o", "m", "--quiet")
    assert loud.code == quiet.code == 0
    assert "warning: 'RtVAvgxh' is the wind relative to the moving rotor" in loud.err
    assert "RtVAvgxhCorr" in loud.err
    assert (quiet.out, quiet.err) == ("", "")


@pytest.mark.parametrize("name", HOSTILE)
def test_names_cannot_break_the_config(here, dfsm, name):
    run = read("train/a.csv")
    file = name.replace("/", "|") + ".parquet"
    write_table(renamed(run, {"q": name, "u": "\u2028- evil: 1"}), file)
    names = read(file).names
    # A pattern, because some of these names are patterns themselves.
    assert dfsm("init", "*.parquet", "-o", "c.yaml", "--quiet").code == 0
    assert parse_config(Path("c.yaml")).data.train == [file]
    assert list(YAML(typ="safe").load(Path("c.yaml"))) == [
        *("data", "signals", "inputs", "derivatives", "linear", "terms"),
        *("corrective", "gate", "azimuth", "nonlinear_only", "refine", "seed"),
    ]
    assert names[0] == name


@pytest.mark.skipif(os.name == "nt", reason="file names are text there")
def test_a_file_name_that_is_no_text(here, dfsm):
    path = os.fsdecode(b"r\xff.csv")
    shutil.copy("train/a.csv", path)
    assert json.loads(dfsm("info", path, "--json").out)[0]["name"] == "r\udcff"
    assert dfsm("info", path).code == 0
    assert dfsm("init", path).code == 0
    assert parse_config(Path("config.yaml")).data.train == [path]
    config = changed("data", "train", value=[path]) | {"corrective": {"kind": "none"}}
    write_config(Path("c.yaml"), config)
    assert dfsm("fit", "c.yaml", "-o", "m").code == 0
    assert dfsm("validate", "m", path, "-o", "r.html", "--json", "r.json").code in (0, 1)
    assert json.loads(Path("r.json").read_text())["runs"]


# -- fit, summary -------------------------------------------------------------------------------


def test_fit_prints_a_summary_and_saves(here, dfsm, folder):
    config = changed("corrective", value={"kind": "none"})
    write_config(Path("config.yaml"), config)
    shown = dfsm("fit", "config.yaml", "-o", "m")
    assert (shown.code, shown.err) == (0, "")
    assert shown.out.startswith("states: q (m), q_dot (m/s)\ncontrols: u (N)\n")
    assert shown.out.splitlines()[-1].startswith("fitted 3 runs in ")
    assert sorted(p.name for p in Path("m").iterdir()) == ["manifest.json", "model.safetensors"]
    # A model folder, and only that, may be replaced, which is told.
    again = dfsm("fit", "config.yaml", "-o", "m")
    assert (again.code, again.err) == (0, "note: replaced the model that was in m\n")
    quiet = dfsm("fit", "config.yaml", "-o", "m", "--quiet")
    assert (quiet.out, quiet.err) == ("", "")
    Path("m2").mkdir()
    machine = dfsm("fit", "config.yaml", "-o", "m2", "--json")
    assert machine.err == ""
    record = json.loads(machine.out)
    assert record["settings"]["corrective"]["kind"] == "none"
    assert record["rows"][0]["decision"] == "kinematic, its rate is a state"


def test_summary_of_a_saved_model(dfsm, fitted):
    shown = dfsm("summary", fitted)
    assert (shown.code, shown.err) == (0, "")
    assert "outputs: y (kN), z (m)" in shown.out
    assert "q_ddot (m/s^2): corrected" in shown.out
    assert not CONSOLE.search(shown.out)


def test_summary_shows_control_characters_as_escapes(here, dfsm):
    run = read("train/a.csv")
    write_table(renamed(run, {"u": "\x1b[2Jgone"}), "r.parquet")
    config = changed("data", "train", value=["r.parquet"])
    config["signals"]["controls"] = ["\x1b[2Jgone"]
    write_config(Path("c.yaml"), config | {"corrective": {"kind": "none"}})
    for shown in (dfsm("fit", "c.yaml", "-o", "m"), dfsm("summary", "m")):
        assert shown.code == 0
        assert "controls: \\x1b[2Jgone (N)" in shown.out


# -- validate, simulate -------------------------------------------------------------------------


def test_validate_prints_a_table_and_writes_report_and_metrics(here, dfsm, fitted):
    Path("wall.json").write_text('{"d": 140.0}')
    options = ("-o", "r.html", "--json", "m.json", "--wall-times", "wall.json")
    shown = dfsm("validate", fitted, "test/*.outb", *options)
    assert (shown.code, shown.err) == (0, "")
    assert not CONSOLE.search(shown.out)
    assert "wrote r.html\nwrote m.json\n" in shown.out
    metrics = json.loads(Path("m.json").read_text())
    assert list(metrics["models"]) == ["linear-fit", "multi-fidelity", "nonlinear-only"]
    for variant in metrics["models"].values():
        # 140 s for 15 s of simulation, of which 14 s were compared.
        assert variant["speed_up"] * variant["wall_time_s"] == pytest.approx(140 * 14 / 15)
    row = next(line.split() for line in shown.out.splitlines() if line.startswith("y "))
    figures = [metrics["models"][m]["mean_nrmse"]["y"] for m in metrics["models"]]
    assert row[2:5] == [f"{v:.3f}" for v in figures]
    assert figures[1] < 0.2 < figures[0]
    assert Path("r.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    quiet = dfsm("validate", fitted, "test/d.outb", "--quiet", "--start", "5", "--stop", "9")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_simulate_writes_states_and_outputs(here, dfsm, fitted, suffix):
    shown = dfsm("simulate", fitted, "test/d.outb", "-o", f"out{suffix}")
    assert (shown.code, shown.err) == (0, "")
    assert shown.out.startswith(f"wrote out{suffix} (281 samples): ")
    result, recorded = read(f"out{suffix}"), read("test/d.outb").window(1.0)
    assert result.names == ("q", "q_dot", "y", "z")
    assert [c.unit for c in result.channels] == ["m", "m/s", "kN", "m"]
    np.testing.assert_allclose(result.time, recorded.time, atol=1e-9)
    error = np.std(result["q"] - recorded["q"]) / np.std(recorded["q"])
    assert error < 0.2


def test_simulate_with_a_stiff_method_as_json(here, dfsm, fitted):
    options = ("--start", "2", "--stop", "4", "--json")
    shown = dfsm("simulate", fitted, "test/d.outb", "-o", "a.csv", "--method", "kvaerno5", *options)
    assert (shown.code, shown.err) == (0, "")
    said = json.loads(shown.out)
    assert said["status"] == "completed"
    assert said["ended_s"] == pytest.approx(4)
    assert said["output"] == "a.csv"
    assert dfsm("simulate", fitted, "test/d.outb", "-o", "b.csv", *options[:4], "-q").out == ""
    np.testing.assert_allclose(read("a.csv").values, read("b.csv").values, rtol=1e-3, atol=1e-4)


def test_a_rollout_that_ends_early_exits_with_1_and_is_written(here, dfsm, fitted):
    # Driven a hundred times harder than in training, the state leaves its range.
    run = read("test/d.outb")
    values = run.values.copy()
    values[:, run.column("u")] = 1e4
    write_table(type(run)(run.time, values, run.channels), "wild.parquet")
    shown = dfsm("simulate", fitted, "wild.parquet", "-o", "out.csv")
    assert shown.code == 1
    assert shown.err == "1 of 1 simulations ended early\n"
    assert re.search(r"q(_dot)? reached .* at .* s \(training range", shown.out)
    assert 2 <= len(read("out.csv")) < 281
    machine = dfsm("simulate", fitted, "wild.parquet", "-o", "out.csv", "--json")
    assert (machine.code, machine.err) == (1, "")
    assert json.loads(machine.out)["status"] == "left_region"
    shown = dfsm("validate", fitted, "wild.parquet", "-o", "r.html", "--quiet")
    assert (shown.code, shown.out, shown.err) == (1, "", "")


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found = set()

    def handle_starttag(self, tag, attrs):
        self.found.add(tag)
        self.found.update(f"@{name}" for name, _ in attrs if name.startswith("on"))


def test_hostile_names_stay_text_from_file_to_report(here, dfsm):
    new = dict(zip("quwyz", HOSTILE, strict=False))
    for name in ("train/a.csv", "test/d.outb"):
        write_table(renamed(read(name), new), f"{Path(name).stem}.parquet")
    config = changed("data", "train", value=["a.parquet"]) | {"corrective": {"kind": "none"}}
    config["signals"] = {
        "states": [{"name": new["q"], "order": 2}],
        "controls": [new["u"]],
        "disturbances": [new["w"]],
        "outputs": [new["y"], new["z"]],
    }
    write_config(Path("c.yaml"), config)
    shown = dfsm("fit", "c.yaml", "-o", "m")
    assert (shown.code, shown.err) == (0, "")
    assert load("m").signals.names("states") == (new["q"], f"{new['q']}_dot")
    shown = dfsm("validate", "m", "d.parquet", "-o", "r.html", "--json", "r.json")
    assert (shown.code, shown.err) == (0, "")
    assert "two\\nlines" in shown.out
    assert [c["name"] for c in json.loads(Path("r.json").read_text())["channels"]][2:] == [
        new["y"],
        new["z"],
    ]
    tags = Tags()
    tags.feed(Path("r.html").read_text(encoding="utf-8"))
    assert not {t for t in tags.found if t == "img" or t.startswith("@")}

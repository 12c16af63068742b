"""Every kind of bad input, at the command line: exit 2, one sentence, and nothing lost."""

from __future__ import annotations

import json
import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.outb import outb_bytes, smooth_run
from conftest import CONFIG, changed, files_of, renamed, write_config
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Trajectory

NAMES, UNITS = ("a", "b", "c"), ("m", "", "kN")
NONE = {"kind": "none"}


def complaint(dfsm, config, output="m") -> str:
    """What `dfsm fit` says about a configuration; it must leave nothing behind."""
    path = write_config(Path("c.yaml"), config)
    before = files_of(Path())
    said = dfsm("fit", path, "-o", output).sentence
    assert files_of(Path()) == before
    return said


def altered(**columns) -> Trajectory:
    """A training run with some channels replaced, as `run.csv`."""
    run = read("train/a.csv")
    values = run.values.copy()
    for name, column in columns.items():
        values[:, run.column(name)] = column
    run = Trajectory(run.time, values, run.channels, name="run")
    write_table(run, "run.csv")
    return run


def trained_on(*files, **parts):
    return changed("data", "train", value=list(files)) | parts


# -- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [("info",), ("init",), ("fit",), ("validate",)])
def test_an_empty_glob(here, dfsm, fitted, command):
    pattern = "nothing/*.outb"
    if command == ("fit",):
        said = complaint(dfsm, trained_on(pattern))
    elif command == ("validate",):
        said = dfsm("validate", fitted, pattern).sentence
    else:
        said = dfsm(*command, pattern).sentence
    assert said.startswith(f"no file matches '{pattern}' in {here}")
    assert files_of(here).keys() <= {"c.yaml"}


def test_a_missing_file_suggests_near_names(here, dfsm):
    assert (
        "a.cvs: no such file; in train, did you mean 'a.csv'?"
        in dfsm("info", "train/a.cvs").sentence
    )


def test_an_empty_file_a_folder_and_a_foreign_kind(here, dfsm):
    Path("empty.outb").touch()
    Path("photo.png").write_bytes(b"\x89PNG\r\n")
    assert dfsm("info", "empty.outb").sentence.startswith("empty.outb is empty")
    assert dfsm("info", "train").sentence.startswith("train is a folder, a file was expected")
    assert "'.png' is no known kind of file" in dfsm("info", "photo.png").sentence


def test_bad_outb_files(here, dfsm):
    whole = outb_bytes(*smooth_run(), NAMES, UNITS)
    cases = {
        "cut.outb": whole[:-7],
        "header.outb": whole[:30],
        "id.outb": struct.pack("<h", 9) + whole[2:],
        "text.outb": b"this is no result file at all\n" * 20,
        "size.outb": whole[:2] + struct.pack("<ii", 3, 10**6) + whole[10:],
    }
    said = {}
    for name, raw in cases.items():
        Path(name).write_bytes(raw)
        said[name] = dfsm("info", name).sentence
        assert name in said[name]
    assert "format id 9" in said["id.outb"] or "9" in said["id.outb"]
    assert len(set(said.values())) == len(cases)


def test_a_ragged_row_names_file_and_line(here, dfsm):
    Path("r.csv").write_text("Time,a\n0,1\n1,2\n2,3,4\n")
    assert dfsm("info", "r.csv").sentence.startswith("r.csv, line 4: 3 values")
    Path("r.out").write_text("Time a\n(s) (m)\n0 1\n1 2\n2\n3 4\n")
    assert "r.out, line 5" in dfsm("info", "r.out").sentence


@pytest.mark.parametrize(
    ("times", "match"),
    [((0, 1, 1, 2), "time repeats at sample 2"), ((0, 2, 1, 3), "time goes back at sample 2")],
)
def test_time_that_does_not_increase(here, dfsm, times, match):
    Path("r.csv").write_text("Time,a\n" + "".join(f"{t},{t}\n" for t in times))
    said = dfsm("info", "r.csv").sentence
    assert said.startswith(f"r.csv: {match}")


# -- channels -----------------------------------------------------------------------------------


def test_an_unknown_channel_names_the_file_and_near_ones(here, dfsm):
    run = read("train/a.csv")
    channels = [replace(c, name={"w": "RotWind"}.get(c.name, c.name)) for c in run.channels]
    write_table(replace(run, channels=tuple(channels)), "r.csv")
    config = trained_on("r.csv")
    config["signals"]["disturbances"] = ["RotWnd"]
    assert complaint(dfsm, config) == "r.csv: no channel 'RotWnd'; did you mean 'RotWind'?"


@pytest.mark.parametrize("role", ["states", "controls", "disturbances", "parameters", "outputs"])
def test_unknown_channels_in_every_role(here, dfsm, role):
    value = [{"name": "nope"}] if role == "states" else ["nope"]
    said = complaint(dfsm, changed("signals", role, value=value))
    assert "no channel 'nope'; known are: q, v, u, w, y, z" in said
    assert said.startswith("train/a.csv: ")


def test_all_missing_channels_are_told_at_once(here, dfsm, fitted):
    run = read("train/a.csv")
    names = {"q": "PtfmPitch", "u": "GenTq", "w": "RotWind", "y": "GenPwr"}
    write_table(renamed(run, names), "r.csv")
    config = trained_on("r.csv", "train/b.parquet")
    config["signals"] |= {
        "states": [{"name": "ptfmpitch", "order": 2, "rate": "v_recorded"}],
        "controls": ["Tq"],
        "disturbances": ["RotWnd"],
        "outputs": ["z", "Power"],
    }
    assert complaint(dfsm, config) == (
        "r.csv: no channels 'ptfmpitch' (did you mean 'PtfmPitch'?), 'v_recorded', "
        "'Tq' (did you mean 'GenTq'?), 'RotWnd' (did you mean 'RotWind'?), 'Power'; known are: "
        "PtfmPitch, v, GenTq, RotWind, GenPwr, z"
    )
    config["signals"] |= {"states": [{"name": "ptfmpitch"}], "controls": [], "outputs": ["tq"]}
    assert complaint(dfsm, config) == (
        "r.csv: no channels 'ptfmpitch' (did you mean 'PtfmPitch'?), "
        "'RotWnd' (did you mean 'RotWind'?), 'tq' (did you mean 'GenTq'?)"
    )
    known = "known are: PtfmPitch, v, GenTq, RotWind, GenPwr, z"
    said = dfsm("simulate", fitted, "r.csv", "-o", "o.csv").sentence
    assert said == f"r.csv: no channels 'u', 'w', 'q'; {known}"
    said = dfsm("validate", fitted, "test/d.outb", "r.csv").sentence
    assert said == f"r.csv: no channels 'u', 'w', 'q', 'y'; {known}"


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["q", "u", "w", "y"])
def test_a_used_channel_that_is_not_finite(here, dfsm, name, bad):
    column = read("train/a.csv")[name].copy()
    column[[40, 50]] = bad
    altered(**{name: column})
    said = complaint(dfsm, trained_on("run.csv"))
    assert said.startswith(
        f"run.csv: channel '{name}' has 2 NaN or infinite samples, the first at 2"
    )


def test_an_unused_channel_that_is_not_finite_does_no_harm(here, dfsm):
    altered(v=np.nan)
    write_config(Path("c.yaml"), trained_on("run.csv", corrective=NONE))
    assert dfsm("fit", "c.yaml", "-o", "m").code == 0


def test_units_that_differ_between_files(here, dfsm):
    run = read("train/a.csv")
    channels = [replace(c, unit="m" if c.name == "u" else c.unit) for c in run.channels]
    write_table(replace(run, channels=tuple(channels)), "metre.csv")
    said = complaint(dfsm, trained_on("metre.csv", "train/b.parquet"))
    assert "channel 'u' is in " in said
    for part in ("'m'", "'N'", "metre.csv", "b.parquet", "convert one of them"):
        assert part in said
    # Of one dimension they are converted, and that is told.
    channels = [replace(c, unit="kN" if c.name == "u" else c.unit) for c in run.channels]
    write_table(replace(run, channels=tuple(channels)), "kilo.csv")
    write_config(Path("c.yaml"), trained_on("kilo.csv", "train/b.parquet", corrective=NONE))
    said = dfsm("fit", "c.yaml", "-o", "m")
    assert said.code == 0
    assert "units converted: 'u' from kN to N" in said.err


def test_the_same_run_twice(here, dfsm):
    shutil.copy("train/a.csv", "copy.csv")
    said = complaint(dfsm, trained_on("copy.csv", "train/a.csv"))
    assert "hold the same data: give each run once" in said
    assert "copy.csv" in said
    assert "train/a.csv" in said
    # The same file named twice is one file.
    write_config(Path("c.yaml"), trained_on("copy.csv", "./copy.csv", "*.csv", corrective=NONE))
    assert "fitted 1 run in" in dfsm("fit", "c.yaml", "-o", "m").out


@pytest.mark.parametrize(("role", "name"), [("control", "u"), ("disturbance", "w")])
def test_an_input_that_never_varies(here, dfsm, role, name):
    altered(**{name: 0.25})
    said = complaint(dfsm, trained_on("run.csv"))
    assert said.startswith(f"{role} '{name}' is 0.25 throughout all 1 runs")


def test_a_parameter_that_varies_within_a_run(here, dfsm):
    config = changed("signals", "parameters", value=["v"])
    said = complaint(dfsm, config)
    assert re.fullmatch(
        r"train/.*: parameter 'v' goes from -?[\d.]+ to [\d.]+ m/s, but parameters are constant "
        "within a run: give it as a disturbance or control",
        said,
    )
    # Only what is used counts: here it changes before the window.
    for file in ("train/a.csv", "train/b.parquet"):
        run = read(file)
        values = run.values.copy()
        values[:, run.column("v")] = np.where(run.time < 0.5, 7.0, len(file))
        write_table(replace(run, values=values), Path(file).with_suffix(".csv").name)
    config |= {"corrective": NONE}
    config["data"]["train"] = ["a.csv", "b.csv"]
    write_config(Path("c.yaml"), config)
    assert dfsm("fit", "c.yaml", "-o", "m").code == 0
    assert "parameter 'v' goes from" in dfsm("simulate", "m", "test/d.outb", "-o", "o.csv").sentence


def test_a_state_that_never_varies(here, dfsm):
    altered(q=1.5)
    assert "state 'q' is constant" in complaint(dfsm, trained_on("run.csv"))


# -- settings that do not fit the data ----------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "value", "window"),
    [
        ("start", 100, r"(100.0 to … s)"),
        ("stop", 1.01, "(1.0 to 1.01 s)"),
        ("start", float("nan"), "(nan to … s)"),
    ],
)
def test_a_run_shorter_than_the_window(here, dfsm, key, value, window):
    said = complaint(dfsm, changed("data", key, value=value))
    assert said.startswith("train/a.csv: runs from 0 s to 15 s, shorter than the time window")
    assert window in said


def test_fewer_samples_than_unknowns(here, dfsm):
    config = changed("data", "stop", value=1.1)
    data = dict(config["data"]) | {"train": ["train/a.csv"]}
    said = complaint(dfsm, config | {"data": data, "corrective": NONE})
    assert "samples" in said
    assert "5 unknowns per target of the linear fit" in said


def test_more_units_than_samples(here, dfsm):
    said = complaint(dfsm, changed("corrective", "samples", value=10_000))
    assert said.startswith("10000 points were asked for but there are only 843 samples")


@pytest.mark.parametrize(
    ("linear", "start"),
    [
        ({"schedule": "w", "points": 1}, "linear.points is 1, an LPV fit needs at least 2"),
        ({"schedule": "w", "points": -3}, "linear.points is -3, an LPV fit needs at least 2"),
        ({"schedule": "wind"}, "linear.schedule 'wind' is not an input of the model: choose one"),
        ({"schedule": "y"}, "linear.schedule 'y' is not an input of the model: choose one"),
    ],
)
def test_bad_schedules(here, dfsm, linear, start):
    said = complaint(dfsm, changed("linear", value={"kind": "LPV", **linear}))
    assert said.startswith(start)


@pytest.mark.parametrize(
    ("key", "value", "start"),
    [
        ("azimuth", {"speed": "q"}, "azimuth.speed 'q' is in 'm', expected one of rpm"),
        ("azimuth", {"speed": "w"}, "azimuth.speed "),
        (
            "derivatives",
            {"filters": {"q": {"kind": "low_pass", "cutoff": 99}}},
            "train/",
        ),
    ],
)
def test_settings_that_do_not_fit_the_channels(here, dfsm, key, value, start):
    assert complaint(dfsm, CONFIG | {key: value}).startswith(start)


def test_an_output_that_is_a_state(here, dfsm):
    said = complaint(dfsm, changed("signals", "outputs", value=["q"]))
    assert said == "'q' is a state, which models simulate: leave it out of outputs"


def test_a_binary_file_or_a_folder_as_config(here, dfsm):
    said = dfsm("fit", "train/c.outb", "-o", "m").sentence
    assert said.startswith("train/c.outb is not valid YAML")
    said = dfsm("fit", "train", "-o", "m").sentence
    assert said.startswith("train is a folder, a configuration file was expected")
    assert dfsm("fit", "none.yaml", "-o", "m").sentence.startswith("none.yaml cannot be read")
    assert not Path("m").exists()


# -- using a model ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["q", "u", "w"])
def test_a_run_that_lacks_what_drives_the_model(here, dfsm, fitted, name):
    run = read("test/d.outb")
    write_table(run.select([n for n in run.names if n != name]), "r.csv")
    for command in (("simulate", fitted, "r.csv", "-o", "o.csv"), ("validate", fitted, "r.csv")):
        assert dfsm(*command).sentence.startswith(f"r.csv: no channel '{name}'; known are: ")
    assert not Path("o.csv").exists()


def test_validation_needs_the_outputs_and_simulation_does_not(here, dfsm, fitted):
    write_table(read("test/d.outb").select(["q", "u", "w"]), "r.csv")
    said = dfsm("validate", fitted, "r.csv", "-o", "r.html", "--json", "r.json").sentence
    assert said == "r.csv: no channels 'y', 'z'; known are: q, u, w"
    assert files_of(here).keys() == {"r.csv"}
    assert dfsm("simulate", fitted, "r.csv", "-o", "o.csv").code == 0
    assert read("o.csv").names == ("q", "q_dot", "y", "z")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (("--method", "euler"), "--method is 'euler', expected one of rk4, tsit5, kvaerno5"),
        (("--step", "0"), "the simulation step is 0.0 s, expected more than 0"),
        (("--step", "-1"), "the simulation step is -1.0 s"),
        (("--step", "nan"), "the simulation step is nan s"),
        (("--step", "1e-9"), "steps of 1e-09 s over 14 s make 1.4e+10 steps, at most 10,000,000"),
        (("--step", "1e-320"), "make inf steps"),
        (("--start", "9", "--stop", "4"), "from 9 s to 4 s: swap the two"),
        (("--start", "soon"), "invalid value for '--start'"),
    ],
)
def test_bad_options_of_simulate(here, dfsm, fitted, options, match):
    assert match in dfsm("simulate", fitted, "test/d.outb", "-o", "o.csv", *options).sentence
    assert not Path("o.csv").exists()


def test_wall_times_that_are_none(here, dfsm, fitted):
    for content in ("[1]", "{", '{"d": "fast"}', '{"d": null}'):
        Path("w.json").write_text(content)
        said = dfsm("validate", fitted, "test/d.outb", "--wall-times", "w.json").sentence
        assert said == "w.json is not a JSON table of run names and seconds"
    assert "no such file" in dfsm("validate", fitted, "test/d.outb", "--wall-times", "x").sentence
    for value in ("-3", "0", "NaN", "Infinity"):
        Path("w.json").write_text(f'{{"c": 1, "d": {value}}}')
        said = dfsm("validate", fitted, "test/d.outb", "--wall-times", "w.json").sentence
        assert said.startswith(f"w.json: the wall time of 'd' is {value.lower()[:3]}")
        assert "expected a positive number" in said


@pytest.mark.parametrize("command", ["summary", "validate", "simulate"])
def test_bad_model_folders(here, dfsm, fitted, command):
    def said(path) -> str:
        rest = {"validate": ("test/d.outb",), "simulate": ("test/d.outb", "-o", "o.csv")}
        return dfsm(command, path, *rest.get(command, ())).sentence

    assert "is missing; a model folder" in said("none")
    assert "holds no manifest.json" in said("test")
    shutil.copytree(fitted, "m")
    manifest = json.loads(Path("m/manifest.json").read_text())
    Path("m/manifest.json").write_text(json.dumps(manifest | {"format": 99}))
    assert "m has format 99" in said("m")
    Path("m/manifest.json").write_text(json.dumps(manifest | {"models": 1}))
    assert "m is damaged: manifest.json is not as it was written" in said("m")
    Path("m/manifest.json").write_text("{garbled")
    assert "m is damaged: manifest.json cannot be read" in said("m")
    Path("m/manifest.json").write_text(json.dumps(manifest))
    Path("m/model.safetensors").write_bytes(b"")
    assert "model.safetensors is not the file" in said("m")
    Path("m/model.safetensors").unlink()
    assert "m is damaged: model.safetensors cannot be read" in said("m")

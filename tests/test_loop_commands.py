"""The commands that close loops refuse before any work, in one sentence, with exit code 2."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from conftest import write_config
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table

OWN = """
import dfsm
mine = dfsm.PID(
    kp=-0.5, ki=-0.1, setpoint=0.0, measurements=["q"], measurement_units=["m"],
    commands=["u"], command_units=["N"], interval=0.05,
)
class Own:
    measurements, measurement_units, commands, command_units = ("q",), ("m",), ("u",), ("N",)
    interval = 0.0
    def start(self, measurements, commands):
        return 0.0
    def step(self, state, measurements, time):
        return state, [0.0]
class Needs(Own):
    def __init__(self, gain):
        self.gain = gain
without = Own()
without.measurement_units = ()
"""
SWEEP = {"gains": {"kp": [-1.0, -0.5]}}
TUNE = {"parameters": {"kp": [-3.0, 0.5]}, "objective": [{"measure": "std", "channel": "q"}]}


@pytest.fixture
def asked(here, fitted):
    """What a file of `dfsm sweep` or `dfsm tune` names, in a folder that holds it."""
    Path("control.py").write_text(OWN)
    return {"model": str(fitted), "controller": "control.py:mine", "runs": "test/d.outb"}


@pytest.mark.parametrize("interval", ["0.1", "-7", "0", "nan"])
def test_an_own_controller_has_its_own_interval(asked, dfsm, interval):
    loop = ("closed-loop", asked["model"], "test/d.outb", "--controller", "control.py:mine")
    said = dfsm(*loop, "-o", "out", "--interval", interval)
    assert said.code == 2
    assert said.sentence.startswith("--interval goes with a DISCON.IN, not with a controller in Py")
    for command, more in (("sweep", SWEEP), ("tune", TUNE)):
        write_config(Path("c.yaml"), asked | more | {"interval": float(interval)})
        said = dfsm(command, "c.yaml", "-o", "out")
        assert said.code == 2
        assert said.sentence.startswith("interval goes with a DISCON.IN, not with a controller")


def test_a_controller_of_a_file_is_checked(asked, dfsm):
    for name, sentence in (
        ("Own", "'Own' of control.py: interval is 0.0, expected seconds, more than 0"),
        ("Needs", "'Needs' of control.py is a class that fails with TypeError: "),
        ("without", "'without' of control.py: measurement_units is (), expected one for each of"),
    ):
        loop = ("closed-loop", asked["model"], "test/d.outb", "--controller", f"control.py:{name}")
        said = dfsm(*loop, "-o", "out")
        assert said.code == 2
        assert said.sentence.startswith(sentence)


@pytest.mark.parametrize(
    ("command", "more", "sentence"),
    [
        ("sweep", SWEEP | {"runs": []}, "runs is empty, expected at least one"),
        ("tune", TUNE | {"runs": []}, "runs is empty, expected at least one"),
        ("sweep", SWEEP | {"weights": []}, "weights is [], expected one per run, 1"),
        ("tune", TUNE | {"weights": []}, "weights is [], expected one per run"),
        ("sweep", SWEEP | {"speed": "q", "rated_speed": 0}, "rated_speed is 0.0, expected more"),
        ("sweep", {"gains": {"kp": [float("nan")]}}, "a value of kp is nan, expected a list of"),
        ("sweep", {"gains": {"kp": [1.0, 1.0]}}, "values of kp is [1.0, 1.0], expected a list of"),
        ("sweep", SWEEP | {"start": float("nan")}, "start is nan, expected seconds, or None"),
        ("sweep", SWEEP | {"start": 500.0}, "start is 500 s, expected a time within the run"),
        ("tune", TUNE | {"stop": float("nan")}, "stop is nan, expected seconds, or None"),
        (
            "tune",
            TUNE | {"constraints": [{"measure": "std", "channel": "q", "at_most": float("nan")}]},
            "at_most of std of q is nan, expected a finite number",
        ),
    ],
)
def test_files_of_loops_are_checked(asked, dfsm, command, more, sentence):
    write_config(Path("c.yaml"), asked | more)
    said = dfsm(command, "c.yaml", "-o", "out")
    assert said.code == 2
    assert sentence in said.sentence


def test_runs_of_one_name_are_refused_before_the_work(asked, dfsm):
    for file, name in (("one/R.parquet", "r"), ("two/r.parquet", "R"), ("x.parquet", "r")):
        Path(file).parent.mkdir(exist_ok=True)
        write_table(replace(read("test/d.outb"), name=name), file)
    for one, two, target, cure in (
        ("one/R", "two/r", "R", "rename one of them, or write them to different folders"),
        ("two/r", "x", "r", "both hold the name 'r', write one of them again with another"),
    ):
        files = (f"{one}.parquet", f"{two}.parquet")
        loop = ("closed-loop", asked["model"], *files, "--controller", "control.py:mine")
        said = dfsm(*loop, "-o", "out")
        both = f"{one}.parquet and {two}.parquet would both be"
        assert said.sentence == f"{both} written to out/{target}.parquet: {cure}"
    runs = ["one/R.parquet", "two/r.parquet"]
    more = {"runs": runs, "truth": {"folder": "flown"}, "start_up": 2.0}
    write_config(Path("c.yaml"), asked | TUNE | more)
    said = dfsm("tune", "c.yaml", "-o", "tuned")
    both = "one/R.parquet and two/r.parquet would both be looked for as flown/flight_1/R: rename"
    assert said.sentence == f"{both} one of them"
    assert not Path("out").exists()
    assert not Path("flown").exists()


def test_other_files_are_not_written_into_a_model(asked, dfsm):
    folder = Path(asked["model"])
    before = sorted(folder.iterdir())
    write_config(Path("c.yaml"), asked | SWEEP)
    Path("wind.wnd").write_text("".join(f"{t} 9 0 0 0 0 0 0\n" for t in range(3)))
    for command in (
        ("closed-loop", folder, "test/d.outb", "--controller", "control.py:mine"),
        ("sweep", "c.yaml"),
        ("wind", "wind.wnd", "test/d.outb", "--radius", "3", "--hub-height", "5"),
    ):
        said = dfsm(*command, "-o", folder)
        assert said.code == 2
        assert "a model or a solution, which other files would damage" in said.sentence
    assert sorted(folder.iterdir()) == before


def test_an_fmu_has_the_suffix_of_one(asked, dfsm):
    said = dfsm("export", "fmu", asked["model"], "-o", "x.txt")
    assert said.code == 2
    assert said.sentence.startswith("x.txt has the suffix '.txt', expected .fmu")
    assert not Path("x.txt").exists()

"""A sweep that was ended goes on where it stood, and takes over nothing of other loops."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

import dfsm as package
from conftest import write_config
from dfsm.errors import DfsmError
from dfsm.loops import sweep_journal
from systems import driving_run, law, linear_model

TIME = np.arange(0, 20.01, 0.1)


class Stepped:
    """A controller of one's own that JAX cannot follow."""

    measurements, measurement_units, commands, command_units = ("q",), ("m",), ("u0",), ("N",)
    interval = 0.1

    def __init__(self, gain):
        self.gain = gain

    def start(self, measurements, commands):
        return 0.0

    def step(self, state, measurements, time):
        return state, np.array([self.gain * (0.2 - float(measurements[0]))])


class Written(eqx.Module):
    """A controller whose gain stands in its code."""

    gain: float = eqx.field(static=True)
    measurements = ("q",)
    measurement_units = ("m",)
    commands = ("u0",)
    command_units = ("N",)
    interval = 0.1

    def start(self, measurements, commands):
        return 0.0 * measurements[0]

    def step(self, state, measurements, time):
        return state, self.gain * (0.2 - measurements)


@pytest.fixture
def asked():
    """Model, runs and settings of a sweep."""
    A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0, 0.0], [2.0, 0.5]])
    model = linear_model(A, B, np.array([[1.0, 0.0]]), names=["q", "v"])
    runs = []
    for i, size in enumerate((1.0, 3.0)):
        inputs = np.stack([0 * TIME, size * np.sin(1.7 * TIME)], axis=1)
        runs.append(driving_run(model, TIME, inputs, np.tile([0.5, 0], (len(TIME), 1)), f"r{i}"))
    settings = package.SweepSettings(
        loop=package.ClosedLoopSettings(start_up=2.0), extremes=("q",), block=2.5
    )
    laws = {"soft": law(0.2), "wrong": law(-80.0), "own": Stepped(0.4), "written": Written(0.3)}
    return {"model": model, "runs": runs, "controllers": laws, "settings": settings}


@pytest.fixture
def closed(monkeypatch):
    """Names of the runs of the loops that were closed, which is to be cleared."""
    names, of = [], sweep_journal.SweptLoop.of

    def counted(loop, *more):
        names.append(loop.trajectory.name)
        return of(loop, *more)

    monkeypatch.setattr(sweep_journal.SweptLoop, "of", counted)
    return names


def test_a_sweep_goes_on_and_is_equal_to_the_digit(asked, closed, tmp_path):
    journal = tmp_path / "loops.jsonl"
    whole = package.sweep(**asked)
    assert len(closed) == 8
    assert package.sweep(**asked, journal=journal).to_dict() == whole.to_dict()
    lines = journal.read_text().splitlines(keepends=True)
    assert len(lines) == 9
    # It was killed in the middle of the fourth line.
    journal.write_text("".join(lines[:4]) + lines[4][:70])
    closed.clear()
    assert package.sweep(**asked, journal=journal).to_dict() == whole.to_dict()
    assert len(closed) == 5
    closed.clear()
    assert package.sweep(**asked, journal=journal).to_dict() == whole.to_dict()
    assert closed == []
    # Weights and years are not of the loops.
    other = asked | {"weights": [0.1, 0.2], "settings": replace(asked["settings"], years=20.0)}
    expected = package.sweep(**other)
    closed.clear()
    assert package.sweep(**other, journal=journal).to_dict() == expected.to_dict()
    assert closed == []


def test_what_belongs_to_other_loops_is_closed_again(asked, closed, tmp_path):
    model, runs, laws, settings = asked.values()
    journal = tmp_path / "loops.jsonl"
    louder = replace(runs[1], values=runs[1].values * 1.001)
    stiffer = replace(model, f=replace(model.f, coefficients=model.f.coefficients * 1.01))
    named = replace(model.signals.outputs[0], unit="MN")
    renamed = replace(model, signals=replace(model.signals, outputs=(named,)))
    later = replace(settings, loop=package.ClosedLoopSettings(start_up=3.0))
    for change, expected in (
        ({"runs": [runs[0], louder]}, ["r1"] * 4),
        ({"controllers": laws | {"soft": law(0.21)}}, ["r0", "r1"]),
        ({"controllers": laws | {"own": Stepped(0.5)}}, ["r0", "r1"]),
        ({"controllers": laws | {"written": Written(0.31)}}, ["r0", "r1"]),
        ({"controllers": {"other name": law(0.2)}}, []),
        ({"model": stiffer}, ["r0"] * 4 + ["r1"] * 4),
        ({"model": renamed}, ["r0"] * 4 + ["r1"] * 4),
        ({"settings": later}, ["r0"] * 4 + ["r1"] * 4),
        ({"settings": replace(settings, stop=15.0)}, ["r0"] * 4 + ["r1"] * 4),
        ({"settings": replace(settings, block=2.0)}, ["r0"] * 4 + ["r1"] * 4),
    ):
        package.sweep(**asked, journal=journal)
        whole = package.sweep(**(asked | change))
        closed.clear()
        went_on = package.sweep(**(asked | change), journal=journal)
        assert went_on.to_dict() == whole.to_dict()
        assert sorted(closed) == expected


def test_code_that_is_in_no_file_is_closed_again(asked, closed, tmp_path):
    names = dict(Stepped=Stepped)
    exec("class Typed(Stepped):\n    def start(self, m, c):\n        return 1.0\n", names)
    typed = asked | {"controllers": {"typed": names["Typed"](0.4)}}
    for _ in range(2):
        closed.clear()
        package.sweep(**typed, journal=tmp_path / "loops.jsonl")
        assert sorted(closed) == ["r0", "r1"]


def test_another_file_is_no_journal(asked, tmp_path):
    other = tmp_path / "notes.txt"
    other.write_text("mine\n")
    with pytest.raises(DfsmError, match=r"notes\.txt holds no loops of a sweep: choose another"):
        package.sweep(**asked, journal=other)
    assert other.read_text() == "mine\n"
    with pytest.raises(DfsmError, match="journal is 3, expected the path of a file, or None"):
        package.sweep(**asked, journal=3)


OWN = """
import time
import numpy as np

class Slow:
    measurements, measurement_units, commands, command_units = ("q",), ("m",), ("u",), ("N",)
    interval = 0.05
    def __init__(self, kp):
        self.kp = kp
    def start(self, measurements, commands):
        return 0.0
    def step(self, state, measurements, at):
        time.sleep(2e-3)
        return state, -self.kp * np.asarray(measurements)

mine = Slow(0.5)
"""


@pytest.mark.skipif(os.name == "nt", reason="no signals there")
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT])
def test_the_command_goes_on_where_it_was_ended(here, dfsm, fitted, sent):
    Path("control.py").write_text(OWN)
    runs = ["test/d.outb", *sorted(map(str, Path("train").glob("*")))]
    asked = {"model": str(fitted), "controller": "control.py:mine", "runs": runs}
    write_config(Path("c.yaml"), asked | {"start": 2.0, "start_up": 1.0})
    assert dfsm("sweep", "c.yaml", "-o", "whole").code == 0
    command = [sys.executable, "-c", "from dfsm.cli import main; main()"]
    process = subprocess.Popen(
        [*command, "sweep", "c.yaml", "-o", "out"], stderr=subprocess.PIPE, text=True
    )
    journal, begin = Path("out/loops.jsonl"), time.monotonic()
    while not journal.exists() or journal.read_text().count("\n") < 2:
        assert time.monotonic() < begin + 60
        time.sleep(0.01)
    process.send_signal(sent)
    _, err = process.communicate(timeout=60)
    if sent is signal.SIGINT:
        assert process.returncode == 130
        assert err.strip() == "interrupted: nothing was left half-written"
    kept = journal.read_text().count("\n") - 1
    assert 1 <= kept < len(runs)
    assert not Path("out/sweep.json").exists()
    assert dfsm("sweep", "c.yaml", "-o", "out").code == 0
    for name in ("sweep.json", "sweep.csv"):
        assert Path("out", name).read_bytes() == Path("whole", name).read_bytes()
    assert len(journal.read_text().splitlines()) == len(runs) + 1
    assert json.loads(Path("out/sweep.json").read_text())["runs"][0]["name"] == "d"

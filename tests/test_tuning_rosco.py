"""Tuning ROSCO from the command line: from a file to a DISCON.IN, whose loop is the predicted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dfsm as package
from conftest import write_config
from decks import write_deck
from dfsm.data.readers.tables import write_table
from dfsm.models.model_folder import save
from systems import linear_model

# No more modes than the loop of pitch and speed needs: each is compiled.
DECK = {
    **{"VS_ControlMode": "3", "VS_ConstPower": "1", "WE_Mode": "0", "Fl_Mode": "0"},
    **{"PA_Mode": "0", "SS_Mode": "0", "PS_Mode": "0", "F_GenSpdNotch_N": "0", "F_LPFType": "1"},
}
TIME = np.arange(0, 30.01, 0.2)
SPEED, PITCH, TORQUE, WIND = 7.56, 12.0, 19786.8, 16.0


def turbine() -> package.DFSM:
    """A rotor about its operating point at 16 m/s, in the channels of OpenFAST."""
    gains = np.array([[-1e-4, -0.05, 0.06]])
    model = linear_model(np.array([[-0.02]]), gains, names=["GenSpeed"], units=["rpm"])
    s, region = model.signals, model.region
    order = [TORQUE, PITCH, WIND, SPEED]
    rest = -float(np.append(gains[0], -0.02) @ order)
    named = {"u0": ("GenTq", "kN-m"), "u1": ("BldPitch1", "deg"), "u2": ("RotWind", "m/s")}
    torque, pitch, wind = (
        replace(c, name=named[c.name][0], unit=named[c.name][1]) for c in s.controls
    )
    signals = replace(
        s, controls=(torque, pitch), disturbances=(replace(wind, role="disturbance"),)
    )
    middle, half = np.array(order), np.array([2e4, 20.0, 10.0, 5.0])
    return replace(
        model,
        f=replace(model.f, offsets=model.f.offsets + rest),
        region=replace(region, low=middle - half, high=middle + half, mean=middle, std=half / 3),
        signals=signals,
    )


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Model, deck, one run and the file that asks."""
    monkeypatch.chdir(tmp_path)
    model = turbine()
    save(model, tmp_path / "model")
    write_deck(tmp_path, **DECK)
    wind = WIND + np.sin(0.5 * TIME) + 0.5 * np.sin(1.3 * TIME)
    still = np.ones((len(TIME), 3)) * [SPEED, TORQUE, PITCH]
    channels = (*model.signals.states, *model.signals.controls, *model.signals.disturbances)
    run = package.Trajectory(TIME, np.column_stack([still, wind]), channels, name="gusts")
    write_table(run, tmp_path / "gusts.csv")
    return tmp_path


CONFIG = {
    "model": "model",
    "controller": "DISCON.IN",
    "runs": "gusts.csv",
    "start_up": 4.0,
    "parameters": {"PC_GS_KP.factor": [0.5, 3.0]},
    "objective": [
        {"measure": "std", "channel": "GenSpeed"},
        {"measure": "travel", "channel": "BldPitch1", "weight": 0.2},
    ],
    "iterations": 6,
}


def test_a_file_becomes_a_deck_whose_loop_is_what_was_predicted(folder, dfsm):
    write_config(folder / "tune.yaml", CONFIG)
    shown = dfsm("tune", "tune.yaml", "-o", "result")
    assert (shown.code, shown.err) == (0, ""), shown
    said = json.loads(Path("result/tuning.json").read_text())
    assert said["objective"]["after"] < 0.95 * said["objective"]["before"]
    # Only the line of one key is another, with its values to the last digit, and the path of the
    # rotor's table, which counts from the folder of the deck.
    before, after = (Path(p).read_bytes().splitlines() for p in ("DISCON.IN", "result/DISCON.IN"))
    pairs = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    keys = [line.partition(b"!")[2].split()[0].decode() for line, _ in pairs]
    assert keys == ["PC_GS_KP", "PerfFileName"]
    assert set(said["changes"]) == {"PC_GS_KP"}
    (factor,) = (p["after"] for p in said["parameters"].values())
    deck, was = package.read_discon("result/DISCON.IN"), package.read_discon("DISCON.IN")
    assert deck.file("PerfFileName").samefile(was.file("PerfFileName"))
    np.testing.assert_allclose(deck.array("PC_GS_KP"), factor * was.array("PC_GS_KP"), rtol=1e-15)
    # The written file in a loop of its own gives the figures that were told.
    law = package.read_rosco("result/DISCON.IN", interval=0.2)
    loop = package.closed_loop(
        package.load("model"), package.read("gusts.csv"), law,
        settings=package.ClosedLoopSettings(start_up=4.0),
    ).trajectory  # fmt: skip
    speed, blade = loop["GenSpeed"], loop["BldPitch1"]
    told = [m["after"] for m in said["measures"]]
    found = [speed.std(), np.abs(np.diff(blade)).sum() / (loop.time[-1] - loop.time[0])]
    np.testing.assert_allclose(found, told, rtol=1e-9)

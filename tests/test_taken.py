"""What a model takes of a run, so that its exports can be driven with it."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from dfsm import model_inputs
from dfsm.data.features import Feature
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning, hushed
from dfsm.exports.python_model import write_python
from dfsm.models.dfsm import DFSM
from dfsm.models.model_folder import save
from dfsm.simulation.simulate import simulate
from exported import close
from systems import linear_model

TIME = np.arange(0, 60.05, 0.1)
RATE = Feature(source="wave")
LATE = Feature(source="wave", kind="delay", seconds=1.0)
EARLY = Feature(source="wave", kind="lead", seconds=2.0)


def model() -> DFSM:
    """A hull that waves' rate, their past and their future act on."""
    A, B = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0] * 4, [1.0, 0.5, 0.3, -0.2]])
    made = linear_model(A, B, names=["q", "v"])
    channels = (Channel("force", "N"), Channel(RATE.name, "m/s"))
    channels += (Channel(LATE.name, "m"), Channel(EARLY.name, "m"))
    features = (RATE, LATE, EARLY)
    signals = replace(
        made.signals, controls=channels[:1], disturbances=channels[1:], features=features
    )
    return replace(made, signals=signals)


def record() -> Trajectory:
    """In other units than the model's, with more than it takes."""
    wave = 100 * np.sin(0.7 * TIME)
    values = np.stack([0 * TIME, wave, np.cos(0.2 * TIME), TIME], axis=1)
    channels = (Channel("v", "m"), Channel("wave", "cm"), Channel("force", "N"), Channel("x", "m"))
    return Trajectory(TIME, values, channels, name="sea")


def test_computed_inputs_come_in_the_units_of_the_model():
    with pytest.warns(DfsmWarning, match="cm"):
        taken = model_inputs(model(), record(), start=1.0, stop=58.0)
    assert taken.names == ("force", "wave_dot", "wave_delay1", "wave_lead2")
    assert [c.unit for c in taken.channels] == ["N", "m/s", "m", "m"]
    assert (taken.time[0], taken.time[-1]) == pytest.approx((1, 58))
    t = taken.time
    exact = [np.cos(0.2 * t), 0.7 * np.cos(0.7 * t), np.sin(0.7 * (t - 1)), np.sin(0.7 * (t + 2))]
    np.testing.assert_allclose(taken.values, np.stack(exact, axis=1), atol=2e-3)


def test_ends_that_nobody_recorded_are_told_and_what_is_missing_is_named():
    with hushed(), pytest.raises(DfsmError, match="no channel 'wave'"):
        model_inputs(model(), record().select(["force", "x"]))
    told = "first value for the first 0.5 s; leading inputs hold their last value for the last 2 s"
    with pytest.warns(DfsmWarning) as said:
        model_inputs(model(), record(), start=0.5)
    assert any(told in str(w.message) for w in said)


def test_an_export_driven_with_them_is_the_rollout(tmp_path, monkeypatch, dfsm):
    write_python(model(), tmp_path / "light")
    monkeypatch.syspath_prepend(tmp_path / "light")
    monkeypatch.delitem(sys.modules, "run_model", raising=False)
    from run_model import Model  # pyright: ignore[reportMissingImports]

    save(model(), tmp_path / "model")
    write_table(record(), tmp_path / "sea.csv")
    files = [tmp_path / name for name in ("model", "sea.csv", "in.csv")]
    said = dfsm("export", "inputs", *files[:2], "-o", files[2], "--start", 1, "--stop", 58)
    assert said.code == 0, said
    assert "571 samples of force, wave_dot, wave_delay1, wave_lead2" in " ".join(said.out.split())
    said = dfsm("export", "state-space", files[0], "-o", tmp_path / "plant.json")
    assert "note: wave_dot (m/s) is the time derivative of wave: supply it" in said.out
    taken = read(tmp_path / "in.csv")
    light, start = Model(tmp_path / "light" / "model.npz"), [0.3, -0.1]
    driven = (taken.select(light.names(g)).values for g in ("controls", "disturbances"))
    states, _ = light.simulate(taken.time, start, *driven)
    with hushed():
        own = simulate(model(), record(), initial=start, start=1.0, stop=58.0).trajectory
    close(states, own.select(["q", "v"]).values, 1e-9)

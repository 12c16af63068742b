"""Models with hidden states in other programs: both forms, splines between samples, own steps."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dfsm as package
from dfsm.data.features import Feature
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.exports.c_code import to_c
from dfsm.exports.fmu import write_fmu
from dfsm.exports.functions import description
from dfsm.exports.python_model import write_python
from dfsm.exports.state_space import to_state_space
from exported import close, hidden, points
from systems import linear_model

TIME = np.arange(0, 60, 0.2)


def drive() -> Trajectory:
    values = np.stack([np.repeat(np.sin(np.arange(30.0)), 10), np.cos(2.3 * TIME)], axis=1)
    return Trajectory(TIME, values, (Channel("u0", "N"), Channel("u1", "N")), name="drive")


@pytest.mark.parametrize("kind", ["polynomial", "tanh"])
def test_both_forms_are_the_model_at_points(kind):
    model, functions = hidden(kind), package.to_casadi(hidden(kind))
    groups = points(model, 200)
    for function, own in ((functions.f, model.derivative), (functions.g, model.output)):
        ours = np.array(function.map(200)(*(g.T for g in groups))).T
        close(ours, np.asarray(own(*groups)))


def test_a_rollout_without_dfsm_takes_the_models_steps_and_splines(tmp_path, monkeypatch):
    model, start = hidden("polynomial"), [0.3, -0.2, 0.1]
    write_python(model, tmp_path / "light")
    monkeypatch.syspath_prepend(tmp_path / "light")
    monkeypatch.delitem(sys.modules, "run_model", raising=False)
    from run_model import Model  # pyright: ignore[reportMissingImports]

    light = Model(tmp_path / "light" / "model.npz")
    u = drive().values
    states, outputs = light.simulate(TIME, start, u, u[:, :0])
    run = package.simulate(model, drive(), initial=start).trajectory
    close(states, run.select(model.signals.names("states")).values, 1e-10)
    close(outputs, run.select(model.signals.names("outputs")).values, 1e-10)
    with pytest.raises(ValueError, match="splines need four times or more"):
        light.simulate(TIME[:3], start, u[:3], u[:3, :0])


def test_exports_tell_the_step_and_where_hidden_states_start(tmp_path: Path):
    model = hidden("polynomial")
    told = description(model)
    assert told["step"] == pytest.approx(0.1)
    assert told["latent_starts"].startswith("their mean over the training runs; dfsm.simulate")
    header = to_c(model).header
    assert "Longest step: 0.1 s." in header
    assert "Nobody measures hidden1, hidden2" in header
    made = write_fmu(model, tmp_path / "m.fmu")
    assert next(v.start for v in made.variables if v.name == "rk4_step") == pytest.approx(0.1)
    (note,) = made.notes
    assert note.startswith("hidden1, hidden2, which nobody measures, start at their mean over the")
    stiff = linear_model(np.array([[-30.0]]), np.array([[1.0]]))
    assert description(stiff)["step"] == pytest.approx(1.5 / 30)


def test_a_delayed_input_is_told_where_it_must_be_supplied():
    late = Feature(source="u9", kind="delay", seconds=2.5)
    model = hidden("tanh")
    controls = (model.signals.controls[0], Channel(late.name, "N"))
    signals = replace(model.signals, controls=controls, features=(late,))
    told = to_c(replace(model, signals=signals))
    sentence = f"{late.name} (N) is u9 as it was 2.5 s ago: supply it"
    assert told.description["computed_inputs"] == [sentence]
    assert sentence in told.header
    assert f"{late.name} (N), cubic between samples" in told.header


def test_linearizations_hold_hidden_states():
    model = hidden("tanh")
    (point,) = to_state_space(model)
    assert point.steady
    np.testing.assert_allclose(model.derivative(point.states, point.inputs, []), 0, atol=1e-9)
    dx = np.array([1e-6, -2e-6, 1e-6])
    rate = np.asarray(model.derivative(point.states + dx, point.inputs, []))
    np.testing.assert_allclose(rate, point.A @ dx, atol=1e-9)

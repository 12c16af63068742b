"""Linearizations along the schedule: matrices, points and names, in memory and in files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.io import loadmat

import dfsm as package
import fits
from conftest import Dfsm
from dfsm.errors import DfsmError
from systems import linear_model

A = np.array([[0.0, 1.0], [-4.0, -0.6]])
B = np.array([[0.0, 0.0], [2.0, 0.5]])
C = np.array([[3.0, 0.0]])


@pytest.fixture(scope="module")
def models():
    return package.to_state_space(fits.scheduled(), [7.0, 8.0])


def test_points_are_steady_and_matrices_are_slopes(models):
    model = fits.scheduled()
    assert [p.schedule for p in models] == [7.0, 8.0]
    for point in models:
        u, w = point.inputs[:1], point.inputs[1:]
        assert point.steady
        assert w[0] == point.schedule
        np.testing.assert_allclose(point.derivative, 0, atol=1e-8)
        # A step inside one interval of the schedule, in which the model is smooth.
        dx, du = np.array([1e-5, -2e-5]), np.array([1e-5])
        rate = np.asarray(model.derivative(point.states + dx, u + du, w))
        np.testing.assert_allclose(rate, point.A @ dx + point.B[:, 0] * du, atol=1e-8)
        y = np.asarray(model.output(point.states + dx, u + du, w))
        slope = point.C @ dx + point.D[:, 0] * du
        np.testing.assert_allclose(y - point.outputs, slope, atol=1e-8)
    assert "2 linearizations along w (m/s), 2 at steady states" in repr(models)


def test_files_hold_matrices_points_names_and_units(models, tmp_path):
    models.save(tmp_path / "m.mat")
    models.save(tmp_path / "m.json")
    mat = loadmat(tmp_path / "m.mat")
    told = json.loads((tmp_path / "m.json").read_text())
    for k, point in enumerate(models):
        for key in "ABCD":
            np.testing.assert_array_equal(mat[key][:, :, k], getattr(point, key))
            np.testing.assert_array_equal(told["points"][k][key], getattr(point, key))
        np.testing.assert_array_equal(mat["x0"][:, k], point.states)
        np.testing.assert_array_equal(told["points"][k]["u0"], point.inputs)
    assert [str(c[0][0]) for c in mat["state_names"]] == ["q", "v"]
    assert [str(c[0][0]) for c in mat["input_units"]] == ["N", "m/s"]
    np.testing.assert_array_equal(mat["schedule"], [[7.0, 8.0]])
    region = fits.scheduled().region
    ends = np.stack([region.low, region.high], axis=1)[[2, 3, 0, 1]]  # states before inputs
    np.testing.assert_array_equal(np.vstack([mat["state_ranges"], mat["input_ranges"]]), ends)
    assert [c["trained"] for c in (*told["states"], *told["inputs"])] == ends.tolist()
    assert [i["role"] for i in told["inputs"]] == ["control", "disturbance"]
    assert told["schedule"]["name"] == "w"
    with pytest.raises(DfsmError, match=r"the suffix '.csv', expected .mat or .json"):
        models.save(tmp_path / "m.csv")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.json", "m.mat"]


def test_systems_of_python_control_answer_as_the_model_does():
    control = pytest.importorskip("control")
    (system,) = package.to_state_space(linear_model(A, B, C, names=["q", "v"])).control()
    assert (system.state_labels, system.input_labels) == (["q", "v"], ["u0", "u1"])
    np.testing.assert_allclose(
        np.sort_complex(system.poles()), np.sort_complex(np.linalg.eigvals(A))
    )
    time = np.linspace(0, 5, 501)
    pulse = np.zeros((2, 501))
    pulse[0, 50:52] = 1.0
    answer = control.forced_response(system, time, pulse).outputs
    assert np.abs(np.atleast_2d(answer)).max() > 1e-3


def test_names_with_dots_and_a_system_that_python_control_does_not_hold():
    control = pytest.importorskip("control")
    model = linear_model(A, B, C, names=["a.b", "a_b"])
    (system,) = package.to_state_space(model).control()
    assert system.state_labels == ["a_b_", "a_b"]
    alone = model.linearize([0.0, 0.0], [0.0, 0.0], [])
    assert alone.state_labels == ["a_b_", "a_b"]
    assert np.atleast_2d(control.step_response(alone, [0, 1]).outputs).shape[-1] == 2
    decay = linear_model(np.array([[-1.0]]), np.zeros((1, 0)))
    with pytest.raises(DfsmError, match="one state and neither controls nor disturbances"):
        package.to_state_space(decay).control()


def test_a_point_without_a_steady_state_is_told_and_linearized_all_the_same():
    drifting = linear_model(np.array([[0.0, 1.0], [0.0, 0.0]]), B, C, names=["q", "v"])
    with pytest.warns(package.DfsmWarning, match="no steady state: linearized at the mean of"):
        (point,) = package.to_state_space(drifting, controls=[1.0, 0.0])
    assert not point.steady
    np.testing.assert_allclose(point.derivative, [point.states[1], 2.0])
    np.testing.assert_array_equal(point.A, [[0, 1], [0, 0]])


def test_what_is_refused():
    scheduled = fits.scheduled()
    with pytest.raises(DfsmError, match="w = 30 is outside the training range"):
        package.to_state_space(scheduled, [30.0])
    with pytest.raises(
        DfsmError, match=r"controls have shape \(2,\), expected \(1,\), or \(1, 1\)"
    ):
        package.to_state_space(scheduled, 8.0, controls=[1.0, 2.0])
    with pytest.raises(DfsmError, match="the model is LTI and has no schedule"):
        package.to_state_space(fits.linear().model, [1.0])
    with pytest.raises(DfsmError, match="the schedule values are 'fast', expected numbers"):
        package.to_state_space(scheduled, "fast")


def test_the_command(tmp_path, dfsm: Dfsm):
    package.save(fits.scheduled(), tmp_path / "model")
    file = tmp_path / "m.json"
    done = dfsm("export", "state-space", tmp_path / "model", "-o", file, "--at", "7.5,8")
    assert "w = 7.5: steady state" in done.out
    assert [p["schedule"] for p in json.loads(file.read_text())["points"]] == [7.5, 8.0]
    bad = dfsm("export", "state-space", tmp_path / "model", "-o", tmp_path / "m.txt")
    assert "expected .mat or .json" in bad.sentence
    assert (
        "expected numbers"
        in dfsm("export", "state-space", tmp_path / "model", "-o", file, "--at", "a,b").sentence
    )

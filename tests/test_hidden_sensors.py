"""Outputs of which an instrument loses the sign, or the ends: found, fitted, and used."""

from __future__ import annotations

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.config.proposal import propose
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.exports.python_model import write_python
from dfsm.fitting.causes import driven_by_past
from dfsm.fitting.fit import fit
from dfsm.fitting.hidden.assembled import assembled
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.search import Found
from dfsm.fitting.hidden.sensors import behind, sensed
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.hidden.starts import Candidate
from dfsm.fitting.hidden.windows import standard_of, windows_of
from dfsm.fitting.settings import FitSettings
from dfsm.models.corrective.polynomial import monomials
from dfsm.models.model_folder import load, save
from dfsm.models.terms.sensor import Sensor
from dfsm.numerics.folds import unfolded
from dfsm.simulation.simulate import simulate
from dfsm.validation.validate import validate
from systems import linear_model

STEP, NOISE = 0.1, 0.02


def swings(seed: int, samples: int = 260) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, an input that is held for some samples, and x of ẍ = 6 u - 1.2 ẋ - 4 x."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, samples).repeat(rng.integers(2, 12, samples))[:samples]
    path, x, h = np.empty(samples), np.array([0.4, 0.0]), STEP / 20
    for k in range(samples):
        path[k] = x[0]
        for _ in range(20):
            v = x[1] + h / 2 * (6 * u[k] - 1.2 * x[1] - 4 * x[0])
            x = x + h * np.array([v, 6 * u[k] - 1.2 * v - 4 * (x[0] + h / 2 * x[1])])
    return STEP * np.arange(samples), u, path


def record(seed: int, noise: float = 0.0) -> Trajectory:
    """u and y = |x|, with noise of the instrument before it loses the sign."""
    time, u, x = swings(seed)
    y = np.abs(x + noise * np.random.default_rng(seed).standard_normal(len(x)))
    channels = (Channel("u", "V"), Channel("y", "rad/s"))
    return Trajectory(time, np.stack([u, y], axis=1), channels, name=f"run{seed}")


def test_signs_come_back() -> None:
    """Those of noisy records, up to one sign for all; what was not folded is left alone."""
    runs = [swings(s) for s in (1, 2)]
    pairs = [(u[:, None], np.abs(x + NOISE * np.cos(37.0 * t))) for t, u, x in runs]
    found = unfolded(pairs)
    assert found is not None
    assert (found.clear, found.level, found.up) == (True, 0, 1)
    truth = np.concatenate([x for *_, x in runs])
    path = np.concatenate(found.paths)
    assert min(np.abs(path - truth).max(), np.abs(path + truth).max()) < 4 * NOISE
    down = unfolded([(u, 3 - y) for u, y in pairs])
    assert down is not None
    assert (down.clear, down.up) == (True, -1)
    assert abs(down.level - 3) < 2 * NOISE
    squares = [(u, y**2) for u, y in pairs]
    once, twice = unfolded(squares), unfolded(squares, 2)
    assert once is not None
    assert twice is not None
    assert twice.clear
    assert twice.left < once.left
    plain = unfolded([(u[:, None], x) for _, u, x in runs])
    assert plain is not None
    assert not plain.clear


def test_inputs_drive_what_has_lost_its_sign() -> None:
    """As much one way as the other, so that no past of u tells |x| by itself."""
    run = record(1, NOISE)
    assert driven_by_past(run, ["u", "y"]) == ["y"]
    proposed = propose([run], ["u", "y"], [])
    assert proposed.hidden
    assert "as absolute values do" in proposed.reasons["y"]
    assert "absolute" not in proposed.reasons["u"]


@pytest.mark.filterwarnings("ignore:.*outside the training range")
def test_one_record_of_absolute_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hidden = HiddenSettings(count=1, form="none", iterations=8)
    settings = FitSettings(
        states=(StateSpec(name="y"),),
        controls=("u",),
        inputs="hold",
        nonlinear_only=False,
        hidden=hidden,
    )
    model = fit([record(1, NOISE)], settings).model
    assert model.signals.names("outputs") == ("y",)
    assert model.signals.names("states") == ("hidden1", "hidden2")
    np.testing.assert_allclose(model.eigenvalues()[0][1].real, -0.6, atol=0.06)
    test = record(2)
    rollout = simulate(model, test, start=5.0).trajectory
    truth = test.window(5.0, None)["y"]
    assert np.sqrt(np.mean((rollout["y"] - truth) ** 2)) < 0.03 * test["y"].std()
    assert rollout["y"].min() >= -1e-3
    save(model, tmp_path / "model")
    again = simulate(load(tmp_path / "model"), test, start=5.0).trajectory
    np.testing.assert_array_equal(again.values, rollout.values)
    judged = validate({"multi-fidelity": model}, [test], start=5.0).runs[0].models
    assert judged["multi-fidelity"].errors["y"].nrmse < 0.05
    assert any("absolute value of a hidden state" in c for c in model.provenance.record["checks"])
    write_python(model, tmp_path / "light")
    monkeypatch.syspath_prepend(tmp_path / "light")
    monkeypatch.delitem(sys.modules, "run_model", raising=False)
    from run_model import Model  # pyright: ignore[reportMissingImports]

    inside, start = test.window(5.0, None), rollout.select(["hidden1", "hidden2"]).values[0]
    drive = inside.select(["u"]).values
    light = Model(tmp_path / "light" / "model.npz")
    _, outputs = light.simulate(inside.time, start, drive, drive[:, :0])
    np.testing.assert_allclose(outputs[:, 0], rollout["y"], atol=1e-9)


def test_what_is_assembled_is_what_was_fitted() -> None:
    """Two outputs, of which the first lost its sign: rates, outputs and slopes."""
    time, u, x = swings(3, 60)
    values = np.stack([np.clip(x, -0.5, 0.6), np.gradient(x, time), u], axis=1)
    names = (Channel("y", "V"), Channel("z", "V/s"), Channel("u", "V"))
    run = Trajectory(time, values, names, name="run")
    standard = standard_of([run], 2)
    told = sensed([run], standard, None)
    assert told is not None
    assert [s.sensing for s in told.sensors] == ["clipped", "direct"]
    sensors = (Sensor("absolute", up=-1), Sensor())
    form = Form(3, 2, 1, "polynomial", 0, monomials(4, 2), sensors=sensors)
    windows = windows_of([run], standard, ["hold"], 1)
    error = HiddenError(form, windows)
    w = 0.3 * np.random.default_rng(0).standard_normal(error.size)
    _, slope = error.normal_equations(w)
    h = 1e-6 * np.eye(len(w))
    numeric = [(error.cost(w + d) - error.cost(w - d)) / 4e-6 for d in h]
    np.testing.assert_allclose(slope, numeric, rtol=1e-4, atol=1e-5)
    for first in behind(form, w[: form.size], error.outputs(w)[:, 0]):
        levels = w[form.size - 2 : form.size]
        np.testing.assert_allclose(form.seen(levels, first), error.outputs(w)[:, 0], atol=1e-12)

    base = linear_model(-np.eye(2), np.ones((2, 1)), names=["y", "z"])
    found = Found(Candidate(form, w, 0.1, 1), standard, ("hold",), 1, windows, {}, [], {})
    model = assembled(base, found, 1.0)
    assert model.signals.names("states") == ("z", "hidden1", "hidden2")
    assert model.signals.names("outputs") == ("y",)
    rng = np.random.default_rng(1)
    parts = form.parts(jnp.asarray(w[: form.size]))
    (mean, scale), (mean_u, scale_u) = standard.outputs, standard.inputs
    for x, v in zip(rng.standard_normal((5, 3)), rng.standard_normal((5, 1)), strict=True):
        state, physical = [mean[1] + scale[1] * x[1], x[0], x[2]], mean_u + scale_u * v
        seen = mean[0] + scale[0] * (w[form.size - 2] - abs(x[0]))
        np.testing.assert_allclose(model.output(state, physical, []), [seen])
        rate = np.asarray(form.rate(parts, jnp.asarray(x), jnp.asarray(v))) / standard.step
        expected = [scale[1] * rate[1], rate[0], rate[2]]
        np.testing.assert_allclose(model.derivative(state, physical, []), expected)

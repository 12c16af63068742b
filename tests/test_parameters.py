"""Plant parameters through the whole chain: the mass of a robot arm's second link, and springs."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import dfsm
from benchmarks import parameters
from conftest import write_config
from dfsm import cli
from dfsm.config.fit import parse_config
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.models.latents import Poles, add_latents
from dfsm.simulators.two_link_robot import holding_torques
from systems import SPRING

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.filterwarnings("ignore:.*linear fit is unstable:dfsm.errors.DfsmWarning")

# A state of the models, and the torques that hold the arm there.
HELD = parameters.HELD[[0, 2, 1, 3]]


@pytest.fixture(scope="module")
def model() -> dfsm.DFSM:
    """Told the mass; a Gaussian process is as good here as the study's network, and soon fitted."""
    train = parameters.runs(parameters.MASSES["trained masses"], 24, seed=0)
    choices = replace(parameters.settings(), corrective=dfsm.GP(samples=400))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dfsm.DfsmWarning)
        return dfsm.fit(train, choices).model


@pytest.fixture(scope="module")
def tests() -> list[dfsm.Trajectory]:
    """One run for each mass in between."""
    return parameters.runs(
        parameters.MASSES["masses in between"], 1, seed=9, closer=parameters.CLOSER
    )


# -- the chain ----------------------------------------------------------------------------------


def test_saved_and_loaded_models_are_the_same(model, tests, tmp_path):
    dfsm.save(model, tmp_path / "m")
    loaded = dfsm.load(tmp_path / "m")
    assert loaded.signals == model.signals
    assert [c.name for c in loaded.signals.parameters] == ["m2"]
    assert loaded.signals.parameters[0].unit == "kg"
    for a, b in zip(dfsm.simulate(loaded, tests), dfsm.simulate(model, tests), strict=True):
        np.testing.assert_array_equal(a.trajectory.values, b.trajectory.values)
    assert "parameters: m2 (kg)" in loaded.summary()
    assert "parameters m2 (kg)" in repr(loaded)


def test_runs_with_different_masses_together_and_one_by_one(model, tests):
    for run, together in zip(tests, dfsm.simulate(model, tests), strict=True):
        alone = dfsm.simulate(model, run)
        np.testing.assert_allclose(
            alone.trajectory.values, together.trajectory.values, rtol=0, atol=1e-9
        )
        assert alone.status is dfsm.Status.COMPLETED


@pytest.mark.parametrize("method", ["rk4", "tsit5", "kvaerno5"])
def test_the_mass_drives_every_solver(model, tests, method):
    options = dfsm.SimulationSettings(method=method)
    light, heavy = (
        dfsm.simulate(model, with_mass(tests[1], mass), settings=options).trajectory
        for mass in (2.1, 2.9)
    )
    own = dfsm.simulate(model, tests[1], settings=options).trajectory
    error = np.abs(own["theta1"] - tests[1]["theta1"]).max()
    assert 20 * error < np.abs(light["theta1"] - heavy["theta1"]).max()


def with_mass(run: dfsm.Trajectory, mass: float) -> dfsm.Trajectory:
    values = run.values.copy()
    values[:, run.column("m2")] = mass
    return replace(run, values=values)


def test_a_mass_beyond_the_trained_ones_is_told(model, tests):
    with pytest.warns(dfsm.DfsmWarning, match="outside the training range"):
        result = dfsm.simulate(model, with_mass(tests[0], 3.5))
    assert result.outside == 1


def test_validation_and_report_show_the_mass(model, tests, tmp_path):
    found = dfsm.validate(model, tests)
    assert found.completed("multi-fidelity") == len(tests)
    assert [r.parameters for r in found.runs] == [{"m2": m} for m in (2.1, 2.4, 2.65, 2.9)]
    worst = max(
        e for r in found.runs for e in r.models["multi-fidelity"].derivative_errors.values()
    )
    assert worst < 0.05
    plain = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert [r["parameters"]["m2"] for r in plain["runs"]] == [2.1, 2.4, 2.65, 2.9]
    assert plain["provenance"]["settings"]["parameters"] == ["m2"]
    dfsm.write_report({"arm": found}, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "m2 (kg)" in text
    assert "2.65" in text.split("m2 (kg)")[1].split("</table>")[0]


# -- slopes -------------------------------------------------------------------------------------


def test_jacobians_depend_on_the_mass_and_leave_it_out(model):
    control = pytest.importorskip("control")
    torques = holding_torques(parameters.SYSTEM, parameters.HELD, [2.4])
    A, B, _, _ = model.jacobians(HELD, torques, (), [2.4])
    assert A.shape == (4, 4)
    assert B.shape == (4, 2)
    heavier = model.jacobians(HELD, torques, (), [2.9])[1]
    slopes = jax.jit(
        jax.jacfwd(lambda u, p: parameters.SYSTEM.f(parameters.HELD, u, np.zeros(0), p))
    )
    light, heavy = (
        np.abs(np.asarray(slopes(torques, np.array([mass])))).max() for mass in (2.4, 2.9)
    )
    share = np.abs(B[2:]).max() / np.abs(heavier[2:]).max()
    assert share == pytest.approx(light / heavy, abs=0.01)
    system = model.linearize(HELD, torques, (), [2.4])
    assert isinstance(system, control.StateSpace)
    np.testing.assert_array_equal(system.A, A)
    assert system.input_labels == ["tau1", "tau2"]


def test_slopes_in_the_mass_are_those_of_the_arm(model):
    # What co-design needs: ∂f/∂p, by differentiating the model like any function.
    order = [0, 2, 1, 3]
    torques, nothing = holding_torques(parameters.SYSTEM, parameters.HELD, [2.4]), np.zeros(0)
    true, found = (
        jax.jit(jax.jacfwd(function))
        for function in (
            lambda p: parameters.SYSTEM.f(parameters.HELD, torques, nothing, p),
            lambda p: model.derivative(HELD, torques, nothing, p),
        )
    )
    mass = np.array([2.4])
    expected = np.asarray(true(mass))[order]
    np.testing.assert_allclose(found(mass), expected, rtol=0, atol=0.05 * np.abs(expected).max())


def test_a_mass_that_is_missing_is_asked_for(model):
    with pytest.raises(dfsm.DfsmError, match=r"parameters have shape \(0,\).* hold 1: m2"):
        model.jacobians(HELD, [26.0, 9.5], ())
    run = parameters.runs((2.4,), 1, seed=0)[0]
    without = run.select(n for n in run.names if n != "m2")
    for work in (dfsm.simulate, dfsm.validate):
        with pytest.raises(dfsm.DfsmError, match=r"run000: .*'m2'"):
            work(model, [without])
    with pytest.raises(dfsm.DfsmError, match=r"run000: .*'m2'"):
        dfsm.fit([without], parameters.settings())


# -- a spring, whose steady states and coefficients are known ------------------------------------

STIFFNESS = (2.0, 3.0, 4.0, 5.0, 6.0)


@pytest.fixture(scope="module")
def springs() -> list[dfsm.Trajectory]:
    time = np.arange(0, 15.01, 0.05)
    return [r for k in STIFFNESS for r in SPRING.many(2, [(1, 3), (k, 0)], time, seed=int(k))]


@pytest.fixture(scope="module")
def told(springs, tmp_path_factory) -> Path:
    """A folder with the springs' records, and a model that the command line fitted to them."""
    folder = tmp_path_factory.mktemp("springs")
    for part in ("train", "test"):
        (folder / part).mkdir()
    for i, run in enumerate(springs):
        write_table(run, folder / f"train/{i}.parquet")
    write_config(
        folder / "config.yaml",
        {
            "data": {"train": ["train/*.parquet"]},
            "signals": {
                "states": [{"name": "q", "order": 2, "rate": "v"}],
                "controls": ["u"],
                "parameters": ["k"],
                "outputs": ["y"],
            },
            "corrective": {"kind": "mlp", "hidden": [10]},
            "nonlinear_only": False,
        },
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["dfsm", "fit", f"{folder}/config.yaml", "-o", f"{folder}/m"])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    assert stop.value.code == 0
    return folder


def spring_settings(**changes) -> dfsm.FitSettings:
    return dfsm.FitSettings(
        states=(dfsm.StateSpec(name="q", order=2, rate="v"),),
        controls=("u",),
        parameters=("k",),
        outputs=("y",),
        nonlinear_only=False,
        corrective=dfsm.NoCorrection(),
        **changes,
    )


def test_steady_states_follow_a_parameter(told):
    # k q = 2 u, and y = k q
    model = dfsm.load(told / "m")
    for k in (2.5, 4.5):
        found = dfsm.steady_state(model, controls=[1.0], parameters=[k])
        assert found.converged
        np.testing.assert_array_equal(found.parameters, [k])
        np.testing.assert_allclose(found.states, [2 / k, 0], rtol=0, atol=0.01)
        np.testing.assert_allclose(found.outputs, [2.0], rtol=0, atol=0.05)
        A = [[0, 1], [-k, -0.8]]
        np.testing.assert_allclose(found.eigenvalues, np.linalg.eigvals(A)[[0, 1]], atol=0.02)
    default = dfsm.steady_state(model, controls=[1.0])
    np.testing.assert_allclose(default.parameters, [4.0], rtol=1e-12)
    with pytest.raises(dfsm.DfsmError, match=r"parameters have shape \(2,\)"):
        dfsm.steady_state(model, parameters=[1.0, 2.0])


@pytest.mark.parametrize("points", [3, 9])
def test_a_linear_fit_may_be_scheduled_by_a_parameter(springs, points):
    # q̈ = -k q - …: what is linear in the schedule is exact at and between windows of one value.
    choices = spring_settings(linear=dfsm.LPV(schedule="k", points=points))
    model = dfsm.fit(springs, choices).model
    assert model.schedule == "k"
    for k in (3.5, 4.5, 5.0):
        A = model.jacobians([0.0, 0.0], [0.0], (), [k])[0]
        np.testing.assert_allclose(A, [[0, 1], [-k, -0.8]], rtol=0, atol={3: 0.25, 9: 0.01}[points])
    # The parameter stands behind the states, and moves when these become more.
    pair = Poles(*np.array([[0.1], [0.0]]), np.full((1, 1), 1.0 + 0j), np.zeros(1))
    wide = add_latents(model, pair, np.zeros((2, 2)), [np.eye(9, 2)])
    inputs = np.asarray(model.region.operating)[1:]
    wider = np.insert(inputs, [3, 3], 0.2, axis=1)
    expected = np.asarray(model.region.distance(inputs + 0.1))
    np.testing.assert_allclose(
        np.asarray(wide.region.distance(wider + 0.1)), expected, rtol=1e-12, atol=1e-12
    )
    assert expected.max() > 0.01


# -- the command line ---------------------------------------------------------------------------


def test_parquet_files_through_the_command_line(told, monkeypatch, dfsm):
    monkeypatch.chdir(told)
    (unseen,) = SPRING.many(1, [(1, 3), (3.5, 0)], np.arange(0, 15.01, 0.05), seed=77)
    write_table(unseen, "test/unseen.parquet")
    assert dfsm("init", "train/*.parquet", "-o", "proposed.yaml").code == 0
    assert parse_config(Path("proposed.yaml")).signals.parameters == ["k"]
    assert "parameters: k (N/m)" in dfsm("summary", "m").out
    shown = dfsm("validate", "m", "test/*", "-o", "r.html", "--json", "m.json")
    assert shown.code == 0, shown
    found = json.loads(Path("m.json").read_text())
    assert found["runs"][0]["parameters"] == {"k": 3.5}
    errors = {n: m["mean_nrmse"]["q"] for n, m in found["models"].items()}
    assert errors["multi-fidelity"] < min(0.01, 0.05 * errors["linear-fit"])
    assert "k (N/m)" in Path("r.html").read_text(encoding="utf-8")
    assert dfsm("simulate", "m", "test/unseen.parquet", "-o", "o.parquet").code == 0
    np.testing.assert_allclose(
        read("o.parquet")["q"], unseen["q"], rtol=0, atol=0.02 * unseen["q"].std()
    )
    write_table(unseen.select(n for n in unseen.names if n != "k"), "test/without.parquet")
    said = dfsm("simulate", "m", "test/without.parquet", "-o", "p.parquet").sentence
    assert "test/without.parquet: " in said
    assert "'k'" in said
    assert not Path("p.parquet").exists()

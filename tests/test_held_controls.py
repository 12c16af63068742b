"""Optimal control with inputs that are held: against exact steps of the same cart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

from cart import problem, solved, wind
from conftest import write_config as write_yaml
from dfsm.config.fit import Config
from dfsm.config.parse import parse_file
from dfsm.config.template import write_config
from dfsm.control import DirectTranscription, MultipleShooting, load_solution, save_solution, solve
from dfsm.control.between import disturbances_at
from dfsm.control.names import plant_of
from dfsm.data.derivatives import StateSpec
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.exports.rosco import write_rosco
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import save
from dfsm.report.solution_page import outcome
from dfsm.simulators import ODESystem

RADAU = DirectTranscription(scheme="radau", mesh=10)
A, B = np.array([[0.0, 1.0], [0.0, -0.15]]), np.array([0.0, 0.5])


def exactly(h, size):
    """A step of the cart under a held force and wind: x₁ = P x₀ + q (force + wind)."""
    whole = expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * h)
    return whole[:2, :2], whole[:2, 2] * size


def cheapest(force_steps: int, per: int, w: np.ndarray) -> np.ndarray:
    """Held forces of least effort that move the cart, the wind held over parts of each step."""
    P, q = exactly(5.0 / (force_steps * per), 1.0)
    effect, drift = np.zeros((2, force_steps)), np.zeros(2)
    for k in range(force_steps * per):
        effect, drift = P @ effect, P @ drift + q * w[k]
        effect[:, k // per] += q
    return np.linalg.lstsq(effect, np.array([4.0, 0.0]) - drift, rcond=None)[0]


@pytest.fixture(scope="module")
def held():
    return solved(problem(inputs="hold"), RADAU, simulate=True)


def test_held_force_and_wind_are_those_of_exact_steps(held, tmp_path):
    u = cheapest(10, 5, wind()["wind"][:50])
    middles = (np.arange(10) + 0.5) / 10
    np.testing.assert_allclose(held.at(middles)[1][:, 0], u, atol=1e-6)
    assert held.objective == pytest.approx(0.5 * u @ u, rel=1e-7)
    assert held.replays[0].relative < 1e-7
    assert held.grid.intervals > 10  # cut where the wind jumps, and the force is held all the same
    save_solution(held, tmp_path / "result")
    again = load_solution(tmp_path / "result")
    np.testing.assert_array_equal(again.at(middles)[1], held.at(middles)[1])
    # Path constraints hold at every node, not once per held force.
    limited = solved(
        problem(inputs={"force": "hold"}, constraints={"v": (lambda s: s.x.speed, None, 1.1)}),
        replace(RADAU, refine=None),
    )
    assert limited.trajectory["speed"].max() < 1.1 + 1e-6


def test_a_smooth_wind_is_the_spline_through_its_samples():
    time = np.linspace(0, 10, 7)
    run = Trajectory(time, np.cos(time)[:, None], (Channel("wind", "N"),))
    at = np.linspace(0, 10, 50)
    found = disturbances_at(run, ("wind",), ("cubic",), at, 10.0)[:, 0]
    np.testing.assert_allclose(found, CubicSpline(time, run["wind"])(at), atol=1e-12)
    jumping = disturbances_at(run, ("wind",), ("hold",), time, 10.0)[:, 0]
    np.testing.assert_array_equal(jumping, run["wind"][[0, 0, 1, 2, 3, 4, 5]])


def test_what_cannot_be_held_is_a_sentence():
    for method in (DirectTranscription(), MultipleShooting()):
        for name in ("force", "wind"):
            with pytest.raises(DfsmError, match=f"'{name}' is held .* take the scheme radau"):
                solve(problem(inputs={name: "hold"}), method)
    with pytest.raises(DfsmError, match="which a free last time needs"):
        solve(problem(horizon=(0.0, (4.0, 6.0)), inputs={"wind": "cubic"}), RADAU)
    with pytest.raises(DfsmError, match="no channel 'wnd'"):
        problem(inputs={"wnd": "hold"})
    x, *two = (Channel(n) for n in ("x", "a", "b"))
    system = ODESystem(lambda x, u, w, p: u[:1] + u[1:], states=(x,), controls=tuple(two))
    none = {key: {} for key in ("initial", "final", "parameters")}
    with pytest.raises(DfsmError, match="inputs hold a and not b"):
        problem(model=system, inputs={"a": "hold"}, disturbances=None, **none)


def test_a_control_that_was_held_in_training_is_told(tmp_path, dfsm):
    rng = np.random.default_rng(0)
    u, decay, x = np.repeat(rng.uniform(-1, 1, 60), 4), np.exp(-0.3), np.zeros(240)
    for k in range(239):
        x[k + 1] = decay * x[k] + (1 - decay) * u[k]
    run = Trajectory(
        np.arange(240.0), np.stack([x, u], axis=1), (Channel("x"), Channel("u")), name="run"
    )
    settings = FitSettings(
        states=(StateSpec(name="x"),), controls=("u",), corrective=NoCorrection(),
        nonlinear_only=False,
    )  # fmt: skip
    model = fit([run], settings).model
    task = {"initial": {"x": 0.0}, "final": {"x": 0.5}, "cost": lambda s: s.u.u**2}
    task |= {"model": model, "horizon": (0.0, 4.0), "parameters": {}, "disturbances": None}
    with pytest.warns(DfsmWarning, match="'u' was held between samples in the runs of the model"):
        solve(problem(**task), replace(RADAU, mesh=4, refine=None), simulate=False)
    assert plant_of(model).names("controls") == ("u",)
    save(model, tmp_path / "m")
    cost = [{"square": "u", "weight": 1.0}]
    asked = {"model": str(tmp_path / "m"), "horizon": [0.0, 4.0], "nodes": 5, "cost": cost}
    asked = write_yaml(tmp_path / "problem.yaml", asked | {"initial": "free"})
    told = dfsm("optimize", asked, "-o", tmp_path / "found")
    assert told.code == 0, told
    assert "'u' was held between samples in the runs of the model" in told.err
    found = solved(problem(**task, inputs={"u": "hold"}), replace(RADAU, mesh=4))
    # x₄ = Σ decay^(3-k) (1 - decay) u_k, with least Σ u².
    row = (1 - decay) * decay ** np.arange(3.0, -1, -1)
    np.testing.assert_allclose(
        found.at((np.arange(4) + 0.5) / 4)[1][:, 0], 0.5 * row / (row @ row), rtol=2e-3
    )
    # `init` writes what it recognised.
    write_table(run, tmp_path / "run.csv")
    write_config([str(tmp_path / "run.csv")], tmp_path / "config.yaml")
    assert "inputs: {u: hold}" in (tmp_path / "config.yaml").read_text()
    assert parse_file(tmp_path / "config.yaml", Config, "").inputs == {"u": "hold"}


def test_rosco_gets_two_rows_where_a_held_control_jumps(held, tmp_path):
    run = held.trajectory
    channels = tuple(
        replace(c, name="BldPitch1", unit="deg") if c.name == "force" else c for c in run.channels
    )
    renamed = replace(held, trajectories=(replace(run, channels=channels),))
    written = write_rosco(renamed, tmp_path / "ol.dat")
    rows = np.loadtxt(tmp_path / "ol.dat", comments="!")
    assert written.rows == len(rows) == 20
    u = cheapest(10, 5, wind()["wind"][:50])
    at = np.array([0.0, 0.3, 0.499999, 0.5011, 0.75, 3.2, 4.999])
    flown = np.interp(at, rows[:, 0], rows[:, 1])
    np.testing.assert_allclose(np.rad2deg(flown), u[(at / 0.5).astype(int)], rtol=1e-6)


def test_the_page_shows_the_errors_by_name(held):
    rows = {row[0]: row[1] for row in outcome(held).rows}
    for name in ("dynamics", "cost", "constraints", "objective"):
        assert rows[f"error of the {name}, between the nodes"] == held.errors[name]
    unknown = replace(held, errors={"cost": np.nan})
    told = [row[1] for row in outcome(unknown).rows if str(row[0]).startswith("error of")]
    assert told == [None]

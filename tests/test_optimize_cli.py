"""`dfsm optimize`: a linear model with a known optimum, and one sentence for every bad input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from conftest import Dfsm, write_config
from dfsm.config.control import CostTerm, cost_of
from dfsm.control import load_solution
from dfsm.control.names import Signals, plant_of
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.models.model_folder import save
from systems import linear_model

# ẋ = −x + u, y = 2 x.
MODEL = linear_model(np.array([[-1.0]]), np.array([[1.0]]), np.array([[2.0]]))
PROBLEM: dict[str, Any] = {
    "model": "m",
    "disturbances": "run.csv",
    "horizon": [0.0, 2.0],
    "nodes": 11,
    "cost": [{"square": "x0", "weight": 1.0}, {"square": "u0", "weight": 1.0}],
    "bounds": {"u0": [-3, None]},
    "initial": "recorded",
}


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    save(MODEL, tmp_path / "m")
    time = np.linspace(0, 2, 21)
    values = np.stack([np.cos(time), 0 * time], axis=1)
    channels = (Channel("x0", "m"), Channel("u0", "N"))
    write_table(Trajectory(time, values, channels), tmp_path / "run.csv")
    return tmp_path


def written(**changes: Any) -> Path:
    given = {k: v for k, v in (PROBLEM | changes).items() if v is not ...}
    return write_config(Path("c.yaml"), given)


def test_a_regulator_has_the_cost_of_its_riccati_equation(work: Path, dfsm: Dfsm):
    result = dfsm("optimize", written(), "-o", "result")
    assert result.code == 0, result
    assert "solved" in result.out
    assert "largest violation" in result.out
    solution = load_solution("result")
    # −ṗ = 2 a p − p² + 1 with a = −1 and p(2) = 0; the optimal cost is p(0) x(0)².
    s = np.sqrt(2)
    expected = np.sinh(2 * s) / (np.sinh(2 * s) + s * np.cosh(2 * s))
    assert solution.objective == pytest.approx(expected, rel=1e-4)
    assert solution.trajectory["x0"][0] == pytest.approx(1, abs=1e-9)
    assert solution.trajectory["y0"] == pytest.approx(2 * solution.trajectory["x0"])
    assert solution.bounds["u0"][0] == pytest.approx(-3 * np.ones(21))
    assert np.isinf(solution.bounds["u0"][1]).all()
    page = (work / "result" / "solution.html").read_text(encoding="utf-8")
    assert "Solved." in page
    # The folder is ours, page and all: a second run replaces it.
    again = dfsm("optimize", "c.yaml", "-o", "result", "--json")
    assert again.code == 0
    assert json.loads(again.out)["ending"] == "solved"


def test_what_has_no_solution_exits_with_1_and_names_the_constraint(work: Path, dfsm: Dfsm):
    # The state cannot rise from 1 to 6 within one interval of the mesh with so little control.
    bounds = {"u0": [-1, 1], "y0": [4, 8]}
    result = dfsm("optimize", written(bounds=bounds, initial="free"), "-o", "r")
    assert result.code == 1
    assert "no feasible point was found" in result.out
    assert "dynamics of x0 misses by" in result.out or "y0 misses by" in result.out
    assert load_solution("r").ending.name == "INFEASIBLE"
    limit = dfsm("optimize", written(most_iterations=1), "-o", "r", "--quiet")
    assert limit.code == 1
    assert limit.out == ""


def test_rates_and_free_states_are_kept(work: Path, dfsm: Dfsm):
    cost = [{"track": "x0", "reference": 1.0, "weight": 1.0}]
    given = written(cost=cost, rates={"u0": [-0.2, 0.2]}, initial="free", bounds={"u0": [-3, 0]})
    assert dfsm("optimize", given, "-o", "r", "-q").code == 0
    run = load_solution("r").trajectory
    assert np.abs(np.diff(run["u0"]) / np.diff(run.time)).max() <= 0.2 + 1e-6


def test_terms_mean_what_they_say():
    terms = [
        CostTerm(value="x0", weight=2.0),
        CostTerm(square="u0", weight=3.0),
        CostTerm(product=["x0", "u0"], weight=-1.0),
        CostTerm(track="y0", reference=1.0, weight=0.5),
    ]
    plant = plant_of(MODEL)
    s = Signals(plant, 0.0, [jnp.array([4.0]), jnp.array([30.0]), jnp.zeros(0), jnp.zeros(0)])
    found = float(cost_of(terms, plant, {"u0": 10.0})(s))
    assert found == pytest.approx(2 * 4 + 3 * 9 - 4 * 3 + 0.5 * 7**2)


BAD = [
    ({"cots": 1}, "unknown key 'cots'; did you mean 'cost'?"),
    (
        {"cost": [{"sqare": "x0", "weight": 1}]},
        "unknown key 'cost[0].sqare'; did you mean 'square'",
    ),
    ({"cost": [{"square": "x0"}]}, "key 'cost[0].weight' is missing"),
    ({"cost": []}, "'cost' has no terms"),
    ({"cost": [{"square": "xo", "weight": 1}]}, "'cost[0].square': no channel 'xo'; known are"),
    ({"cost": [{"weight": 1}]}, "'cost[0]' has none, expected one of value, square, product"),
    (
        {"cost": [{"square": "x0", "value": "x0", "weight": 1}]},
        "'cost[0]' has 'value' and 'square', expected one of",
    ),
    ({"cost": [{"track": "x0", "weight": 1}]}, "'cost[0]' needs a key 'reference'"),
    (
        {"cost": [{"square": "x0", "weight": 1, "reference": 2}]},
        "'cost[0]' takes no key 'reference'",
    ),
    ({"cost": [{"product": ["x0"], "weight": 1}]}, "'cost[0].product' names fewer than two"),
    ({"units": {"u0": 0}}, "'units.u0' is 0, expected a number that is not 0"),
    ({"units": {"u0": -5}}, "'units.u0' is -5, expected a number above 0"),
    ({"units": {"u1": 2}}, "'units': no channel 'u1'"),
    ({"bounds": {"x9": [0, 1]}}, "bounds: no channel 'x9'"),
    ({"bounds": {"u0": [2, 1]}}, "the lower limit must not be above the upper one"),
    ({"bounds": {"u0": 2}}, "'bounds.u0'"),
    ({"rates": {"x0": [0, 1]}}, "'x0' is one of the states, expected controls"),
    ({"nodes": 1}, "'nodes' is 1, expected at least 2"),
    ({"scheme": "euler"}, "'scheme'"),
    ({"initial": "given"}, "'initial'"),
    ({"disturbances": ...}, "'initial' is recorded, which needs one run in 'disturbances', not 0"),
    ({"horizon": [1.0, 0.0]}, "the horizon is (1.0, 0.0), expected (first, last)"),
    ({"model": "n"}, "n"),
    ({"disturbances": "no.csv"}, "no.csv"),
    ({"tolerance": 0}, "tolerance is 0.0, expected more than 0"),
]


@pytest.mark.parametrize(("changes", "told"), BAD)
def test_bad_input_is_one_sentence_and_writes_nothing(
    work: Path, dfsm: Dfsm, changes: dict[str, Any], told: str
):
    sentence = dfsm("optimize", written(**changes), "-o", "r").sentence
    assert told in sentence
    assert not (work / "r").exists()


def test_files_that_are_missing_or_foreign(work: Path, dfsm: Dfsm):
    assert "cannot be read" in dfsm("optimize", "none.yaml", "-o", "r").sentence
    (work / "mine").mkdir()
    (work / "mine" / "thesis.tex").touch()
    sentence = dfsm("optimize", written(), "-o", "mine").sentence
    assert "not a folder that dfsm wrote" in sentence

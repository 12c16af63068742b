"""Optimal control of the floating turbine on a coarse mesh: feasible, and the paper's trends."""

from __future__ import annotations

import json
import pickle
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import turbine_control
from benchmarks import scheduled
from benchmarks.accuracy import bundled, demo
from dfsm.control import Ending, load_solution, save_solution
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.report import write_solution_report
from dfsm.report.publish import publish
from systems import linear_model
from turbine_article import CLAIMS, answer_section, control_article, trends
from turbine_control import ControlStudy, ControlStudySettings, optimize, steady_gains, study
from turbine_problem import (
    BEST_COEFFICIENT,
    BLADE,
    MOMENT,
    PITCH,
    SHEAR,
    SPEED,
    TORQUE,
    Region,
    mean_power,
    problem,
    turbine_case,
)

pytestmark = pytest.mark.slow

SIZE = ControlStudySettings(points=200, pitch_limits=(5.0, 7.0))


@pytest.fixture(scope="module")
def region() -> Region:
    """The transition region, one wind series, fitted as the example does, without corrections."""
    data = demo()
    # No corrections, which this model hardly has, to save time.
    choices = replace(data.settings(5), corrective=NoCorrection(), nonlinear_only=False)
    training, tests = data.runs(["12"], range(1, 9)), data.runs(["12"], range(9, 10))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        model = fit(training, choices).model
    return Region("12 m/s", 12.0, model, model, training, tests, data.START)


@pytest.fixture(scope="module")
def found(region: Region) -> ControlStudy:
    return study([region], SIZE)


def test_every_case_is_solved_within_its_bounds(found: ControlStudy):
    assert [r.case.key for r in found.results] == ["a", "a", "b", "b"]
    for r in found.results:
        assert r.solution.solved, r.solution.message
        assert r.solution.violation < 1e-6
        run = r.run
        limits = {**r.case.bounds, PITCH: (r.case.lowest_pitch, r.most_pitch)}
        for name, (low, high) in limits.items():
            slack = 1e-6 * (high - low)
            assert low - slack <= run[name].min(), name
            assert run[name].max() <= high + slack, name
        assert len(run.time) == SIZE.points
        assert run.duration == pytest.approx(600)


def test_series_can_be_solved_in_other_processes(region: Region, found: ControlStudy):
    # What goes there and comes back; `work_through` has tests of its own.
    model = pickle.loads(pickle.dumps(region)).model
    np.testing.assert_array_equal(model.f.coefficients, region.model.f.coefficients)
    again = pickle.loads(pickle.dumps(found.results))
    for one, other in zip(again, found.results, strict=True):
        assert one.case == other.case
        assert one.power == other.power
        np.testing.assert_array_equal(one.run.values, other.run.values)


def test_bounds_of_this_turbine_come_from_its_own_runs(region: Region):
    case = turbine_case(region)
    for name in (SHEAR, MOMENT):
        low, high = case.bounds[name]
        seen = np.concatenate([r.window(region.start)[name] for r in region.training])
        share = np.mean(np.abs(seen) > high)
        assert low == -high
        assert share == pytest.approx(1e-3, rel=0.05)
    run = region.tests[0].window(region.start)
    assert np.mean(run["GenPwr"]) / 1e3 / mean_power(run) == pytest.approx(
        case.efficiency, abs=2e-3
    )


def test_trends_of_the_paper_in_the_transition_region(found: ControlStudy):
    told = trends(found.series()[found.results[0].series, "b"])
    assert list(told) == list(CLAIMS)
    assert all(v.startswith("yes") for v in told.values()), told


def test_power_is_in_megawatts_and_below_what_the_wind_holds(found: ControlStudy):
    for r in found.results:
        run = r.run
        by_hand = np.mean(run[TORQUE] * 1e3 * run[SPEED] * 2 * np.pi / 60) / 1e6
        assert r.power == pytest.approx(r.case.efficiency * by_hand, rel=0.01)
        assert r.power < r.available
        assert r.power == pytest.approx(r.case.efficiency * mean_power(r.recorded), rel=0.1)
        assert np.mean(r.power_course) == pytest.approx(r.power, rel=0.01)


def test_staying_inside_keeps_near_the_data_at_a_cost(region: Region, found: ControlStudy):
    results = {(r.case.key, r.most_pitch): r for r in found.results}
    inside = results["b", 5.0]
    free = optimize(region, region.tests[0], replace(inside.case, inside=False), 5.0, SIZE)
    assert free.outside[TORQUE] > 0.5
    assert not {TORQUE, BLADE, PITCH, SPEED} & set(inside.outside)
    assert free.solution.objective < inside.solution.objective
    assert inside.solution.objective == pytest.approx(free.solution.objective, rel=0.1)
    names = [c.name for c in region.model.signals.inputs]
    chosen = region.model.region.distance_chosen
    for r, near in ((free, False), (inside, True)):
        far = np.asarray(chosen(r.run.select(names).values)).max()
        assert (far < 1 + 1e-4) == near


def test_an_optimum_that_keeps_a_tighter_limit_is_not_sought_again(region: Region):
    size = ControlStudySettings(points=60, pitch_limits=(30.0, 20.0, 5.0))
    results = study([region], size).results
    assert [r.most_pitch for r in results] == [30.0, 20.0, 5.0] * 2
    loose, tighter, tight = results[3:]
    assert tighter.run is loose.run
    assert tight.run is not loose.run
    pitch = [c.name for c in region.model.signals.inputs].index(PITCH)
    assert tight.run[PITCH].max() <= 5 + 1e-6 < loose.run[PITCH].max() < 20
    for r in results:
        highest = r.solution.bounds[PITCH][1].max()
        inside = min(r.most_pitch, float(region.model.region.high[pitch]))
        assert highest == (inside if r.case.inside else r.most_pitch)


def test_an_optimum_within_a_limit_stands_for_a_wider_one_where_none_was_found(
    region: Region, monkeypatch
):
    calls = []

    def first_fails(*arguments):
        result = optimize(*arguments)
        calls.append(arguments[3])
        if len(calls) == 1:
            failed = replace(result.solution, ending=Ending.LIMIT)
            return replace(result, solution=failed)
        return result

    monkeypatch.setattr(turbine_control, "optimize", first_fails)
    size = ControlStudySettings(points=60, pitch_limits=(30.0, 20.0))
    loose, tighter, *_ = study([region], size).results
    assert calls[:2] == [30.0, 20.0]
    assert loose.solution.solved
    assert loose.run is tighter.run
    assert loose.solution.bounds[PITCH][1].max() == 30.0
    assert tighter.solution.bounds[PITCH][1].max() == 20.0


def test_the_best_power_coefficient_is_that_of_steady_wind_or_of_a_training_run(region: Region):
    assert region.best_coefficient == BEST_COEFFICIENT
    run = region.training[0]
    values = run.values.copy()
    values[:, run.names.index(TORQUE)] *= 2
    stronger = replace(region, training=[replace(run, values=values), *region.training[1:]])
    course = run.window(region.start)
    power = 2e3 * np.mean(course[TORQUE] * course[SPEED]) * np.pi / 30
    wind = 1.225 / 2 * np.pi * 120**2 * np.mean(course["RotWind"] ** 3)
    assert stronger.best_coefficient == pytest.approx(power / wind, rel=1e-3)
    assert stronger.best_coefficient > BEST_COEFFICIENT


def test_below_rated_wind_the_model_is_told_what_moves_the_rotor(monkeypatch):
    data, asked = bundled(), []
    training = data.runs([scheduled.BELOW_RATED], range(1, 3))
    with monkeypatch.context() as patch:
        # What it would be fitted to; the refinement takes a minute.
        patch.setattr(data, "runs", lambda *_: training)
        fit_of = scheduled.dfsm
        patch.setattr(fit_of, "fit", lambda *a: asked.extend(a) or SimpleNamespace(model=None))
        scheduled.below_rated()
    runs, choices, refinement = asked
    names = [r.name.removeprefix("iea15_2dof_") for r in runs]
    assert names == ["06mps_s01", "06mps_s02", "06mps_s01_ol"]
    assert BLADE not in refinement.latent_inputs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        model = fit(runs, choices).model
    names = [c.name for c in model.signals.inputs]
    row = [c.name for c in model.signals.states].index(SPEED)
    effects = dict(zip(names, np.asarray(model.f.coefficients)[:, row].T, strict=True))
    speed, torque, wind = (
        np.mean([r.window(data.START)[name].mean() for r in training])
        for name in (SPEED, TORQUE, "RotWind")
    )
    J, to_rpm = 318.6e6, 30 / np.pi  # kg m² with the generator
    known = {
        TORQUE: -1e3 / J * to_rpm,
        # d(T/J)/dω = -T/(J ω) at constant power, per rpm.
        SPEED: -1e3 * torque / (J * speed) * to_rpm,
        BLADE: 0.0,
        PITCH: 0.0,
        # The hub is 150 m up and moves against the wind.
        f"{PITCH}_dot": -1e3 / J * to_rpm * 3 * torque / wind * np.radians(150),
    }
    for name, value in known.items():
        np.testing.assert_allclose(effects[name], value, rtol=1e-3, atol=1e-15)


def test_bounds_that_cannot_be_met_are_named(region: Region):
    case = turbine_case(region)
    # A platform that must stay level in 12 m/s of wind, at rated torque and no blade pitch.
    bounds = {**case.bounds, TORQUE: (19000.0, 19900.0), BLADE: (0.0, 1.0), SPEED: (1.9, 6.9)}
    hard = replace(case, bounds=bounds)
    r = optimize(region, region.tests[0], hard, 2.0, replace(SIZE, points=60))
    assert not r.solution.solved
    assert "dynamics of" in r.solution.message or "misses by" in r.solution.message
    article = control_article(ControlStudy((r,), SIZE, 1.0, {}))
    assert r.solution.message in " ".join(article.sections[-1].paragraphs)
    assert trends({2.0: r})[CLAIMS[0]] == "not solved"


def test_the_page_holds_every_series_and_the_figures_every_limit(
    found: ControlStudy, tmp_path: Path
):
    article = control_article(found)
    power, *others = article.figures()
    assert article.sections[0].figures == (power,)
    assert article.sections[0].paragraphs[0] == f"{len(found.results)} of {len(found.results)} " + (
        "problems were solved."
    )
    best = {r.most_pitch: r.power for r in found.results if r.case.key == "b"}
    few = [replace(r, available=r.power / 2) if r.case.key == "a" else r for r in found.results]
    told = answer_section(replace(found, results=tuple(few))).figures[0].caption
    assert "not to be believed, for the wind holds less: case a of" in told
    assert "case b" not in told
    # A telephone's first screen holds them and the figure.
    assert len(article.lede + " ".join(article.sections[0].paragraphs)) < 200
    asked = " ".join(article.sections[1].paragraphs)
    assert f"{best[7.0]:.2f} MW with Θp,max = 7 deg" in asked
    (curve,) = next(p for p in power.panels if p.title == "case b").curves
    assert dict(zip(curve.x, curve.y, strict=True)) == best
    for figure in others:
        assert figure.stacked
        assert [p.title.split(" (")[0] for p in figure.panels] == [
            *("RotWind", TORQUE, BLADE, PITCH, SPEED, "power", SHEAR, MOMENT)
        ]
        names = {c.name for c in figure.panels[3].curves}
        assert names == {"Θp,max = 5 deg", "Θp,max = 7 deg", "bounds"}
    # One figure is enough to print.
    own = ControlStudy(found.results[2:4], found.settings, found.seconds, found.gains)
    written = publish(control_article(own), tmp_path)
    tables = json.loads(written[1].read_text(encoding="utf-8"))
    assert len(tables["control_12mps_s09"]) == 2
    assert (tmp_path / "figures" / "control_12mps_s09_b.png").is_file()
    assert "panels stacked" in written[0].read_text(encoding="utf-8")


def test_a_solution_has_a_page_of_its_own_bounds_included(found: ControlStudy, tmp_path: Path):
    solution = found.results[2].solution
    save_solution(solution, tmp_path / "s")
    loaded = load_solution(tmp_path / "s")
    bounded = {TORQUE, BLADE, PITCH, SPEED, SHEAR, MOMENT}
    # Inside the training data every state has a range.
    assert loaded.bounds.keys() == bounded | {f"{PITCH}_dot", f"{SPEED}_dot"}
    write_solution_report(loaded, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    for channel in solution.trajectory.channels:
        assert f"{channel.name} ({channel.unit})" in page


def test_a_model_without_the_channels_is_refused(region: Region):
    model = linear_model(-np.eye(1), np.eye(1))
    with pytest.raises(DfsmError, match="the model has no channel 'GenTq'"):
        problem(model, region.tests[0], turbine_case(region), 5.0, (100.0, 700.0))


def test_gains_are_those_of_the_steady_state():
    # q̈ = −4 q − 2 q̇ + 3 u in steady state: q = 0.75 u.
    A, B = np.array([[0, 1.0], [-4, -2]]), np.array([[0, 0], [3.0, -1]])
    model = linear_model(A, B, names=[SPEED, "v"], units=["rpm", "rpm/s"])
    channels = tuple(
        replace(c, name=n) for c, n in zip(model.signals.controls, (TORQUE, BLADE), strict=True)
    )
    model = replace(model, signals=replace(model.signals, controls=channels))
    assert steady_gains(model, 0.0) == pytest.approx((750.0, -0.25))

"""Figures and notebook texts of results: what they hold is what the results hold."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import dfsm
import fits
from dfsm.control.mesh.grid import Grid
from dfsm.control.solution import Ending, Solution
from dfsm.core.drawing import Shown
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.loops.adaptive import AdaptiveResult, Agreement, Realised, Round
from dfsm.loops.load_cases import Figures
from dfsm.loops.sweep import Sweep, Swept
from dfsm.loops.trust_region import Confirmation, ConfirmedTuning
from dfsm.loops.tuning_result import TuneStatus, TuningResult
from dfsm.models.summary import lines_of
from dfsm.refinement.refine import RefineResult
from dfsm.report.result_figures import extremes
from dfsm.selection.compare import RankedCandidate, Ranking
from dfsm.selection.trial import Outcome
from dfsm.simulation.closed_loop import ClosedLoopRun, LoopStatus
from dfsm.simulation.simulate import Status
from dfsm.validation.closed_loop import ClosedLoopValidation
from dfsm.validation.intervals import Intervals

TIME = np.linspace(0, 4, 9)
# What a notebook needs, and nothing that runs or loads.
TAGS = {"div", "p", "b", "table", "thead", "tbody", "tr", "th", "td", "ul", "li"}


class Text(HTMLParser):
    """Tags and words of a piece of HTML."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.words = set(), []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)

    def handle_data(self, data):
        self.words.append(data)


def traces(figure, name=None):
    return [t for t in figure.data if name is None or t.name == name]


@pytest.fixture(scope="module")
def validation():
    model, runs = fits.linear().model, fits.linear_runs()[:2]
    grid, half = np.asarray(model.region.grid), np.array([[0.05, 0.1, 0.2]])
    expected = Intervals(
        ("q", "v", "y"), ("m", "m/s", "kN"), None, grid, half, 0.8, ("a", "b"), ("", "")
    )
    with hushed():
        return dfsm.validate(dfsm.compared(model, None), runs, intervals=expected)


def solution():
    channels = (
        Channel("u", "N", role="control"),
        Channel("x", "m", role="state"),
        Channel("p", "", role="parameter"),
    )
    values = np.stack([np.sin(TIME), 1e5 + TIME, np.ones(9)], axis=1)
    run = Trajectory(TIME, values, channels, name="one")
    bounds = {"u": np.stack([np.full(9, -0.9), np.full(9, 0.9)])}
    return Solution(
        "cart", Ending.SOLVED, "", 2.5, 0.5, 2.0, (run, replace(run, values=2 * values)), (), {},
        {"p": 1.0}, Grid("trapezoidal", 1, np.linspace(0, 1, 9)), 1e-6, (), 5,
        {"compile": 0.1, "solve": 0.2}, False, 1e-9, None, bounds=bounds,
    )  # fmt: skip


def test_a_run_is_drawn_sample_by_sample_whatever_its_names_and_offsets():
    channels = (Channel("<b>p</b>", "Pa"), Channel("$x_1$", "m"))
    values = np.stack([1e9 + np.sin(TIME), np.cos(TIME)], axis=1)
    run = Trajectory(1e6 + TIME, values, channels, name="<i>run</i>")
    figure = run.plot()
    np.testing.assert_array_equal(figure.data[0].y, values[:, 0])
    np.testing.assert_array_equal(figure.data[1].x, run.time)
    shown = [a.text for a in figure.layout.annotations]
    assert shown == ["&lt;b&gt;p&lt;/b&gt; (Pa)", "$x_1$ (m)"]
    assert "<i>" not in figure.layout.title.text
    assert [t.yaxis for t in run.plot(["$x_1$"]).data] == ["y"]
    with pytest.raises(DfsmError, match=r"no channel '\$x_2\$' to draw; did you mean '\$x_1\$'"):
        run.plot(["$x_2$"])
    with pytest.raises(DfsmError, match="engine is 'ggplot', expected one of 'plotly', 'matpl"):
        run.plot(engine="ggplot")  # pyright: ignore[reportArgumentType]


def test_long_runs_are_thinned_to_their_extremes():
    time = np.arange(100_001) * 0.01
    values = np.sin(time)
    values[[40_003, 99_999]] = 7.0, -7.0
    values[500:900] = np.nan
    kept_time, kept = extremes(time, values, 2000)
    assert len(kept) <= 2002
    assert (np.nanmax(kept), np.nanmin(kept)) == (7.0, -7.0)
    assert (kept_time[0], kept_time[-1]) == (time[0], time[-1])
    np.testing.assert_array_equal(kept, values[np.searchsorted(time, kept_time)])
    assert extremes(time[:9], values[:9])[0] is not None
    assert len(extremes(time[:9], values[:9])[0]) == 9


def test_a_validation_draws_the_record_its_models_and_their_intervals(validation):
    figure = validation.plot(["y"], run=1)
    run = validation.runs[1]
    (recorded,) = traces(figure, "recorded")
    (model,) = traces(figure, "multi-fidelity")
    np.testing.assert_array_equal(recorded.y, run.recorded["y"])
    simulated = run.models["multi-fidelity"].simulation.trajectory
    np.testing.assert_array_equal(model.y, simulated["y"])
    low, high = traces(figure, "multi-fidelity, 80% prediction interval")
    np.testing.assert_allclose(np.asarray(high.y) - low.y, 0.4)
    score = run.models["multi-fidelity"].errors["y"].nrmse
    assert f"{score:.2g}" in figure.layout.annotations[0].text
    by_name = validation.plot(["y"], run=run.recorded.name)
    np.testing.assert_array_equal(traces(by_name, "recorded")[0].y, recorded.y)
    with pytest.raises(DfsmError, match="run is 2, expected 0 to 1"):
        validation.plot(run=2)


def test_a_rollout_that_ran_away_does_not_flatten_the_record(validation):
    run = validation.runs[0]
    model = run.models["linear-fit"]
    path = model.simulation.trajectory
    grown = replace(path, values=path.values * np.linspace(1, 1e6, len(path))[:, None])
    ended = replace(model.simulation, trajectory=grown, status=Status.LEFT_REGION)
    gone = replace(model, simulation=ended, errors={}, statistics={})
    broken = replace(validation, runs=(replace(run, models={**run.models, "linear-fit": gone}),))
    low, high = broken.plot(["q"]).layout.yaxis.range
    assert np.ptp(run.recorded["q"]) < high - low < 3 * np.ptp(run.recorded["q"])


def test_figures_of_a_validation_are_one_table(validation):
    frame = validation.to_pandas()
    assert len(frame) == 2 * 2 * 3
    line = frame[(frame["model"] == "linear-fit") & (frame["channel"] == "v")].iloc[1]
    error = validation.runs[1].models["linear-fit"].errors["v"]
    assert (line["rmse"], line["nrmse"], line["unit"]) == (error.rmse, error.nrmse, "m/s")
    assert line["std_recorded"] == validation.runs[1].statistics["v"].std
    means = frame[frame["model"] == "multi-fidelity"].groupby("channel")["nrmse"].mean()
    assert means["y"] == pytest.approx(validation.mean_nrmse("multi-fidelity", "y"))


def test_a_solution_is_drawn_with_its_bounds():
    found = solution()
    figure = found.plot(scenario=1)
    assert [a.text for a in figure.layout.annotations] == ["u (N)", "x (m)"]
    np.testing.assert_array_equal(traces(figure, "scenario 2")[0].y, 2 * np.sin(TIME))
    np.testing.assert_array_equal(traces(figure, "bounds")[0].y, np.full(9, -0.9))
    # 4 m on top of 100 km are no rounding errors.
    assert figure.layout.yaxis2.range is None
    with pytest.raises(DfsmError, match="scenario is 2, expected 0 to 1"):
        found.plot(scenario=2)


def figures(std):
    return Figures(0.0, std, -1.0, 1.0, 2 * std, {"4": 3 * std})


def comparisons():
    """A sweep, a ranking and rounds, with figures that are known."""
    record = Swept("recorded", (), (), {"q": figures(2.0), "v": figures(0.0)}, None, None)
    soft = Swept("soft", (), (), {"q": figures(3.0), "v": figures(1.0)}, None, None)
    wrong = Swept("wrong", (), ("r0: unstable",), {}, None, None)
    sweep = Sweep((soft, wrong), record, ("r0",), (1.0,), {"q": "m", "v": "m/s"})
    outcomes = {"a": Outcome(nrmse={"q": 0.2}), "b": Outcome(nrmse={"q": None}, diverged=1)}
    entries = [RankedCandidate(n, "", o, o.nrmse["q"], None, True) for n, o in outcomes.items()]
    ranking = Ranking(tuple(entries), ("q",), ("t",), ("v",))
    done = solution()
    rounds = [Round(done, done.trajectory, Realised(c, {}, 0.25, 0.25), 0.1) for c in (3.0, 2.0)]
    runs = (done.trajectory,)
    model = fits.linear().model
    return (
        sweep,
        ranking,
        AdaptiveResult(Agreement(next(iter(Agreement))), done, model, tuple(rounds), 1, runs, 2),
    )


def test_comparisons_are_drawn_as_ratios_errors_and_rounds():
    sweep, ranking, adaptive = comparisons()
    soft = traces(sweep.plot(), "soft")
    # The velocity has no spread in the record, so no ratio.
    assert [list(t.x) for t in soft] == [[1.5], [1.5], [1.5]]
    assert not traces(sweep.plot(), "wrong")
    (errors,) = ranking.plot().data
    assert (list(errors.x), list(errors.y)) == ([0.2], [1.0])
    assert ranking.plot().layout.yaxis.ticktext == ("a", "b (1 ended early)")
    drawn = {t.name: list(t.y) for t in adaptive.plot().data}
    assert drawn["predicted by the model"] == [2.5, 2.5]
    assert drawn["realised by the simulator"] == [3.0, 2.0]
    empty = replace(sweep, controllers=(sweep.controllers[1],), recorded=sweep.controllers[1])
    with pytest.raises(DfsmError, match="no controller completed all runs"):
        empty.plot()


def tuned():
    """A tuning whose loops are known."""
    run = solution().trajectory
    measure = SimpleNamespace(channel="x", label="std of x", weight=1.0)
    problem: Any = SimpleNamespace(objective=(measure,), measures=(measure,), parameters={})
    after = ClosedLoopRun(run, LoopStatus.COMPLETED, 4.0, "", 0.0)
    before = replace(after, trajectory=replace(run, values=3 * run.values))
    return TuningResult(
        problem, None, {}, {}, np.array([2.0]), np.array([4.0]), 2.0, 4.0, 0.0, TuneStatus.SOLVED,
        (), (), (after,), (before,), {}, 1, 1, 0.1,
    )  # fmt: skip


def test_a_tuning_is_drawn_before_and_after():
    figure = tuned().plot()
    assert [a.text for a in figure.layout.annotations] == ["x (m)"]
    np.testing.assert_array_equal(traces(figure, "tuned")[0].y, 1e5 + TIME)
    np.testing.assert_array_equal(traces(figure, "before")[0].y, 3 * (1e5 + TIME))
    assert "std of x" in Text(tuned()._repr_html_()).words


def test_print_draws_what_the_screen_draws(validation):
    pytest.importorskip("matplotlib")
    sheet = validation.plot(["q", "y"], engine="matplotlib")
    recorded = validation.runs[0].recorded
    for axes, name in zip(sheet.axes, ("q", "y"), strict=True):
        lines = {line.get_label(): line.get_ydata() for line in axes.lines}
        np.testing.assert_array_equal(lines["recorded"], recorded[name])
        assert axes.get_title(loc="left").startswith(recorded.channel(name).label)
        (band,) = axes.collections
        assert "80% prediction interval" in band.get_label()
    run = Trajectory(TIME, TIME[:, None], (Channel("$x_1$ ^"),))
    assert run.plot(engine="matplotlib").axes[0].get_title(loc="left") == r"\$x_1\$ ^"


def test_notebooks_show_a_verdict_and_a_table_and_no_figure(validation):
    model, run = fits.linear().model, fits.linear_runs()[0]
    rollout = validation.runs[0].models["linear-fit"].simulation
    evil = replace(run, name="<script>alert(1)</script>")
    for result in (model, evil, rollout, validation, solution(), *comparisons()):
        html = result._repr_html_()
        text = Text(html)
        assert text.tags <= set(
            ["div", "p", "b", "table", "thead", "tbody", "tr", "th", "td", "ul", "li"]
        )
        assert "table" in text.tags
        assert len(html) < 8000
    told = " ".join(Text(validation._repr_html_()).words)
    assert "linear-fit 2 of 2" in told
    assert "2 of the 2 test runs were used in training" in told
    wide = Trajectory(TIME, np.ones((9, 300)), tuple(Channel(f"c{i}") for i in range(300)))
    assert "and 285 rows more" in wide._repr_html_()
    assert len(wide.plot().data) == 12


def test_what_is_printed_of_a_result_is_a_sentence(validation):
    listed = [solution(), tuned(), validation, *comparisons()]
    listed.append(ClosedLoopValidation((Channel("q"),), ()))
    listed.append(ConfirmedTuning(next(iter(Confirmation)), (), 0, None))
    steps = tuple({"stage": 1.0, "training": 0.2} for _ in range(300))
    listed.append(RefineResult(fits.linear().model, True, 0.2, 0.1, steps, (), "refined"))
    for result in listed:
        said = repr(result)
        assert said.startswith(f"<{type(result).__name__}"), said
        assert len(said) < 500, said
    sweep, _, adaptive = comparisons()
    assert repr(sweep) == "<Sweep: 2 controllers over 1 run; table() has their figures>"
    assert "best of 2 rounds is number 2, objective 2.5;" in repr(adaptive)
    assert "objective 2, before 4;" in repr(tuned())


def test_results_that_notebooks_show_have_a_line_of_their_own():
    public = [getattr(dfsm, name) for name in dfsm.__all__ if name != "__version__"]
    shown = [c for c in public if isinstance(c, type) and issubclass(c, Shown)]
    assert len(shown) > 9
    # What a dataclass makes for itself prints every number of every run.
    assert [c for c in shown if hasattr(c.__repr__, "__wrapped__")] == []


def test_a_model_is_told_in_eighty_columns():
    model = fits.linear().model
    told = str(model)
    assert max(map(len, told.splitlines())) <= 80
    assert told.split() == " ".join(lines_of(model)).split()

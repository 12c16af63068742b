"""The two-link robot study: its claims in quick mode, and everything that it leaves behind."""

from __future__ import annotations

import json
import re
from html import escape
from pathlib import Path

import numpy as np
import pytest

from conftest import Dfsm, example_module
from dfsm.demos.two_link_robot import study as two_link_robot
from dfsm.demos.two_link_robot.article import robot_article
from dfsm.demos.two_link_robot.defaults import PEER
from dfsm.demos.two_link_robot.multi_fidelity import LINEAR, MULTI, NONLINEAR
from dfsm.demos.two_link_robot.study import RobotStudy
from dfsm.report import publish as publishing

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[1] / "docs" / "results" / "two-link-robot.md"


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def quick(output: Path) -> RobotStudy:
    """The study as the example runs it, in quick mode."""
    return example_module("two_link_robot").main(["--quick", "--output", str(output)])


# -- the paper's claims, and ours ---------------------------------------------------------------


def test_spline_derivatives_are_as_accurate_as_the_paper_says(quick):
    assert 5e-8 < quick.extraction.mean < 1e-6
    # The simulator's tolerance is what limits them.
    _, loose, tight = quick.extraction.durations[0]
    assert tight < 0.02 * loose


def test_the_orders_of_the_spline_are_four_at_samples_and_three_between(quick):
    at, between = quick.extraction.refinement.orders
    assert at == pytest.approx(4, abs=0.3)
    assert between == pytest.approx(3, abs=0.2)


def test_the_linear_fit_finds_the_poles_at_rest_to_four_digits(quick):
    t = quick.taylor
    assert t.stationary == pytest.approx([4.9329, 1.9881, -1.9881, -4.9329], abs=5e-5)
    assert t.unforced == pytest.approx([5.2160, 2.6533, -2.6533, -5.2160], abs=5e-5)
    assert t.fits[-1].poles == pytest.approx(t.stationary, abs=5e-4)
    # First order in the size of the motions, until rounding and the simulator show.
    first, second, _ = t.distance(t.stationary)
    assert second < first / 5
    # Without an offset, the paper's formula, it goes elsewhere.
    assert t.distance(t.stationary, offset=False)[-1] > 5e-3


def test_rows_of_angles_are_linear_and_get_no_correction(quick):
    corrected = [d["corrected"] for d in quick.taylor.decisions]
    assert corrected == [False, True, False, True]
    for row in (0, 2):
        d = quick.taylor.decisions[row]
        assert d["residual_rms"] < 1e-6 * d["std"]


def test_a_correction_helps_and_leaves_linear_rows_alone(quick):
    found = quick.multi_fidelity.assessed
    linear, multi, nonlinear = (found[n] for n in (LINEAR, MULTI, NONLINEAR))
    assert (multi.slopes[:2] < 0.9 * linear.slopes[:2]).all()
    assert (multi.slopes[2:] < 1e-6).all()
    assert (nonlinear.slopes[2:] > 1e-2).all()
    assert multi.rollouts.completed == len(multi.rollouts.errors) == 20


def test_the_documentation_states_the_sweep(quick):
    text = PAGE.read_text(encoding="utf-8")
    block = text.split("<!-- sweep -->")[1].split("<!-- end -->")[0]
    stated = {row.split(" | ")[0].strip("| "): row.split(" | ")[4:] for row in block.splitlines()}
    sweep = quick.multi_fidelity.sweep
    pairs = zip(sweep.assessed[MULTI], sweep.assessed[NONLINEAR], strict=True)
    for n, (a, b) in zip(sweep.samples, pairs, strict=True):
        errors = np.stack([a.rollouts.rmse, b.rollouts.rmse], axis=1).ravel()
        assert [float(c.strip(" |")) for c in stated[str(n)]] == pytest.approx(errors, rel=0.05)


def test_the_published_program_is_beaten_in_every_state(quick):
    for fitted in quick.kinds.values():
        assert fitted.short.rollouts.completed == fitted.long.completed == 20
        assert (fitted.short.rollouts.rmse < PEER).all()


# -- what it leaves behind ----------------------------------------------------------------------


def test_the_page_is_complete_and_needs_no_network(quick, output):
    page = (output / "two_link_robot.html").read_text(encoding="utf-8")
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"(?:src|href)\s*=|url\(|@import", markup)
    article = robot_article(quick)
    for section in article.sections:
        assert escape(section.heading) in markup
    for table in article.tables():
        assert escape(table.caption) in markup
    for figure in article.figures():
        assert f'id="{figure.key}"' in markup


def test_tables_in_json_hold_the_numbers(quick, output):
    tables = json.loads((output / "two_link_robot.json").read_text(encoding="utf-8"))
    assert set(tables) == {t.key for t in robot_article(quick).tables()}
    assert tables["extraction"][0]["tolerance 10⁻⁹"] == quick.extraction.mean
    assert [row["Holds"] for row in tables["claims"]][:3] == [
        "yes",
        "yes, with the right poles",
        "yes",
    ]


def test_every_figure_is_drawn_for_print(quick, output):
    pytest.importorskip("matplotlib")
    keys = [f.key for f in robot_article(quick).figures()]
    names = {p.name for p in (output / "figures").iterdir()}
    assert names == {k + suffix for k in keys for suffix in (".pdf", ".png")}
    assert all((output / "figures" / name).stat().st_size > 5000 for name in names)


def test_the_command(quick, tmp_path, dfsm: Dfsm, monkeypatch):
    asked = []

    def study(size, seed):
        asked.append((size, seed))
        return quick

    monkeypatch.setattr(two_link_robot, "study", study)
    monkeypatch.setattr(publishing, "find_spec", lambda name: None)
    command = ("demo", "two-link-robot", "-o", tmp_path / "new")
    result = dfsm(*command, "--quick", "--seed", 7)
    assert (result.code, result.err) == (0, "")
    assert "4.9329" in result.out
    assert "pip install 'dfsm[figures]'" in result.out
    assert asked == [(two_link_robot.QUICK, 7)]
    assert {p.name for p in (tmp_path / "new").iterdir()} == {
        "two_link_robot.html",
        "two_link_robot.json",
    }
    assert dfsm(*command, "--quiet").out == ""
    assert asked[-1] == (None, 0)
    result = dfsm(*command, "--json")
    written = json.loads((tmp_path / "new" / "two_link_robot.json").read_text(encoding="utf-8"))
    assert json.loads(result.out) == written

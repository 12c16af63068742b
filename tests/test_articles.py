"""Articles as text and markup, rollouts that end early, and what `dfsm demo` refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from conftest import Dfsm
from dfsm.demos.two_link_robot.assess import hushed, roll
from dfsm.demos.two_link_robot.multi_fidelity import draw, fit_settings
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import fit
from dfsm.report.article import Article, Curve, Figure, Panel, Section, Table, cell_text
from dfsm.report.article_page import write_article
from dfsm.simulators import two_link_robot as arm

# -- the command --------------------------------------------------------------------------------


def test_what_the_command_refuses(tmp_path, dfsm: Dfsm):
    (tmp_path / "two_link_robot.html").mkdir()
    assert "is a folder" in dfsm("demo", "two-link-robot", "-o", tmp_path).sentence
    assert (
        "seed is -1" in dfsm("demo", "two-link-robot", "-o", tmp_path / "x", "--seed=-1").sentence
    )
    assert "two-link-robot" in dfsm("demo", "--help").out


# -- rollouts -----------------------------------------------------------------------------------


def test_a_rollout_that_ends_early_has_no_rmse():
    runs = draw(6, 1.0, seed=3)
    with hushed():
        fitted = fit(runs, fit_settings(arm(), RBF(samples=30))).model
    found = roll(fitted, runs)
    assert found.completed == 6
    assert (found.rmse > 0).all()
    assert found.of_runs.shape == (6, 4)
    # A training range a thousand times smaller is left at once.
    middle = (fitted.region.low + fitted.region.high) / 2
    small = replace(
        fitted.region,
        low=middle + (fitted.region.low - middle) / 1000,
        high=middle + (fitted.region.high - middle) / 1000,
    )
    ended = roll(replace(fitted, region=small), runs)
    assert ended.completed == 0
    assert np.isnan(ended.rmse).all()
    assert np.isinf(ended.typical).all()


# -- articles -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (3.2e-7, 2, "3.2·10⁻⁷"),
        (-4.93291, 5, "−4.9329"),
        (0.0123456, 3, "0.0123"),
        (999.96, 3, "1000"),
        (0.0009999, 2, "0.0010"),
        (1234567.0, 2, "1.2·10⁶"),
        (0.0, 3, "0"),
        (12, 3, "12"),
        (None, 3, "–"),
        (float("nan"), 3, "–"),
        ("text", 3, "text"),
    ],
)
def test_numbers_are_rounded_for_show(value, digits, text):
    assert cell_text(value, digits) == text


def test_texts_of_an_article_are_data_and_never_markup(tmp_path):
    evil = "<script>alert(1)</script>"
    curve = Curve(evil, np.arange(3.0), np.array([1.0, np.nan, 2.0]))
    panel = Panel(evil, evil, evil, (curve,), ticks=((1.0, evil),))
    section = Section(
        "key",
        evil,
        (evil,),
        (Table("t", evil, (evil, "n"), ((evil, 1.0),), note=evil),),
        (Figure("f", evil, (panel,)),),
    )
    write_article(Article("a", evil, evil, (section,)), tmp_path / "a.html")
    assert evil not in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_a_table_in_markdown():
    table = Table("t", "", ("name", "value"), (("a", 1.0), ("b", None)), digits=2)
    assert table.markdown() == ["| name | value |", "| --- | ---: |", "| a | 1.0 |", "| b | – |"]

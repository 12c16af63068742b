"""What pages begin with: a verdict in words and a figure."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from dfsm.data.trajectory import Channel, Trajectory
from dfsm.demos.two_link_robot.claims import verdict
from dfsm.loops.tuning_problem import Goal, TuningProblem
from dfsm.loops.tuning_result import TuneStatus, TuningResult
from dfsm.report.article import Section, Table
from dfsm.report.closed_loop_article import closed_loop_article
from dfsm.report.tuning_article import tuning_article
from dfsm.simulation.closed_loop import ClosedLoopRun, LoopStatus

TIME = np.linspace(0, 4, 9)


def test_a_tuning_says_what_was_gained():
    run = Trajectory(TIME, np.sin(TIME)[:, None], (Channel("x", "m"),), name="gust")
    loop = ClosedLoopRun(run, LoopStatus.COMPLETED, 4.0, "", 0.0)
    result = TuningResult(
        problem=TuningProblem(
            parameters={"kp": (0.0, 1.0)}, objective=(Goal(measure="std", channel="x"),)
        ),
        controller=None,
        values={"kp": 1.0},
        before={"kp": 0.5},
        figures=np.array([2.0]),
        before_figures=np.array([4.0]),
        objective=2.0,
        before_objective=4.0,
        violation=0.0,
        status=TuneStatus.SOLVED,
        starts=(),
        front=(),
        loops=(loop,),
        before_loops=(loop,),
        changes={},
        evaluations=1,
        gradients=1,
        seconds=0.1,
    )
    article = tuning_article(result)
    assert article.lede.startswith("The objective goes from 4.00 to 2.00 (\N{MINUS SIGN}50 %). No ")
    assert "kp at a bound" in article.lede
    (panel,) = article.sections[0].figures[0].panels
    assert {c.name: c.x.tolist() for c in panel.curves} == {"as it was": [1, 1], "tuned": [0.5]}
    assert panel.ticks == ((0.0, "std of x"),)
    unstable = replace(result, before_objective=np.nan, before_figures=np.array([np.nan]))
    assert tuning_article(unstable).lede.startswith("The objective is 2.00, and was no number")
    assert not tuning_article(unstable).sections[0].figures


def test_closed_loops_say_how_far_they_are_from_the_record():
    row = dict.fromkeys(("damage_ratio", "damage_worst", "replay_damage_ratio"))
    row |= dict.fromkeys(("recorded_mean", "mean", "std_worst", "replay_std_ratio"), 1.0)
    row |= dict.fromkeys(("nrmse", "replay_nrmse"), 0.1)
    rows = {n: SimpleNamespace(**row, std_ratio=v) for n, v in (("x", 0.5), ("y", 1.2))}
    loops: Any = SimpleNamespace(
        completed=1,
        runs=2 * [SimpleNamespace(loop_statistics={})],
        channels=(Channel("x", "m"), Channel("y", "m")),
        endings=list,
        row=rows.get,
    )
    article = closed_loop_article(loops, "model", "pi")
    assert article.lede == (
        "1 of 2 closed loops came to their end. Their standard deviations are 0.50 (x) to 1.20 (y) "
        "times those of the record."
    )
    (panel,) = article.sections[0].figures[0].panels
    # Nothing has a damage-equivalent load, so no dot and no column is kept for one.
    assert [c.name for c in panel.curves] == ["as recorded", "standard deviation"]
    assert panel.curves[-1].x.tolist() == [0.5, 1.2]
    assert not any("DEL" in head for head in article.sections[1].tables[0].columns)


def test_claims_are_counted():
    answers = ("yes", "yes, with the right poles", "a little", "in part", "no")
    rows = tuple(("claim", "paper", "here", answer) for answer in answers)
    table = Table("claims", "", ("Claim", "Paper", "Here", "Holds"), rows)
    told = verdict(Section("claims", "Claims", tables=(table,)))
    assert told == "Of 5 claims of the paper 2 hold, 2 hold in part and 1 do not."

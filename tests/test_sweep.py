"""Many controllers on many runs, load cases, and the command, against sums made by hand."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dfsm as package
from dfsm.data.readers import read
from dfsm.errors import DfsmError
from dfsm.loops.load_cases import Figures
from systems import driving_run, law, linear_model

A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0, 0.0], [2.0, 0.5]])
TIME = np.arange(0, 20.01, 0.1)


def test_a_sweep_holds_what_each_loop_does_and_what_a_life_of_them_does():
    model = linear_model(A, B, np.array([[1.0, 0.0]]), names=["q", "v"])
    power = replace(model.signals.outputs[0], name="P", unit="MW")
    model = replace(model, signals=replace(model.signals, outputs=(power,)))
    runs = []
    for i, size in enumerate((1.0, 3.0)):
        inputs = np.stack([0 * TIME, size * np.sin(1.7 * TIME)], axis=1)
        runs.append(driving_run(model, TIME, inputs, np.tile([0.5, 0], (len(TIME), 1)), f"r{i}"))
    settings = package.SweepSettings(
        loop=package.ClosedLoopSettings(start_up=2.0), power="P", speed="q", rated_speed=0.5
    )
    gains = {"soft": law(0.2), "stiff": law(1.5), "wrong": law(-80.0)}
    weights = [0.5, 0.25]
    swept = package.sweep(model, runs, gains, weights=weights, settings=settings)
    soft, stiff, wrong = swept.controllers
    with package.errors.hushed():
        alone = [package.closed_loop(model, r, gains["soft"], settings=settings.loop) for r in runs]
    paths = [a.trajectory for a in alone]
    for path, figures in zip(paths, soft.runs, strict=True):
        assert figures["q"].std == pytest.approx(path["q"].std())
        rate = np.abs(np.diff(path["u0"])).sum() / path.duration
        assert figures["u0"].travel == pytest.approx(rate)
    shares = np.array([2, 1]) / 3
    loads = [f["P"].damage["4"] for f in soft.runs]
    assert soft.figures["P"].damage["4"] == pytest.approx((shares @ np.power(loads, 4)) ** 0.25)
    mean = shares @ [p["P"].mean() for p in paths]
    assert soft.energy == pytest.approx(mean * 0.75 * 8766)
    square = shares @ [(p["q"] ** 2).mean() for p in paths]
    q = soft.figures["q"]
    assert q.std**2 + q.mean**2 == pytest.approx(square)
    assert soft.overshoot == pytest.approx(max(p["q"].max() for p in paths) / 0.5 - 1)
    assert stiff.figures["q"].std < soft.figures["q"].std
    assert wrong.figures == {}
    assert "the loop is unstable" in wrong.endings[0]
    # The record has no output: its line has states and controls.
    assert swept.recorded.figures["u1"].std == pytest.approx(soft.figures["u1"].std, rel=1e-3)
    table = swept.table()
    assert list(table.index) == ["recorded", "soft", "stiff", "wrong"]
    assert table.loc["soft", "P DEL"] == soft.figures["P"].damage["4"]
    said = json.loads(json.dumps(swept.to_dict(), allow_nan=False))
    assert said["controllers"][2]["energy"] is None
    with pytest.raises(DfsmError, match=r"weights is .* expected one per run, 2"):
        package.sweep(model, runs, gains, weights=[1.0])
    with pytest.raises(DfsmError, match="the model has no channel 'Q'"):
        package.sweep(model, runs, gains, settings=package.SweepSettings(power="Q"))


def test_weibull_weights_are_shares_of_the_distribution():
    weights = package.weibull_weights([6, 6, 12, 18], mean=9.0)
    scale = 9 / math.gamma(1.5)

    def below(v):
        return 1 - math.exp(-((v / scale) ** 2))

    expected = [below(9) - below(3), below(15) - below(9), below(21) - below(15)]
    assert weights == pytest.approx([expected[0] / 2, expected[0] / 2, *expected[1:]])
    with pytest.raises(DfsmError, match="winds are 6, expected at least two different"):
        package.weibull_weights([6, 6], mean=9.0)


def test_a_constant_load_does_no_damage():
    figures = Figures.of(TIME, np.full(len(TIME), 2.0))
    assert Figures.over([figures, figures], [1, 1]) == figures


OWN = """
import dfsm
mine = dfsm.PID(
    kp=-0.5, ki=-0.1, setpoint=0.0, measurements=["q"], measurement_units=["m"],
    commands=["u"], command_units=["N"], interval=0.05,
)
number = 3
"""


def test_the_command_closes_the_loop_with_a_controller_of_ones_own(here, dfsm, fitted):
    Path("control.py").write_text(OWN)
    command = ("closed-loop", fitted, "test/d.outb", "-o", "out")
    options = ("--controller", "control.py:mine", "--start-up", "2", "--report", "page.html")
    shown = dfsm(*command, *options)
    assert (shown.code, shown.err) == (0, "")
    assert "wrote out (1 runs) and out/closed_loop.json" in shown.out
    said = json.loads(Path("out/closed_loop.json").read_text())
    written, recorded = read("out/d.parquet"), read("test/d.outb").window(2.0)
    assert written.names == ("q", "q_dot", "u", "y", "z")
    np.testing.assert_allclose(written.time, recorded.time, atol=1e-9)
    (run,) = said["runs"]
    assert run["closed_loop"]["u"]["std"] == pytest.approx(written["u"].std(), rel=1e-6)
    assert run["recorded"]["y"]["std"] == pytest.approx(recorded["y"].std(), rel=1e-6)
    ratio = written["y"].std() / recorded["y"].std()
    assert said["over_all"]["y"]["std_ratio"] == pytest.approx(ratio, rel=1e-6)
    assert run["replay"]["q"]["nrmse"] < 0.3
    assert "u" not in run["replay"]
    # Python's own modules keep their names, whatever the file is called.
    assert not hasattr(sys.modules.get("control"), "mine")
    assert Path("page.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    for text, sentence in (
        ("control.py", "--controller is 'control.py' without a name"),
        ("control.py:mien", "control.py holds no 'mien'; did you mean 'mine'?"),
        ("control.py:number", "'number' of control.py is no controller"),
        ("none.IN", "none.IN"),
    ):
        assert sentence in dfsm(*command, "--controller", text).sentence
    assert "--measure is 'q'" in dfsm(*command, *options[:2], "--measure", "q").sentence

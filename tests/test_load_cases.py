"""Load cases: shares of the year, seeds of one wind, meshes that are not equidistant."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dfsm as package
from conftest import write_config
from dfsm.config.loops import Weibull
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.loops.extremes import long_term_extremes
from dfsm.loops.load_cases import LoadCases, case_figures
from dfsm.loops.measures import Measure
from systems import driving_run, linear_model

A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0, 0.0], [2.0, 0.5]])
LAW = package.PID(
    kp=0.2, ki=0.1, setpoint=0.2, measurements=["q"], measurement_units=["m"],
    commands=["u0"], command_units=["N"], interval=0.1,
)  # fmt: skip


def driven(model, time, name="r"):
    inputs = np.stack([0 * time, 2 + np.sin(1.7 * time)], axis=1)
    return driving_run(model, time, inputs, np.tile([0.5, 0], (len(time), 1)), name)


@pytest.fixture(scope="module")
def plant():
    model = linear_model(A, B, np.array([[1.0, 0.0]]), names=["q", "v"])
    power = replace(model.signals.outputs[0], name="P", unit="MW")
    return replace(model, signals=replace(model.signals, outputs=(power,)))


def test_more_seeds_of_a_wind_tell_its_extreme_better():
    blocks = 50 * 8766 * 60.0
    exact = -math.log(-math.log1p(-1 / blocks))
    rng = np.random.default_rng(0)
    seeds = 40
    drawn = [{"M": rng.gumbel(0.0, 1.0, 9)} for _ in range(seeds)]
    shares = [1 / seeds] * seeds
    found = long_term_extremes(["M"], drawn, LoadCases.of(shares, ["calm"] * seeds), blocks)["M"]
    assert found.value == pytest.approx(exact, abs=2 * found.error)
    assert found.error < 1.0
    assert found.blocks == 9 * seeds
    # Two winds with two seeds each, in any order: half of the time belongs to each.
    cases = LoadCases.of([0.3, 0.2, 0.3, 0.2], [12, 6, 12, 6])
    assert cases.shares == pytest.approx([0.6, 0.4])
    assert [p.tolist() for p in cases.pooled([np.array([i]) for i in range(4)])] == [[0, 2], [1, 3]]
    with pytest.raises(DfsmError, match=r"conditions is \[6\], expected one per run, 2, as"):
        LoadCases.of([0.5, 0.5], [6])


def test_energy_and_extremes_need_shares_of_the_time(plant):
    runs = [driven(plant, np.arange(0, 20.01, 0.1), name) for name in ("a", "b")]
    loop = package.ClosedLoopSettings(start_up=2.0)
    for asked in ({"power": "P"}, {"extremes": ("q",), "block": 2.0}):
        settings = package.SweepSettings(loop=loop, **asked)
        with pytest.raises(DfsmError, match="weights add up to 100, expected shares of the time"):
            package.sweep(plant, runs, {"law": LAW}, weights=[30, 70], settings=settings)
    settings = package.SweepSettings(loop=loop)
    figures = [
        package.sweep(plant, runs, {"law": LAW}, weights=w, settings=settings).controllers[0]
        for w in ([30, 70], [0.3, 0.7])
    ]
    assert figures[0].figures["q"].mean == pytest.approx(figures[1].figures["q"].mean)


def test_means_are_over_time_whatever_the_samples(plant):
    even = np.arange(0, 100.001, 0.02)
    # A stretch is sampled ten times as often as the rest.
    uneven = np.unique(np.concatenate([even[::10], even[2500:3000]]))
    loop = package.ClosedLoopSettings(start_up=10.0)
    settings = package.SweepSettings(loop=loop, power="P")
    swept = [
        package.sweep(plant, [driven(plant, time)], {"law": LAW}, settings=settings)
        for time in (even, uneven)
    ]
    fine, coarse = (s.controllers[0] for s in swept)
    assert coarse.energy == pytest.approx(fine.energy, rel=3e-3)
    for name in ("q", "u0", "u1"):
        for part in ("mean", "std"):
            numbers = [getattr(s.figures[name], part) for s in (fine, coarse)]
            assert numbers[1] == pytest.approx(numbers[0], rel=0.03)
    values = np.exp(-uneven / 30)
    run = Trajectory(uneven, values[:, None], (Channel("y", "N"),), name="r", source="r.csv")
    told = case_figures(run)["y"]
    mean = 30 * (1 - math.exp(-100 / 30)) / 100
    assert told.mean == pytest.approx(mean, rel=1e-4)
    rng, e = np.random.default_rng(1), 1e-6
    for kind in ("mean", "std"):
        figure, slope = Measure(measure=kind, channel="y").along(uneven, values)
        assert figure == pytest.approx(getattr(told, kind))
        way = rng.normal(size=len(values))
        ends = [
            Measure(measure=kind, channel="y").along(uneven, values + s * e * way)[0]
            for s in (1, -1)
        ]
        assert slope @ way == pytest.approx((ends[0] - ends[1]) / (2 * e), rel=1e-6)


def test_the_record_is_scored_as_loops_would_have_been_that_ended_early(plant):
    time = np.arange(0, 20.01, 0.1)
    run = driven(plant, time)
    for start in (None, 6.0):
        settings = package.SweepSettings(loop=package.ClosedLoopSettings(start_up=4.0), start=start)
        lines = [
            package.sweep(plant, [run], {"law": law}, settings=settings).recorded.figures
            for law in (LAW, replace(LAW, kp=-80.0))
        ]
        assert lines[0] == lines[1]


def test_winds_of_weights_are_speeds_in_steps():
    time = np.arange(0, 10.0)

    def of(mean, unit):
        channel = Channel("RotWind", unit)
        return Trajectory(time, np.full((10, 1), mean), (channel,), name="r", source="runs/r.csv")

    runs = [of(8.47, "m/s"), of(9.52, "m/s"), of(9.48, ""), of(38.0, "km/h")]
    assert Weibull(mean=9.0, step=0.5).winds(runs) == [8.5, 9.5, 9.5, 10.5]
    assert Weibull(mean=9.0).winds([of(8.5, "m/s"), of(9.5, "m/s")]) == [9.0, 10.0]
    with pytest.raises(DfsmError, match="follow 'RotWind', which is in 'deg', expected a speed"):
        Weibull(mean=9.0).weights([of(8.0, "deg"), of(9.0, "deg")])


OWN = """
import dfsm
mine = dfsm.PID(
    kp=-0.5, ki=-0.1, setpoint=0.0, measurements=["q"], measurement_units=["m"],
    commands=["u"], command_units=["N"], interval=0.05,
)
"""


def test_the_file_of_a_sweep_tells_conditions_and_what_is_wrong_with_weights(here, dfsm, fitted):
    Path("control.py").write_text(OWN)
    config = {
        "model": str(fitted), "controller": "control.py:mine", "runs": ["test/*.outb"],
        "start_up": 2.0, "extremes": ["y"], "block": 2.0, "years": 1.0,
    }  # fmt: skip
    count = len(list(Path("test").glob("*.outb")))
    write_config(Path("sweep.yaml"), config | {"conditions": ["calm"] * count})
    pooled = json.loads(dfsm("sweep", "sweep.yaml", "-o", "out", "--json").out)
    write_config(Path("sweep.yaml"), config)
    apart = json.loads(dfsm("sweep", "sweep.yaml", "-o", "out", "--json").out)
    # By name, in any order.
    names = [run["name"] for run in apart["runs"]]
    shares = {name: 0.1 * (k + 1) for k, name in enumerate(names)}
    told = config | {"weights": dict(reversed(shares.items()))}
    write_config(Path("sweep.yaml"), told)
    named = json.loads(dfsm("sweep", "sweep.yaml", "-o", "out", "--json").out)
    assert {run["name"]: run["weight"] for run in named["runs"]} == shares
    one, other = (s["controllers"][0]["extremes"]["y"] for s in (pooled, apart))
    assert one["blocks"] == other["blocks"]
    assert one["value"] != other["value"] or count == 1
    for weights, sentence in (
        ({"mean": "9 m/s"}, "'weights.mean': input should be a valid number"),
        ({"shape": 2}, "key 'weights.mean' is missing"),
        ({"Mean": 9}, "weights: there is no run 'Mean'; known are: "),
        ({"d": 1, "dd": 2}, "weights: there is no run 'dd'; did you mean 'd'?"),
        ({}, "has none: add one, or leave the run out"),
        ({"mean": 9, "wnd": "q"}, "unknown key 'weights.wnd'; did you mean 'wind'?"),
        ("rayleigh", "'weights': a list was expected, as [a, b], not 'rayleigh'"),
    ):
        write_config(Path("bad.yaml"), config | {"weights": weights})
        assert sentence in dfsm("sweep", "bad.yaml", "-o", "out").sentence

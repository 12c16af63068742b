"""Tuning: slopes against differences, an optimum against brute force, the command, bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import fatpack
import jax.numpy as jnp
import numpy as np
import pytest

import dfsm as package
from conftest import write_config
from dfsm.errors import DfsmError
from dfsm.loops.measures import KINDS
from dfsm.loops.tuning import TuningTask
from dfsm.loops.tuning_folder import fingerprint
from dfsm.loops.tuning_problem import Goal, Limit
from dfsm.numerics.fatigue import damage_equivalent_load
from dfsm.numerics.fatigue_slope import damage_with_slope
from systems import driving_run, linear_model

A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0, 0.0], [2.0, 0.5]])
TIME = np.arange(0, 20.01, 0.1)
LAW = package.PID(
    kp=0.2, ki=0.1, setpoint=0.2, measurements=["q"], measurement_units=["m"],
    commands=["u0"], command_units=["N"], interval=0.1, limits=(-30.0, 30.0),
)  # fmt: skip
SETTINGS = package.TuneSettings(loop=package.ClosedLoopSettings(start_up=2.0))
GOALS = tuple(
    Goal(
        measure=kind,  # pyright: ignore[reportArgumentType]
        channel="y0" if kind == "damage" else "q",
        reference=0.3 if kind == "overshoot" else None,
    )
    for kind in KINDS
)
ASKED = package.TuningProblem(
    parameters={"kp": (-3.0, 3.0), "ki": (0.0, 1.0)}, objective=GOALS, weights=[0.7, 0.3]
)


def task(problem=ASKED, **changes):
    model = linear_model(A, B, np.array([[1.0, 0.3]]), names=["q", "v"])
    runs = []
    for i, size in enumerate((1.0, 3.0)):
        inputs = np.stack([0 * TIME, size * np.sin((1.7 + i) * TIME) + np.sin(5 * TIME)], axis=1)
        runs.append(driving_run(model, TIME, inputs, np.tile([0.5, 0], (len(TIME), 1)), f"r{i}"))
    return TuningTask(model, runs, LAW, problem, None, None, replace(SETTINGS, **changes))


@pytest.fixture(scope="module")
def asked():
    return task()


def test_damage_has_its_slope_at_fixed_cycles():
    rng = np.random.default_rng(0)
    load = np.convolve(rng.normal(size=900), np.ones(9) / 9, "same")
    peak = int(np.argmax(load))
    closed = np.concatenate([load[peak:], load[: peak + 1]])
    ranges = np.asarray(fatpack.find_rainflow_ranges(closed, k=2**20))
    # Counted in classes, to the last digit: ours is a faster form of the same.
    classes = np.asarray(fatpack.find_rainflow_ranges(closed, k=256))
    largest = classes.max()
    expected = largest * (np.sum((classes / largest) ** 4.0) / 90.0) ** 0.25
    assert damage_equivalent_load(load, 90.0, 4.0) == expected
    for m in (3.0, 10.0):
        value, slope = damage_with_slope(load, 90.0, m)
        assert value == pytest.approx((np.sum(ranges**m) / 90.0) ** (1 / m), rel=1e-5)
        way, e = rng.normal(size=900), 1e-7
        ends = [damage_with_slope(load + s * e * way, 90.0, m)[0] for s in (1, -1)]
        assert slope @ way == pytest.approx((ends[0] - ends[1]) / (2 * e), rel=1e-6)
    assert damage_with_slope(np.ones(9), 1.0, 4.0)[0] == 0.0


def test_every_measure_has_the_slope_that_differences_have(asked):
    at, e = np.array([0.5, 0.2]), 1e-6
    found = asked.evaluator(at, slopes=True)
    with package.errors.hushed():
        loops = package.closed_loop(
            asked.model, asked.runs, asked.tuned.at(at), settings=SETTINGS.loop
        )
    figures = {k: found.figures[KINDS.index(k)] for k in KINDS}
    for run, loop in enumerate(loops):
        assert figures["std"][run] == pytest.approx(loop.trajectory["q"].std(), rel=1e-12)
        assert figures["overshoot"][run] == pytest.approx(loop.trajectory["q"].max() / 0.3 - 1)
    search = asked.search(asked.evaluator(asked.tuned.start))
    judged = search.judged(found)
    for i, way in enumerate(np.eye(2) * e):
        ends = [asked.evaluator(at + s * way) for s in (1, -1)]
        numeric = (ends[0].figures - ends[1].figures) / (2 * e)
        np.testing.assert_allclose(found.slopes[:, :, i], numeric, atol=1e-7)
        costs = [search.judged(end).objective for end in ends]
        assert judged.slope[i] == pytest.approx((costs[0] - costs[1]) / (2 * e), rel=1e-6)


@pytest.mark.parametrize(
    ("interval", "sampling"), [(0.1, 0.1), (0.4, 0.1), (0.4, 0.05), (0.1, 0.4)]
)
def test_the_rate_of_a_command_is_from_one_to_the_next(interval, sampling):
    model, law = task().model, replace(LAW, interval=interval)
    time = np.arange(0, 20.001, sampling)
    inputs = np.stack([0 * time, np.sin(1.7 * time)], axis=1)
    run = driving_run(model, time, inputs, np.tile([0.5, 0], (len(time), 1)), "r")
    rate = Goal(measure="rate", channel="u0")
    problem = package.TuningProblem(parameters={"kp": (-3.0, 3.0)}, objective=(rate,))
    own = TuningTask(model, [run], law, problem, None, None, SETTINGS)
    at = own.tuned.start
    found = own.evaluator(at, slopes=True)
    u, every = own.evaluator.loops(at)[0].trajectory["u0"], max(1, round(interval / sampling))
    expected = np.abs(np.diff(u[::every])).max() / max(interval, sampling)
    assert found.figures.item() == pytest.approx(expected, rel=1e-6)
    ends = [own.evaluator(at + s).figures.item() for s in (1e-6, -1e-6)]
    assert found.slopes is not None
    assert found.slopes.item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5)


def test_the_optimum_is_that_of_a_grid_and_limits_hold(tmp_path):
    problem = replace(
        ASKED,
        objective=(
            Goal(measure="std", channel="q"),
            Goal(measure="std", channel="u0", weight=0.05),
        ),
        constraints=(Limit(measure="maximum", channel="q", at_most=0.75),),
    )
    own = task(problem, starts=2, pareto=3)
    journal = tmp_path / "whole.jsonl"
    journal.write_text("{}\n")
    own.evaluator.keep(journal)
    found = own.tune()
    lines = journal.read_text().splitlines(keepends=True)
    assert found.status is package.TuneStatus.SOLVED, found.summary()
    assert found.violation <= 1e-4
    search = own.search(own.evaluator(own.tuned.start))
    grid = [
        search.judged(own.evaluator(np.array([kp, ki])))
        for kp in np.linspace(-3, 3, 13)
        for ki in (0.0, 0.5)
    ]
    best = min((g for g in grid if g.violation <= 0), key=lambda g: g.objective)
    assert found.objective <= best.objective + 1e-6
    assert found.objective < found.before_objective or found.values == dict(found.before)
    first, second = np.array([p.measures for p in found.front]).T
    assert (np.diff(first[np.argsort(second)]) <= 1e-9).all()
    # Ended on the way, it goes on and ends where it would have.
    for share in (0.5, 0.9):
        part = tmp_path / f"{share}.jsonl"
        part.write_text("".join(lines[: int(share * len(lines))]))
        again = task(problem, starts=2, pareto=3)
        again.evaluator.keep(part)
        repeated = again.tune()
        assert (repeated.starts, repeated.front) == (found.starts, found.front)
        assert repeated.values == found.values
        assert repeated.evaluations == found.evaluations - int(share * len(lines)) + 1
    impossible = replace(problem, constraints=(Limit(measure="std", channel="q", at_most=1e-3),))
    lost = task(impossible, iterations=3).tune()
    assert lost.status is package.TuneStatus.INFEASIBLE
    assert "std of q is" in lost.message


def test_a_line_that_was_cut_off_costs_no_other(tmp_path):
    journal, points = tmp_path / "evaluations.jsonl", np.array([[0.1, 0.1], [0.2, 0.1], [0.3, 0.1]])
    journal.write_text("{}\n")
    for count, computed in ((2, 2), (3, 2), (3, 0)):
        evaluator = task().evaluator
        evaluator.keep(journal)
        for theta in points[:count]:
            evaluator(theta)
        assert evaluator.evaluations == computed
        if count == 2:
            journal.write_text(journal.read_text()[:-9])


def test_what_does_not_fit_is_told_in_one_sentence():
    for changes, sentence in (
        ({"parameters": {"kp": (1.0, 0.0)}}, r"bounds of kp is \(1.0, 0.0\)"),
        ({"parameters": {"kpp": (0.0, 1.0)}}, "no gain 'kpp'; did you mean 'kp'"),
        ({"objective": ()}, "objective is empty"),
        ({"weights": [1.0]}, "weights is .* expected one per run, 2"),
        (
            {"objective": (Goal(measure="std", channel="Q"),)},
            "the model has no channel 'Q'; did you mean 'q'",
        ),
    ):
        with pytest.raises(DfsmError, match=sentence):
            task(replace(ASKED, **changes))
    with pytest.raises(DfsmError, match="no measure 'stdd'; did you mean 'std'"):
        Goal(measure="stdd", channel="q")  # pyright: ignore[reportArgumentType]
    with pytest.raises(DfsmError, match="expected at_most or at_least"):
        Limit(measure="std", channel="q")
    unstable = replace(LAW, kp=-80.0, limits=(-np.inf, np.inf))
    one = task()
    with pytest.raises(DfsmError, match=r"gives no stable loop to compare with .*unstable"):
        TuningTask(one.model, one.runs, unstable, ASKED, None, None, SETTINGS).tune()


OWN = """
import dfsm
mine = dfsm.PID(
    kp=-0.5, ki=-0.1, setpoint=0.0, measurements=["q"], measurement_units=["m"],
    commands=["u"], command_units=["N"], interval=0.05,
)
"""


def test_the_command_tunes_and_goes_on_where_it_was_ended(here, dfsm, fitted):
    Path("control.py").write_text(OWN)
    config = {
        "model": str(fitted),
        "controller": "control.py:mine",
        "runs": "test/d.outb",
        "start_up": 2.0,
        "parameters": {"kp": [-3.0, 0.5]},
        "objective": [
            {"measure": "std", "channel": "q"},
            {"measure": "damage", "channel": "y", "weight": 0.2},
        ],
        "constraints": [{"measure": "rate", "channel": "u", "at_most": 40.0}],
    }
    write_config(Path("tune.yaml"), config)
    shown = dfsm("tune", "tune.yaml", "-o", "result")
    assert (shown.code, shown.err) == (0, ""), shown
    said = json.loads(Path("result/tuning.json").read_text())
    assert said["status"] == "solved"
    assert said["evaluations"] > 2
    after = said["parameters"]["kp"]["after"]
    assert json.loads(Path("result/gains.json").read_text())["kp"] == pytest.approx(after)
    assert Path("result/tuning.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    journal = Path("result/evaluations.jsonl")
    lines = journal.read_text().splitlines(keepends=True)
    # Ended in the middle of a line: the rest is computed again, and ends where it would have.
    journal.write_text("".join(lines[:3]) + lines[3][:20] + "\n")
    again = dfsm("tune", "tune.yaml", "-o", "result", "--json")
    repeated = json.loads(again.out)
    assert repeated["parameters"]["kp"]["after"] == after
    assert repeated["evaluations"] == said["evaluations"] - 2
    # Runs of the truth are asked for, and taken once they are there.
    write_config(Path("flown.yaml"), config | {"truth": {"folder": "flown", "flights": 2}})
    lacking = dfsm("tune", "flown.yaml", "-o", "result").sentence
    assert "flown/flight_1 lacks 1 of 1 runs (d): fly them" in lacking
    for number in (1, 2):
        Path(f"flown/flight_{number}").mkdir(parents=True, exist_ok=True)
        Path(f"flown/flight_{number}/d.outb").symlink_to(Path("test/d.outb").resolve())
    flown = json.loads(dfsm("tune", "flown.yaml", "-o", "result", "--json").out)
    # The same runs whatever is flown: no gain in truth.
    assert flown["best_flight"] == 1
    assert flown["flights"][1]["true"] == flown["flights"][0]["true"]
    Path("mine").mkdir()
    Path("mine/thesis.txt").write_text("x")
    assert "holds thesis.txt" in dfsm("tune", "tune.yaml", "-o", "mine").sentence
    for change, sentence in (
        ({"controler": 1}, "unknown key 'controler'; did you mean 'controller'?"),
        ({"parameters": {"kd": [0.0]}}, "parameters.kd"),
        ({"objective": [{"measure": "std", "channel": "q", "wait": 1}]}, "did you mean 'weight'"),
    ):
        write_config(Path("bad.yaml"), config | change)
        assert sentence in dfsm("tune", "bad.yaml", "-o", "other").sentence
    assert not Path("other").exists()


class Lagging(eqx.Module):
    """Proportional, with a lag and a table that only the code knows."""

    lag: float = eqx.field(static=True)
    table: tuple[float, ...] = eqx.field(static=True)
    kp: float = 0.2
    measurements = ("q",)
    measurement_units = ("m",)
    commands = ("u0",)
    command_units = ("N",)
    interval = 0.1

    def start(self, measurements, commands):
        return measurements

    def step(self, state, measurements, time):
        error = jnp.interp(state[0], np.array([-9.0, 0.0, 9.0]), np.array(self.table))
        return state + (measurements - state) * self.lag, -self.kp * jnp.stack([error])


def test_what_was_computed_is_taken_over_for_the_same_loop_only():
    one = task()

    def mark(law, name):
        asked = replace(ASKED, parameters={name: (-3.0, 3.0)})
        return fingerprint(TuningTask(one.model, one.runs, law, asked, None, None, SETTINGS))

    laws = [
        *(package.Sensor(LAW, delay=delay) for delay in (0.2, 0.5)),
        *(package.Sensor(LAW, noise=0.1, seed=seed) for seed in (1, 2)),
        package.Sensor(replace(LAW, measurement_units=("cm",))),
        package.Sensor(replace(LAW, kd=0.1, smoothing=1.0)),
        *(package.Sensor(Lagging(lag, (-9.0, 0.0, 9.0))) for lag in (0.5, 0.6)),
        package.Sensor(Lagging(0.5, (-9.0, 0.0, 8.0))),
    ]
    marks = [mark(law, "inner.kp") for law in laws]
    assert len(set(marks)) == len(laws)
    assert mark(package.Sensor(Lagging(0.5, (-9.0, 0.0, 9.0))), "inner.kp") == marks[6]
    assert fingerprint(one) == fingerprint(task())

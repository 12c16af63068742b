"""Closed loops: time of one, of many gains over many runs, and of a gradient.

The turbine of `benchmarks.tuning` is small; ROSCO in JAX on the rotor model of the IEA-15 floating
turbine is measured where its model folder and deck are named:

    DFSM_LOOP_MODEL=out/model_rotor DFSM_LOOP_DECK=DISCON.IN python -m benchmarks loops
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import dfsm
from benchmarks import tuning
from dfsm.errors import hushed
from dfsm.loops.tuning import TuningTask

RUNS, SETS = 12, 32
# What closed loops are to reach on two cores, with ROSCO in JAX on the turbine's model.
REACH = (
    ("one closed loop of 600 s at 0.05 s, warm, in s", "one_run_s", 0.05),
    (f"{RUNS} runs x {SETS} gain sets, in s", f"{RUNS}_runs_{SETS}_sets_s", 10.0),
    (f"gradient of a {RUNS}-run objective over its value", "gradient_over_value", 10.0),
)
ROSCO_PARAMETERS = {
    "omega_pc": (0.1, 0.35),
    "zeta_pc": (0.5, 2.0),
    "omega_vs": (0.08, 0.2),
    "Kp_float": (-14.0, -4.0),
    "SS_PCGain": (0.01, 0.2),
}
FLOATING = {"NcIMURAys": "PtfmPitch_dot_dot"}


def seconds(work: Callable[[], object], repeats: int = 3) -> float:
    """Least time of several; the first, which may compile, does not count."""
    work()
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begin)
    return float(best)


def in_turn(
    one: Callable[[], object], other: Callable[[], object], repeats: int = 3
) -> tuple[float, float, float]:
    """Least times of two, and the middle of how many times the other takes longer.

    They are measured by turns, so that a machine that is busy for a while is so for both.
    """
    one()
    other()
    pairs = []
    for _ in range(repeats):
        begin = time.perf_counter()
        one()
        middle = time.perf_counter()
        other()
        pairs.append((middle - begin, time.perf_counter() - middle))
    times = np.array(pairs)
    return *times.min(axis=0).tolist(), float(np.median(times[:, 1] / times[:, 0]))


def measured(asked: TuningTask) -> dict[str, float]:
    """Times in s, and the gradient's over the value's."""
    evaluator, start = asked.evaluator, asked.tuned.start
    evaluator.remember = False
    rng = np.random.default_rng(0)
    low, high = asked.problem.bounds
    near = start + 0.02 * (high - low) * rng.uniform(-1, 1, (SETS, len(low)))
    begin = time.process_time()
    one = of_600_s(replace_runs(asked, 1)).evaluator
    prepared = time.process_time() - begin
    one.remember = False
    run = one.runs[0]
    with hushed():
        rollout = seconds(lambda: dfsm.simulate(asked.model, run))
    alone = seconds(lambda: one(start), repeats=15)
    value, gradient, ratio = in_turn(
        lambda: evaluator(start), lambda: evaluator(start, slopes=True)
    )
    begin = time.perf_counter()
    for theta in near:
        evaluator(theta)
    sets = time.perf_counter() - begin
    return {
        "prepare_one_run_s": prepared,
        "one_run_s": alone,
        "one_rollout_s": rollout,
        "loop_over_rollout": alone / rollout,
        f"value_of_{RUNS}_runs_s": value,
        f"gradient_of_{RUNS}_runs_s": gradient,
        "gradient_over_value": ratio,
        f"{RUNS}_runs_{SETS}_sets_s": sets,
        "parameters": len(low),
    }


def replace_runs(asked: TuningTask, count: int) -> TuningTask:
    """The same over the first few runs."""
    return replace(asked, runs=asked.runs[:count], problem=replace(asked.problem, weights=None))


def of_600_s(asked: TuningTask) -> TuningTask:
    """The same over 600 s, the start-up included, where the runs are longer."""
    settings = asked.settings or dfsm.TuneSettings()
    first = min(run.time[-1] for run in asked.runs) - 600.0 + settings.loop.start_up
    start = settings.start
    return replace(
        asked, settings=replace(settings, start=max(first, first if start is None else start))
    )


def rosco_task(model: Path, deck: Path) -> TuningTask:
    """Five parameters of ROSCO over twelve runs of 600 s of the IEA-15 floating turbine."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "iea15"))
    from turbine_runs import DATA, START, with_rings

    names = [f"{wind}mps_s{seed:02d}" for wind in ("06", "12", "18") for seed in (1, 2, 9, 10)]
    paths = [next(DATA.glob(f"iea15_2dof_{n}.[op]*")) for n in names]
    with hushed():
        runs = with_rings(dfsm.read_all(paths))
    discon = dfsm.read_discon(deck)
    asked = dfsm.TuningProblem(
        parameters=ROSCO_PARAMETERS,
        objective=(
            dfsm.Goal(measure="damage", channel="TwrBsMyt"),
            dfsm.Goal(measure="std", channel="GenSpeed"),
        ),
        constraints=(dfsm.Limit(measure="rate", channel="BldPitch1", at_most=2.0),),
    )
    law = dfsm.read_rosco(discon, interval=0.05)
    settings = dfsm.TuneSettings(start=START)
    return TuningTask(dfsm.load(model), runs, law, asked, discon, FLOATING, settings)


def run() -> object:
    """Measure what is there."""
    small = tuning.task(duration=600.0, seeds=range(RUNS))
    figures: dict[str, object] = {"pi": measured(small)}
    model, deck = (os.environ.get(f"DFSM_LOOP_{name}") for name in ("MODEL", "DECK"))
    if model and deck:
        found = measured(rosco_task(Path(model), Path(deck)))
        figures["rosco"] = found
        figures["rosco, to be reached"] = {
            f"{what}: at most {most:g}": found[name] for what, name, most in REACH
        }
    return figures

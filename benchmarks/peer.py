"""A general identification package, jax-sysid, on the runs of docs/results/floating-turbine.md.

It pins an older JAX than dfsm needs, so it lives in an environment of its own, made on first use
with the Python that runs this (jax-sysid needs one before 3.13). The files that go there and back
lie beside it.
"""

from __future__ import annotations

import subprocess
import sys
import venv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

import dfsm
from benchmarks.accuracy import bundled
from benchmarks.rollouts import STATES, judged
from dfsm.core.types import Array

NAME = "jax-sysid, 6 states, 16 units (a general peer)"
SCRIPT = Path(__file__).with_name("jax_sysid_peer.py")
ENVIRONMENT = Path(__file__).parents[1] / "build" / "jax_sysid"
PYTHON = ENVIRONMENT / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
REQUIREMENT = "jax-sysid==1.1.0"
INPUTS = ("GenTq", "BldPitch1", "RotWind", "RotShearV", "RotShearH", "Wave1Elev")
OUTPUTS = ("PtfmPitch", "GenSpeed")
STEP = 0.5  # s
WARM_UP = 50.0  # s, recorded before the start of a rollout, which tells its state
# As for dfsm's rollouts: one diverged that is this many times its training half-range away.
FAR = 10.0


def run() -> dict[str, Any]:
    """Errors of the peer on the test runs, as `benchmarks.rollouts.run` has those of dfsm."""
    turbine = bundled()
    winds = turbine.ALL_WINDS
    both = [*turbine.runs(winds, range(1, 9)), *turbine.perturbed(testing=False)]
    # The split that dfsm's refinement makes.
    training, held = dfsm.Dataset(both).split(dfsm.HoldOut().share)
    groups = {
        "closed loop": turbine.runs(winds, range(9, 11)),
        "perturbed": turbine.perturbed(testing=True),
    }
    tests = [run for group in groups.values() for run in group]
    outputs, seconds = fit_and_predict(list(training), list(held), tests)
    seen = np.concatenate([run.window(turbine.START).select(OUTPUTS).values for run in training])
    rollouts = iter(states(run, values, seen) for run, values in zip(tests, outputs, strict=True))
    errors = {
        name: judged(group, [next(rollouts) for _ in group]) for name, group in groups.items()
    }
    return {"models": {NAME: {"fit_s": seconds, **errors}}, "chosen on": [r.name for r in held]}


def fit_and_predict(
    training: Sequence[dfsm.Trajectory],
    held: Sequence[dfsm.Trajectory],
    tests: Sequence[dfsm.Trajectory],
) -> tuple[Array, float]:
    """Outputs of the tests from the start on, (run, step, output), and seconds of fitting."""
    data = {"states": np.array([6])}
    for name, runs in (("training", training), ("held", held), ("test", tests)):
        pairs = [resampled(run) for run in runs]
        data[f"{name}_inputs"] = np.stack([u for u, _ in pairs])
        data[f"{name}_outputs"] = np.stack([y for _, y in pairs])
    # Nothing that a test measured after the start goes along.
    data["test_outputs"] = data["test_outputs"][:, : round(WARM_UP / STEP) + 1]
    install()
    return predicted(data)


def predicted(data: Mapping[str, Any]) -> tuple[Array, float]:
    """Outputs of the tests and seconds of fitting, from what `jax_sysid_peer` reads."""
    files = [ENVIRONMENT / name for name in ("inputs.npz", "predictions.npz")]
    np.savez(files[0], allow_pickle=False, **data)
    subprocess.run([PYTHON, "-I", SCRIPT, *files], check=True, stdout=sys.stderr)
    with np.load(files[1]) as back:
        return back["outputs"], float(back["fit_s"])


def install() -> None:
    """Make the environment if it is not there."""
    if not PYTHON.exists():
        venv.create(ENVIRONMENT, with_pip=True)
    # Standard output is for the figures.
    command = [PYTHON, "-m", "pip", "install", "--quiet", REQUIREMENT]
    subprocess.run(command, check=True, stdout=sys.stderr)


def resampled(run: dfsm.Trajectory) -> tuple[Array, Array]:
    """Inputs and the wave's rate, (step, input), averaged over each step; outputs at its begin."""
    run = run.window(bundled().START - WARM_UP)
    if run.time_step is None:
        raise ValueError("resampling needs an equidistant mesh")
    every = round(STEP / run.time_step)
    u = run.select(INPUTS).values
    u = np.column_stack([u, np.gradient(run["Wave1Elev"], run.time_step)])
    y = run.select(OUTPUTS).values[::every]
    u = np.pad(u, ((0, len(y) * every - len(u)), (0, 0)), mode="edge")
    return u.reshape(len(y), every, -1).mean(axis=1), y


def states(run: dfsm.Trajectory, outputs: Array, seen: Array) -> Array | None:
    """Outputs (step, output) at the run's times, NaN for other states; None if it diverged.

    `seen` are the training outputs, (sample, output).
    """
    low, high = seen.min(axis=0), seen.max(axis=0)
    if not (np.abs(outputs - (low + high) / 2) <= FAR * (high - low) / 2).all():
        return None
    time = run.window(bundled().START).time
    values = np.full((len(time), len(STATES)), np.nan)
    steps = time[0] + STEP * np.arange(len(outputs))
    values[:, [STATES.index(name) for name in OUTPUTS]] = CubicSpline(steps, outputs)(time)
    return values

"""A real floating turbine with the two kinds of states that nobody measures, side by side.

Latent states remember wind and waves and stand beside a fit of derivatives (`dfsm init` proposes
them for such runs); `hidden` fits all rows of a model with states of its own on rollouts, from an
estimate of where they start. Both are trained on seeds 1 to 8 at 6, 12 and 18 m/s and tested on
what neither saw: other seeds, perturbed controls, and winds between.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import dfsm
from benchmarks.accuracy import bundled
from benchmarks.rollouts import nrmse
from dfsm.config.fit import load_config
from dfsm.config.template import write_config

# Where tests begin, in s, which leaves `hidden` enough of the record to tell where its states are.
_START = 130.0
# Of the averages that `hidden` learns from, in s, and how many states it may add.
_STEP, _COUNT = 0.5, 4
_STATES = ("PtfmPitch", "PtfmRVyt", "GenSpeed")


def run() -> dict[str, Any]:
    """Errors of both on every group of tests, and seconds of their fits."""
    turbine = bundled()
    tests = {
        "seeds 9, 10": turbine.runs(turbine.ALL_WINDS, range(9, 11)),
        "perturbed": turbine.perturbed(testing=True),
        "8, 10, 14, 16 m/s": turbine.between(turbine.BETWEEN),
        "10, 14 m/s perturbed": turbine.between(turbine.BETWEEN_PERTURBED),
    }
    training = turbine.runs(turbine.ALL_WINDS, range(1, 9))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dfsm.DfsmWarning)
        begin = time.perf_counter()
        latent = _proposed(training)
        middle = time.perf_counter()
        hidden = _hidden([_averaged(run) for run in training])
        end = time.perf_counter()
        averages = {group: [_averaged(run) for run in runs] for group, runs in tests.items()}
        return {
            "latent states, as init proposes": {"fit_s": middle - begin, **_errors(latent, tests)},
            "hidden states": {"fit_s": end - middle, **_errors(hidden, averages)},
        }


def _proposed(training: list[dfsm.Trajectory]) -> dfsm.DFSM:
    """What `dfsm init` proposes for the runs, fitted."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "config.yaml"
        write_config([str(run.source) for run in training], path)
        config, runs = load_config(path)
    settings = config.fit_settings()
    return dfsm.fit(runs, replace(settings, start=bundled().START), config.refine).model


def _hidden(training: list[dfsm.Trajectory]) -> dfsm.DFSM:
    turbine = bundled()
    settings = dfsm.FitSettings(
        states=tuple(dfsm.StateSpec(name=name) for name in _STATES),
        controls=turbine.CONTROLS,
        disturbances=turbine.DISTURBANCES,
        features=(dfsm.Feature(source="Wave1Elev"),),
        hidden=dfsm.HiddenSettings(count=_COUNT),
    )
    return dfsm.fit(training, settings).model


def _averaged(run: dfsm.Trajectory) -> dfsm.Trajectory:
    """A run after its start-up, averaged over steps."""
    part = run.window(bundled().START, None)
    if part.time_step is None:
        raise ValueError("averages need an equidistant mesh")
    each = round(_STEP / part.time_step)
    count = len(part) // each
    values = part.values[: count * each].reshape(count, each, -1).mean(axis=1)
    time_ = part.time[: count * each].reshape(count, each).mean(axis=1)
    return replace(part, time=time_, values=values)


def _errors(model: dfsm.DFSM, tests: Mapping[str, list[dfsm.Trajectory]]) -> dict[str, Any]:
    """NRMSE by group and state, mean over its runs; None where a rollout ended early."""
    errors = {}
    for group, runs in tests.items():
        found = []
        for run in runs:
            rollout = dfsm.simulate(model, run, start=_START)
            if rollout.status is not dfsm.Status.COMPLETED:
                break
            path = rollout.trajectory
            truth = [np.interp(path.time, run.time, run[name]) for name in _STATES]
            pairs = zip(_STATES, truth, strict=True)
            found.append([nrmse(path[_own(path, name)], recorded) for name, recorded in pairs])
        whole = len(found) == len(runs)
        errors[group] = np.mean(found, axis=0).tolist() if whole else None
    return errors


def _own(path: dfsm.Trajectory, name: str) -> str:
    """What a model calls the rate of pitch."""
    return name if name in path else "PtfmPitch_dot"


def hidden_turbine_table(figures: Mapping[str, Any]) -> list[str]:
    """Pitch, pitch rate and speed by model and group of tests."""
    groups = [g for g in next(iter(figures.values())) if g != "fit_s"]
    lines = [f"| model | {' | '.join(groups)} | fit |", "|---|" + "---|" * (len(groups) + 1)]
    for name, result in figures.items():
        cells = [
            "–" if result[g] is None else ", ".join(f"{e:.2f}" for e in result[g]) for g in groups
        ]
        lines.append(f"| {name} | {' | '.join(cells)} | {result['fit_s']:.0f} s |")
    return lines

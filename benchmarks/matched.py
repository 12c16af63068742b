"""What controls do, learned and tested by runs with the same wind and waves and other controls.

Five of the turbine's training runs repeat wind and waves of others with perturbed controls, and so
do its three perturbed test runs. What a model does not see of the wind is the same in both runs of
such a pair, so that the difference between them shows what the controls did, and nothing else. The
refinement of `scheduled` is repeated with such runs taken as unrelated, and with errors that
correlate. Below rated wind, a model that is told what moves the rotor is measured beside it.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import dfsm
from benchmarks import scheduled
from benchmarks.accuracy import bundled
from benchmarks.rollouts import STATES, errors, low_passed, recorded
from dfsm.core.types import Array

CORRELATIONS = (0.0, 0.8)
SLOW = 0.15  # Hz, for derivatives of differences
STEP = 0.05  # s

Pair = tuple[dfsm.Trajectory, dfsm.Trajectory]


def run() -> dict[str, Any]:
    """Errors of rollouts and of differences, and what differences of records tell by themselves."""
    turbine, results, models = bundled(), {}, {}
    winds = turbine.ALL_WINDS
    closed = turbine.runs(winds, range(1, 9))
    training = [*closed, *turbine.perturbed(testing=False)]
    tests, perturbed = turbine.runs(winds, range(9, 11)), turbine.perturbed(testing=True)
    pairs = [(next(c for c in closed if p.name == f"{c.name}_ol"), p) for p in perturbed]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dfsm.DfsmWarning)
        for correlation in CORRELATIONS:
            refinement = replace(scheduled.REFINEMENT, correlation=correlation)
            model = dfsm.fit(training, scheduled.settings(), refinement).model
            results[str(correlation)] = judged(model, tests, pairs)
            if not correlation:
                models["all winds"] = model
        models["wind below rated"] = scheduled.below_rated().model
    tests = turbine.runs([scheduled.BELOW_RATED], range(9, 11))
    pair = next(pair for pair in pairs if f"_{scheduled.BELOW_RATED}mps" in pair[0].name)
    below = {name: judged(model, tests, [pair]) for name, model in models.items()}
    names = [p.name.removeprefix("iea15_2dof_").removesuffix("_ol") for p in perturbed]
    slopes = [speed_slopes(turbine, pair) for pair in pairs]
    return {"pairs": names, "models": results, "slopes": slopes, "below rated": below}


def judged(
    model: dfsm.DFSM, tests: Sequence[dfsm.Trajectory], pairs: Sequence[Pair]
) -> dict[str, Any]:
    """Errors on controlled runs, on the perturbed ones of pairs, and of the pairs' differences."""
    return {
        "closed loop": errors([model], tests),
        "perturbed": errors([model], [perturbed for _, perturbed in pairs]),
        "differences": [difference_errors(model, pair) for pair in pairs],
    }


def difference_errors(model: dfsm.DFSM, pair: Pair) -> list[float]:
    """NRMSE per state of the difference between two rollouts, below the cutoff of `rollouts`."""
    rollouts = [dfsm.simulate(model, r, start=bundled().START).trajectory for r in pair]
    predicted = _difference([r.select(STATES).values for r in rollouts])
    truth = _difference([recorded(r) for r in pair])
    return list(np.sqrt(np.mean((predicted - truth) ** 2, axis=0)) / truth.std(axis=0))


def _difference(values: Sequence[Array], cutoff: float = 0.5) -> Array:
    return low_passed(values[1] - values[0], STEP, cutoff)


def speed_slopes(turbine: Any, pair: Pair) -> dict[str, float]:
    """How the speed's derivative depends on states and controls, by least squares on differences.

    No wind enters, and no coefficient is known before. In rpm/s per rpm, deg, deg/s and kN m.
    """
    start = turbine.START
    states = _difference([recorded(r) for r in pair], SLOW)
    controls = _difference(
        [r.window(start).select(("BldPitch1", "GenTq")).values for r in pair], SLOW
    )
    speed = STATES.index("GenSpeed")
    slope = np.gradient(states[:, speed], STEP)
    names = ("GenSpeed", "PtfmPitch_dot", "BldPitch1", "GenTq")
    inputs = np.column_stack([states[:, speed], states[:, STATES.index("PtfmPitch_dot")], controls])
    coefficients = np.linalg.lstsq(inputs, slope, rcond=None)[0]
    return dict(zip(names, coefficients.tolist(), strict=True))

"""Where no run trained: what the rotor's table and the wind over rings add at other mean winds.

All models are trained on seeds 1 to 8 at 6, 12 and 18 m/s and five runs with perturbed controls,
and simulated for 600 s of seeds 9 and 10, of perturbed runs, and of runs at 8, 10, 14 and 16 m/s.
None of these had a part in any choice.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from typing import Any

import dfsm
from benchmarks.accuracy import demo, neighbour
from benchmarks.rollouts import STATES, errors, uncorrected


def run() -> dict[str, Any]:
    """Errors of every model on every group of tests."""
    turbine, rotor = demo(), neighbour("rotor_model")
    training = [*turbine.runs(rotor.WINDS, range(1, 9)), *turbine.perturbed(testing=False)]
    tests = {
        "seeds 9, 10": turbine.runs(rotor.WINDS, range(9, 11)),
        "perturbed": turbine.perturbed(testing=True),
        "8, 10, 14, 16 m/s": rotor.between(rotor.BETWEEN),
        "10, 14 m/s perturbed": rotor.between(rotor.BETWEEN_PERTURBED),
    }
    training = rotor.with_rings(training)
    tests = {label: rotor.with_rings(runs) for label, runs in tests.items()}
    plain = uncorrected(turbine)
    bare = {"corrective": dfsm.NoCorrection(), "outputs": ()}
    table = replace(rotor.settings(()), **bare)
    cubic = replace(rotor.settings(("U_cubic",)), **bare)
    rings = replace(rotor.settings(), **bare)
    results = {}
    for name, settings, refinement in (
        ("the demo's model", plain, turbine.REFINEMENT),
        ("the rotor's table instead of a schedule and a network", table, rotor.REFINEMENT),
        ("and the cubic mean of the wind", cubic, rotor.REFINEMENT),
        ("and the wind over six rings", rings, rotor.REFINEMENT),
    ):
        begin = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", dfsm.DfsmWarning)
            model = dfsm.fit(training, settings, refinement).model
            seconds = time.perf_counter() - begin
            judged = {label: errors([model], runs) for label, runs in tests.items()}
        results[name] = {"fit_s": seconds, **judged}
    return results


def unseen_table(figures: dict[str, Any]) -> list[str]:
    """Errors below the cutoff, pitch, rate and speed, by model and group of tests."""
    groups = [g for g in next(iter(figures.values())) if g != "fit_s"]
    lines = [f"| model | {' | '.join(groups)} |", "|---|" + "---|" * len(groups)]
    for name, result in figures.items():
        cells = [", ".join(f"{result[g]['filtered'][s]:.2f}" for s in STATES) for g in groups]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines

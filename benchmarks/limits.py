"""What limits the model of the floating turbine: data, size, knowledge.

The demo's model with fewer training runs, with networks of other sizes, and with a force that no
user has: the tower-base shear as recorded, given to it as if it were a disturbance. Everything else
is as in `rollouts`: refinement holds the same share of runs out, seeds 9 and 10 and three perturbed
runs have no part in any choice.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import dfsm
from benchmarks.accuracy import demo
from benchmarks.rollouts import errors

SEEDS = (2, 4, 6, 8)  # training seeds per wind speed
UNITS = (0, 8, 16, 32)  # of the network
GIVEN = "TwrBsFxt"


def run() -> dict[str, Any]:
    """Errors of the variants, and the torque coefficient that derivatives teach."""
    turbine = demo()
    winds = turbine.WINDS["all winds"]
    tests = turbine.runs(winds, range(9, 11)), turbine.perturbed(testing=True)
    found = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dfsm.DfsmWarning)
        for name, runs, choices, refinement in variants(turbine):
            start = dfsm.fit(runs, choices).model
            refined = dfsm.refine(start, runs, refinement, start=turbine.START)
            best = min(refined.history, key=lambda entry: entry["validation"])
            found[name] = {
                "runs": len(runs),
                "training": best["training"],
                "validation": refined.after,
                "closed loop": errors([refined.model], tests[0]),
                "perturbed": errors([refined.model], tests[1]),
            }
        return {"variants": found, "braking": braking(turbine)}


def variants(
    turbine: Any,
) -> Iterator[tuple[str, Sequence[dfsm.Trajectory], dfsm.FitSettings, dfsm.RefineSettings]]:
    """Name, training runs, and how to fit and refine."""
    winds, perturbed = turbine.WINDS["all winds"], turbine.perturbed(testing=False)
    full = replace(turbine.refined_settings(), corrective=dfsm.NoCorrection(), outputs=())
    refinement = turbine.REFINEMENT
    every = [*turbine.runs(winds, range(1, 9)), *perturbed]
    for seeds in SEEDS[:-1]:
        few = [*turbine.runs(winds, range(1, seeds + 1)), *perturbed]
        yield f"{seeds} seeds per wind speed", few, full, refinement
    for units in UNITS:
        shown = f"all runs, {units or 'no'} units"
        yield shown, every, full, replace(refinement, network=units)
    given = replace(full, disturbances=(*full.disturbances, GIVEN))
    yield f"all runs, {GIVEN} given", every, given, refinement


def braking(turbine: Any) -> dict[str, float]:
    """Effect of torque on the speed's derivative in rpm/s per kN m: true, and by least squares."""
    winds = turbine.WINDS["all winds"]
    closed, perturbed = turbine.runs(winds, range(1, 9)), turbine.perturbed(testing=False)
    full = replace(turbine.refined_settings(), corrective=dfsm.NoCorrection(), outputs=())
    learned = replace(full, linear=replace(full.linear, known={}, constant=("GenTq",)))
    found = {"one over the inertia": turbine.BRAKING["GenSpeed"]["GenTq"]}
    for name, runs in (("controlled runs", closed), ("and perturbed ones", [*closed, *perturbed])):
        model = dfsm.fit(runs, learned).model
        s = model.signals
        row = [c.name for c in s.states].index("GenSpeed")
        column = [c.name for c in s.inputs].index("GenTq")
        found[name] = float(model.f.coefficients[0, row, column])
    return found

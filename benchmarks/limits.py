"""What limits the model of the floating turbine: data, size, or what the three wind signals tell.

The model of `scheduled` with fewer training runs, with networks of other sizes, and with a force
that no user has: the rotor's recorded thrust, which it takes as if it were a disturbance. All else
is as in `rollouts`: refinement holds the same share of runs out, seeds 9 and 10 and three perturbed
runs have no part in any choice.

Then, for the run whose whole turbulence field is known, what the field has beside its average and
slopes over the disk, against what the model's derivatives leave over.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import dfsm
from benchmarks import scheduled
from benchmarks.accuracy import bundled
from benchmarks.rollouts import errors, low_passed, uncorrected
from dfsm.core.types import Array
from dfsm.refinement.record import record_of

SEEDS = (2, 4)  # training seeds per wind speed, instead of eight
UNITS = (0, 16, 32)  # of the network
THRUST = dfsm.Channel("RotThrust", "kN")
CUTOFF = 0.05  # Hz: what is left of the errors is slow
SHIFTS = 200
DATA = Path(__file__).parent / "data"

Runs = Sequence[dfsm.Trajectory]


def run() -> dict[str, Any]:
    """Errors of the variants, the torque coefficient by least squares, and the field's share."""
    turbine, results = bundled(), {}
    winds = turbine.ALL_WINDS
    tests = [
        with_thrust(r) for r in (turbine.runs(winds, range(9, 11)), turbine.perturbed(testing=True))
    ]
    field, same = None, _sized(scheduled.REFINEMENT.network)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dfsm.DfsmWarning)
        for name, runs, choices, refinement in variants(turbine):
            start = dfsm.fit(runs, choices).model
            refined = dfsm.refine(start, runs, refinement, start=turbine.START)
            # Before the runs held out were learnt from, too.
            checked = [entry for entry in refined.history if "validation" in entry]
            best = min(checked, key=lambda entry: entry["validation"])
            results[name] = {
                "runs": len(runs),
                "training": best["training"],
                "validation": best["validation"],
                "closed loop": errors([refined.model], tests[0]),
                "perturbed": errors([refined.model], tests[1]),
            }
            if name == same:
                field = field_shares(refined.model, runs)
        return {"variants": results, "field": field, "braking": braking(turbine)}


def variants(
    turbine: Any,
) -> Iterator[tuple[str, Runs, dfsm.FitSettings, dfsm.RefineSettings]]:
    """Name, training runs, and how to fit and refine."""
    winds, full, refinement = turbine.ALL_WINDS, uncorrected(), scheduled.REFINEMENT
    perturbed = turbine.perturbed(testing=False)
    every = [*turbine.runs(winds, range(1, 9)), *perturbed]
    for seeds in SEEDS:
        few = [*turbine.runs(winds, range(1, seeds + 1)), *perturbed]
        yield f"{seeds} seeds per wind speed", few, full, refinement
    for units in UNITS:
        yield _sized(units), every, full, replace(refinement, network=units)
    driven = replace(full, disturbances=(*full.disturbances, THRUST.name))
    yield "8 seeds, thrust given", with_thrust(every), driven, refinement


def _sized(units: int) -> str:
    return f"8 seeds, network of {units}" if units else "8 seeds, no network"


def with_thrust(runs: Runs) -> list[dfsm.Trajectory]:
    """Runs with the recorded thrust among their channels."""
    recorded = dfsm.read(DATA / "thrust.parquet")
    return [r if THRUST.name in r else r.with_channels([THRUST], recorded[r.name]) for r in runs]


def braking(turbine: Any) -> dict[str, list[float]]:
    """Torque's effect on the speed's derivative (rpm/s per kN m), smallest and largest over w."""
    full = uncorrected()
    runs = turbine.runs(turbine.ALL_WINDS, range(1, 9))
    free = replace(full.linear, known={})
    known = scheduled.BRAKING["GenSpeed"]["GenTq"]
    effects = {"one over the inertia": [known, known]}
    for name, linear in (
        ("LTI", dfsm.LTI()),
        ("LPV", free),
        ("LPV, torque's coefficient constant", replace(free, constant=("GenTq",))),
    ):
        model = dfsm.fit(runs, replace(full, linear=linear)).model
        s = model.signals
        row, column = ([c.name for c in g] for g in (s.states, s.inputs))
        values = model.f.coefficients[:, row.index("GenSpeed"), column.index("GenTq")]
        effects[name] = [float(values.max()), float(values.min())]
    return effects


def field_shares(model: dfsm.DFSM, runs: Runs) -> dict[str, Any]:
    """Share of what a model's derivatives leave over that linear regression explains, when slow.

    By the three wind signals that the model has, by those and the rest of the field, and by those
    and the rest of the field shifted in time, which has nothing to do with the run.
    """
    field = dfsm.read(DATA / "field.parquet")
    run = next(r for r in runs if r.name == field.name)
    record = record_of(model, run, 0.5, bundled().START, None)
    inputs, left = record.inputs[2 * record.before :: 2], record.left_over(model)
    time = bundled().START + record.step * np.arange(len(left))
    slow = lambda a: low_passed(a - a.mean(axis=0), record.step, CUTOFF)  # noqa: E731
    names = model.signals.exogenous
    three = slow(inputs[:, [names.index(n) for n in ("RotWind", "RotShearV", "RotShearH")]])
    rest = slow(field.resample(time).values)
    rng, shares = np.random.default_rng(0), {}
    shifts = rng.integers(len(rest) // 10, len(rest) * 9 // 10, SHIFTS)
    for row, name in ((1, "pitch acceleration"), (2, "speed's derivative")):
        y = slow(left[:, row])
        shifted = [_explained(y, np.hstack([three, np.roll(rest, s, axis=0)])) for s in shifts]
        shares[name] = {
            "three signals": _explained(y, three),
            "whole field": _explained(y, np.hstack([three, rest])),
            "shifted": np.quantile(shifted, [0.5, 0.95]).tolist(),
        }
    return shares


def _explained(y: Array, X: Array) -> float:
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    return float(1 - left @ left / (y @ y))

"""Prediction intervals from training runs alone: how often new runs lie inside, and how wide.

A model of the floating turbine trained at 6, 12 and 18 m/s and tested at winds between, a robot arm
and an oscillator whose test runs are pushed harder than any of training. `cross_calibrate` fits
without some of the training runs; nothing tested has a part in it. Beside it stand intervals of
constant width along the schedule, as of version 0.1, from the same rollouts over runs left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import dfsm
from benchmarks.accuracy import bundled, neighbour
from benchmarks.twins import TWINS
from dfsm.demos.two_link_robot.multi_fidelity import fit_settings
from dfsm.errors import hushed
from dfsm.numerics.hats import hat_weights
from dfsm.selection.left_out import left_out_errors
from dfsm.simulators.excitation import RandomKnots, Uniform
from dfsm.validation.calibrate import intervals_of
from dfsm.validation.growth import RolloutErrors

LEVEL = 0.9


@dataclass(frozen=True)
class Case:
    """A system with training runs and test runs by group."""

    training: Sequence[dfsm.Trajectory]
    settings: dfsm.FitSettings
    tests: Mapping[str, Sequence[dfsm.Trajectory]]


def run(*names: str) -> dict[str, Any]:
    """Coverage and mean width per test run and channel, of both kinds of intervals."""
    results = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dfsm.DfsmWarning)
        for name, case in cases():
            if not names or name in names:
                results[name] = judged(case)
    return results


def cases() -> Iterator[tuple[str, Case]]:
    """All systems by name."""
    yield "two-link robot", _robot()
    yield "duffing", _duffing()
    yield "turbine", _turbine()


def judged(case: Case) -> dict[str, Any]:
    """Fit, calibrate on runs left out, and look at the tests."""
    s = case.settings
    model = dfsm.fit(case.training, s).model
    left = left_out_errors(model, case.training, s)
    intervals = intervals_of(model, left.parts, left.runs, level=LEVEL, warnings=left.notes)
    constant = replace(intervals, growth=None, half_width=_constant(intervals.grid, left.parts))
    results: dict[str, Any] = {"notes": list(left.notes), "channels": list(intervals.channels)}
    for group, runs in case.tests.items():
        for test in runs:
            rollout = dfsm.simulate(model, test, start=s.start, stop=s.stop)
            if rollout.status is not dfsm.Status.COMPLETED:
                results[f"{group}: {test.name}"] = rollout.message
                continue
            compared = dfsm.validate(model, [test], start=s.start, stop=s.stop).runs[0].recorded
            told = {"distance": float(np.sqrt(np.mean(rollout.distance**2)))}
            for kind, found in (("growing", intervals), ("constant", constant)):
                low, high = found.around(rollout, test)
                told |= {
                    f"{kind}, inside": found.coverage(rollout, test, compared).tolist(),
                    f"{kind}, width": (high.values - low.values).mean(axis=0).tolist(),
                }
            results[f"{group}: {test.name}"] = told
    return results


def _constant(grid: np.ndarray, parts: Sequence[RolloutErrors]) -> np.ndarray:
    """Half-widths along the schedule that hold the errors of runs left out as they come."""
    parts = [p for p in parts if p.group.startswith("run ")]
    squares = np.concatenate([p.errors for p in parts]) ** 2
    at = np.concatenate([p.schedule for p in parts])
    hats = hat_weights(grid, at)
    mean = squares.mean(axis=0)
    scale = np.sqrt((hats.T @ squares + mean) / (hats.sum(axis=0) + 1)[:, None])
    expected = np.stack([np.interp(at, grid, s) for s in scale.T], axis=1)
    return np.quantile(np.sqrt(squares) / expected, LEVEL, axis=0) * scale


def _turbine() -> Case:
    turbine, rotor = bundled(), neighbour("rotor_model")
    training = [*turbine.runs(turbine.ALL_WINDS, range(1, 3)), *turbine.perturbed(testing=False)]
    base = rotor.settings((), drag=False)
    table = replace(base.terms[0], memory="speed", induction="steady", uncertainty=0.0)
    kept = {"corrected": None, "azimuth": None, "outputs": ("TwrBsMyt",)}
    bare = {"corrective": dfsm.NoCorrection(), **kept}
    return Case(
        training,
        replace(base, **bare, terms=(table,)),
        {
            "seen winds": turbine.runs(turbine.ALL_WINDS, range(9, 11)),
            "perturbed": turbine.perturbed(testing=True),
            "unseen winds": turbine.between(turbine.BETWEEN),
            "unseen winds, perturbed": turbine.between(turbine.BETWEEN_PERTURBED),
        },
    )


def _robot() -> Case:
    arm, time = dfsm.two_link_robot(), np.linspace(0.0, 1.0, 101)

    def runs(count: int, reach: float, seed: int) -> list[dfsm.Trajectory]:
        torques = RandomKnots(low=-reach, high=reach, spacing=0.1)
        return arm.campaign(count, time, Uniform(low=-reach, high=reach), torques, seed=seed)

    settings = fit_settings(arm, dfsm.RBF(samples=100))
    tests = {"as trained": runs(4, 0.6, 1), "pushed harder": runs(4, 0.9, 2)}
    return Case(runs(24, 0.6, 0), settings, tests)


def _duffing() -> Case:
    twin = TWINS["duffing"]
    harder = replace(twin, size=1.5 * twin.size)
    settings = dfsm.FitSettings(
        states=(dfsm.StateSpec(name="y", order=2),),
        controls=("u",),
        corrective=dfsm.RBF(samples=60),
        nonlinear_only=False,
    )
    training = [twin.record(1200, seed) for seed in range(6)]
    tests = {
        "as trained": [twin.record(1200, seed) for seed in (10, 11, 12)],
        "pushed harder": [harder.record(1200, seed) for seed in (20, 21, 22)],
    }
    return Case(training, settings, tests)


def intervals_table(figures: Mapping[str, Any]) -> list[str]:
    """One line per test run and channel: distance, share inside and mean width of both kinds."""
    lines = [
        "| system, run | channel | distance | inside | width | constant: inside | width |",
        "|---|---|---|---|---|---|---|",
    ]
    for system, results in figures.items():
        for run, told in results.items():
            if run in ("notes", "channels") or isinstance(told, str):
                continue
            for k, channel in enumerate(results["channels"]):
                cells = [f"{told['distance']:.2f}"]
                for kind in ("growing", "constant"):
                    cells.append(f"{100 * told[f'{kind}, inside'][k]:.0f} %")
                    cells.append(f"{told[f'{kind}, width'][k]:.3g}")
                lines.append(f"| {system}, {run} | {channel} | {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Print the table."""
    with hushed():
        print("\n".join(intervals_table(run())))


if __name__ == "__main__":
    main()

"""Where no run trained: what the rotor's table and the wind over rings add at other mean winds.

All models are trained on seeds 1 to 8 at 6, 12 and 18 m/s and five runs with perturbed controls,
and simulated for 600 s of seeds 9 and 10, of perturbed runs, and of runs at 8, 10, 14 and 16 m/s.
None of these had a part in any choice. An optimizer goes where no run has been, too: with each
model the power is maximised over a part of seed 9 at 6 m/s, with the paper's bounds and nothing
that keeps it inside the training data.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

import dfsm
from benchmarks import scheduled
from benchmarks.accuracy import bundled, neighbour
from benchmarks.rollouts import STATES, errors, uncorrected

# The optimum: run, its horizon in s and the nodes over it.
_WIND, _HORIZON, _NODES = "06", (100.0, 400.0), 301


def run() -> dict[str, Any]:
    """Errors of every model on every group of tests, and mean power of its optimum in MW."""
    turbine, rotor = bundled(), neighbour("rotor_model")
    training = [*turbine.runs(turbine.ALL_WINDS, range(1, 9)), *turbine.perturbed(testing=False)]
    tests = {
        "seeds 9, 10": turbine.runs(turbine.ALL_WINDS, range(9, 11)),
        "perturbed": turbine.perturbed(testing=True),
        "8, 10, 14, 16 m/s": turbine.between(turbine.BETWEEN),
        "10, 14 m/s perturbed": turbine.between(turbine.BETWEEN_PERTURBED),
    }
    training = turbine.with_rings(training)
    tests = {label: turbine.with_rings(runs) for label, runs in tests.items()}
    plain = uncorrected()
    bare = {"corrective": dfsm.NoCorrection(), "corrected": None, "outputs": ()}
    nowhere = {"overhang": None, "wind_rate": None, "platform_pitch": None}

    def with_rotor(settings: dfsm.FitSettings, **changes: Any) -> dfsm.FitSettings:
        of_rotor, *drag = settings.terms
        return replace(settings, **bare, terms=(replace(of_rotor, **changes), *drag))

    still = with_rotor(rotor.settings(ahead=(), drag=False), **nowhere)
    ahead = with_rotor(rotor.settings(drag=False), **nowhere)
    there = with_rotor(rotor.settings(drag=False))
    steady = {**nowhere, "induction": "steady", "uncertainty": 0.0}
    table = with_rotor(rotor.settings((), (), drag=False), memory="speed", **steady)
    rings = with_rotor(still, memory="speed", **steady)
    through_wind = with_rotor(still, **steady)
    factors = with_rotor(still, induction="steady")
    coming = {feature.name for feature in rotor.AHEAD}
    inputs = tuple(n for n in rotor.REFINEMENT.latent_inputs or () if n not in coming)
    by_wind = replace(rotor.REFINEMENT, latent_inputs=inputs)
    by_pitch = replace(scheduled.REFINEMENT, network=0)
    results = {}
    for name, settings, refinement in (
        ("a schedule and a network", plain, scheduled.REFINEMENT),
        ("the rotor's table instead of a schedule and a network", table, by_pitch),
        ("and the wind over six rings", rings, by_pitch),
        ("and latent states that change the wind at the rotor", through_wind, by_pitch),
        ("and smooth factors of the table", factors, by_pitch),
        ("and latent states of wind and waves alone", factors, by_wind),
        ("and induced velocities that lag", still, by_wind),
        ("and the waves some seconds ahead", ahead, rotor.REFINEMENT),
        ("and the wind where the rotor stands", there, rotor.REFINEMENT),
        ("and quadratic drag of the hull", with_rotor(rotor.settings()), rotor.REFINEMENT),
    ):
        begin = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", dfsm.DfsmWarning)
            model = dfsm.fit(training, settings, refinement).model
            seconds = time.perf_counter() - begin
            judged = {label: errors([model], runs) for label, runs in tests.items()}
            power = optimal_power(model, tests["seeds 9, 10"])
        results[name] = {"fit_s": seconds, **judged, "power": power}
    return results


def optimal_power(model: dfsm.DFSM, tests: Sequence[dfsm.Trajectory]) -> dict[str, float]:
    """Mean mechanical power in MW: of the optimum, as recorded, and what the table allows.

    The optimum may also take what the rotor turns with at the start: it is told apart, as the
    power that this would give over the horizon.
    """
    problem, turbine = neighbour("turbine_problem"), neighbour("rotor_model")
    (wind,) = (r for r in tests if f"_{_WIND}mps_s09" in r.name)
    names = {c.name for c in (*model.signals.states, *model.signals.controls)}
    bounds = {n: b for n, b in problem.PAPER.bounds.items() if n in names}
    bounds[problem.PITCH] = (problem.PAPER.lowest_pitch, 6.0)
    solution = dfsm.solve(
        dfsm.OptimalControlProblem(
            model=model,
            horizon=_HORIZON,
            cost=problem.PAPER.cost,
            bounds=bounds,
            disturbances=wind,
            name=wind.name,
        ),
        dfsm.DirectTranscription(scheme="trapezoidal", mesh=_NODES - 1, refine=None),
    )
    recorded, optimum = wind.window(*_HORIZON), solution.trajectory
    rotor = turbine.rotor()
    best = float(dfsm.read_rotor_table(rotor.table).cp.max())
    area = np.pi * rotor.radius**2
    cubed = problem.mean(recorded, recorded["U_cubic"] ** 3)
    speeds = optimum[problem.SPEED] * np.pi / 30
    stored = 0.5 * rotor.inertia * (speeds[0] ** 2 - speeds[-1] ** 2) / optimum.duration
    return {
        "optimum": problem.mean_power(optimum),
        "from the rotor's inertia": stored / 1e6,
        "recorded": problem.mean_power(recorded),
        "table": 0.5 * rotor.density * area * best * cubed / 1e6,
        "solved": float(solution.solved),
    }


def unseen_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors below the cutoff, pitch, rate and speed, by model and group of tests; and power."""
    first = next(iter(figures.values()))
    groups = [g for g in first if g not in ("fit_s", "power")]
    heads = [*groups, "optimum at 6 m/s, MW"]
    lines = [f"| model | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
    for name, result in figures.items():
        cells = [", ".join(f"{result[g]['filtered'][s]:.2f}" for s in STATES) for g in groups]
        power = result["power"]
        own = power["optimum"] - power["from the rotor's inertia"]
        cells.append(f"{own:.2f}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    power = first["power"]
    cells = ["" for _ in groups] + [f"{power['recorded']:.2f}, {power['table']:.2f}"]
    lines.append(f"| as recorded, and what the table allows | {' | '.join(cells)} |")
    return lines

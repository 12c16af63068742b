"""Optimization on surrogates where the true optimum is known: co-design, and the adaptive loop."""

from __future__ import annotations

from typing import Any

import adaptive_robot
import codesign

SEEDS = (0, 1, 2)


def run() -> dict[str, Any]:
    """Measure both, from several seeds.

    Returns
    -------
    dict
        ``codesign``: per seed mass and cost on the surrogate and in truth, and what the surrogate's
        mass costs; ``adaptive``: per seed the rounds, predicted and realised costs.
    """
    return {
        "codesign": {str(seed): codesign_figures(codesign.study(seed=seed)) for seed in SEEDS},
        "adaptive": {
            str(seed): adaptive_figures(adaptive_robot.study(seed=seed)) for seed in SEEDS
        },
    }


def codesign_figures(study: codesign.Codesign) -> dict[str, Any]:
    """What the table and its text need."""
    return {
        "runs": study.training_runs,
        "mass": study.surrogate.parameters["m2"],
        "true_mass": study.truth.parameters["m2"],
        "cost": study.surrogate.objective,
        "true_cost": study.truth.objective,
        "loss": study.loss,
        "miss": study.miss,
    }


def adaptive_figures(study: adaptive_robot.AdaptiveStudy) -> dict[str, Any]:
    """What the table and its text need."""
    result = study.result
    best = result.rounds[result.best]
    return {
        "status": result.status.name,
        "runs": study.training_runs,
        "simulations": result.simulations,
        "predicted": result.solution.objective,
        "realised": best.realised.cost,
        "price": best.realised.price,
        "miss": max(map(abs, best.realised.miss.values())),
        "true_cost": study.truth.objective,
        "differences": [r.difference for r in result.rounds],
    }

"""Rollout errors of the demo's models on the test seeds: what docs/results/accuracy.md states."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any


def demo() -> ModuleType:
    """The demo as a module."""
    return neighbour("demo")


def bundled() -> ModuleType:
    """The bundled runs of the turbine, and how to read them, as a module."""
    return neighbour("turbine_runs")


def neighbour(name: str) -> ModuleType:
    """A script of the turbine's examples as a module."""
    return importlib.import_module(name)


def run(*labels: str) -> dict[str, Any]:
    """Fit and validate as the demo does, all its models or those named.

    Returns
    -------
    dict
        Per fitted model and variant: rollouts completed, and mean NRMSE per channel (None where
        a rollout ended early).
    """
    return {
        label: {
            variant: {
                "completed": validation.completed(variant),
                "of": len(validation.runs),
                "nrmse": {
                    c.name: validation.mean_nrmse(variant, c.name) for c in validation.channels
                },
            }
            for variant in validation.models
        }
        for label, (_, validation) in demo().study(labels or tuple(demo().WINDS), jobs=1).items()
    }

"""Which corrective function for how many inputs: error and cost on chains of 2 to 16 masses.

A chain of n masses has 3 n inputs (forces, positions, velocities) and n accelerations to fit. Its
springs harden with the cube of their stretch: random forces within ± 2 N on each mass stretch them
by about 1 m, where the cubic part of the force is half the linear one, and leave the linear fit a
residual of about a third of the signal at every n. Every kind has the same 40 runs of 20 s and its
default settings; 10 more runs test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm
from benchmarks.speed import best
from dfsm.core.types import Array
from dfsm.fitting.corrective import CorrectiveSettings

MASSES = (2, 4, 8, 16)
LINEAR = "linear fit"
KINDS: dict[str, CorrectiveSettings] = {
    "rbf, equal": dfsm.RBF(directions="equal"),
    "rbf, per_input": dfsm.RBF(),
    "rbf_incremental": dfsm.IncrementalRBF(),
    "gp": dfsm.GP(),
    "mlp": dfsm.MLP(),
}
TRAIN, TEST = 40, 10
TIME = np.arange(401) * 0.05  # s


def run() -> dict[str, Any]:
    """Errors and costs per number of masses and kind."""
    # What the first fit of a process imports is no part of its training.
    chain(1, {"warm-up": dfsm.RBF(samples=20)})
    return {str(masses): chain(masses) for masses in MASSES}


def chain(masses: int, kinds: Mapping[str, CorrectiveSettings] = KINDS) -> dict[str, Any]:
    """Figures of the linear fit and of every kind for one chain."""
    system = dfsm.mass_chain(masses)
    runs = system.campaign(
        TRAIN + TEST,
        TIME,
        dfsm.Uniform(low=-0.5, high=0.5),
        dfsm.RandomKnots(low=-2.0, high=2.0, spacing=1.0),
    )
    train, test = runs[:TRAIN], runs[TRAIN:]
    truth = np.concatenate([system.derivative(r)[:, masses:] for r in test])
    results: dict[str, Any] = {}
    for name, kind in kinds.items():
        fitted = dfsm.fit(train, settings(masses, kind))
        model, linear = fitted.model, fitted.model.linear_fit()
        if LINEAR not in results:
            results[LINEAR] = {
                **errors(linear, test, truth),
                "corrected": 0,
                "training_s": fitted.seconds["linear fit"],
                "evaluation_ratio": 1.0,
            }
        results[name] = {
            **errors(model, test, truth),
            "corrected": len(model.corrected),
            "training_s": fitted.seconds["corrective functions"],
            # Where nothing holds on runs left out of training the fit corrects nothing.
            "evaluation_ratio": (
                _per_call(model, test[0]) / _per_call(linear, test[0]) if model.corrected else None
            ),
        }
    return {"inputs": 3 * masses, "samples": sum(map(len, train)), "results": results}


def settings(masses: int, kind: CorrectiveSettings) -> dfsm.FitSettings:
    """Positions and recorded velocities as states, one force per mass."""
    order = range(1, masses + 1)
    return dfsm.FitSettings(
        states=tuple(dfsm.StateSpec(name=f"q{i}", order=2, rate=f"v{i}") for i in order),
        controls=tuple(f"u{i}" for i in order),
        corrective=kind,
        nonlinear_only=False,
    )


def errors(model: dfsm.DFSM, test: Sequence[dfsm.Trajectory], truth: Array) -> dict[str, Any]:
    """Errors relative to the signal's standard deviation, mean over the masses.

    Of the accelerations along the recorded runs, against the true ones, and of the positions along
    rollouts, against the recorded ones (mean over the runs too; None where one ended early).
    """
    masses = truth.shape[1]
    slopes = np.concatenate([model.derivative(*_inputs(model, r)) for r in test])[:, masses:]
    rollouts = dfsm.simulate(model, test)
    done = sum(r.status is dfsm.Status.COMPLETED for r in rollouts)
    rollout = None
    if done == len(test):
        names = model.signals.names("states")[:masses]
        pairs = zip(rollouts, test, strict=True)
        each = [
            _relative(r.trajectory.select(names).values, t.select(names).values) for r, t in pairs
        ]
        rollout = float(np.mean(each))
    return {"derivative": _relative(slopes, truth), "rollout": rollout, "completed": done}


def _relative(predicted: Array, truth: Array) -> float:
    return float((np.sqrt(np.mean((predicted - truth) ** 2, axis=0)) / truth.std(axis=0)).mean())


def _inputs(model: dfsm.DFSM, run: dfsm.Trajectory) -> list[Array]:
    masses = len(model.signals.controls)
    states = [f"{what}{i}" for what in "qv" for i in range(1, masses + 1)]
    return [run.select(names).values for names in (states, model.signals.names("controls"), ())]


def _per_call(model: dfsm.DFSM, run: dfsm.Trajectory) -> float:
    """Seconds for one evaluation of f̂ after the other, as in a rollout; best of several loops."""
    x, u, w = (jnp.asarray(np.tile(part, (10, 1))) for part in _inputs(model, run))
    return best(lambda: jax.block_until_ready(_one_by_one(model, x, u, w)), 7) / len(x)


@eqx.filter_jit
def _one_by_one(model: dfsm.DFSM, x: jax.Array, u: jax.Array, w: jax.Array) -> jax.Array:
    model = model.prepared()

    def step(last: jax.Array, row: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        # No call begins before the one before it has ended.
        return model.derivative(row[0] + 1e-30 * last, row[1], row[2]), None

    return jax.lax.scan(step, jnp.zeros(x.shape[1]), (x, u, w))[0]

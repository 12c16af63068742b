"""Stable with the schedule frozen and unstable along its path, and what `fit` says of it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.linalg import expm

from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmWarning
from dfsm.fitting.contraction import Contraction, contraction
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV, LTI
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.simulation.simulate import simulate
from systems import OSCILLATOR, OSCILLATOR_A, Q, System, U, V, wander

# Mathieu's equation: a stiffness that swings with twice the natural frequency feeds the motion by
# 0.95 / 4 per second, more than the damping takes, 0.1, while every frozen stiffness is stable.
SWINGING = System(
    (Q, V),
    (U, Channel("w", "-")),
    (Channel("y", "m"),),
    f=lambda x, v: np.stack([x[1], -(1 + 0.95 * v[1]) * x[0] - 0.2 * x[1] + v[0]]),
    g=lambda x, v: x[:1],
)


def settings(**changes: object) -> FitSettings:
    choices = {
        "states": (StateSpec(name="q", order=2, rate="v"),),
        "controls": ("u",),
        "disturbances": ("w",),
        "linear": LTI(),
        "corrective": NoCorrection(),
        "nonlinear_only": False,
    }
    return FitSettings(**(choices | changes))  # pyright: ignore[reportArgumentType]


def swinging(rate: float, runs: int = 6, seconds: float = 40.0) -> list[Trajectory]:
    """Runs whose schedule is a cosine of so many rad/s."""
    found = []
    for k in range(runs):
        rng = np.random.default_rng(k)
        signals = [wander(rng, 0.0, 1.0), lambda t, k=k: np.cos(rate * t + k)]
        time = np.arange(0, seconds + 0.01, 0.05)
        found.append(SWINGING.run(signals, [0.0, 0.0], time, f"run{k}"))
    return found


def path_of(model: DFSM) -> str:
    checks = model.provenance.record["checks"]
    (line,) = [c for c in checks if c.startswith("two initial states of run")]
    return line


def test_a_model_that_a_moving_schedule_makes_unstable_is_told():
    with pytest.warns(DfsmWarning, match="stable with w frozen: as it moves, the model is not"):
        model = fit(swinging(2.0), settings(linear=LPV(schedule="w", points=7))).model
    assert all(values.real.max() < -0.05 for _, values in model.eigenvalues())
    assert " part" in path_of(model)
    assert any("two initial states of run" in text for text in model.provenance.record["warnings"])


def test_the_same_model_under_a_slow_schedule_is_not():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = fit(swinging(0.05), settings(linear=LPV(schedule="w", points=7))).model
    assert "come together to" in path_of(model)


def test_an_oscillator_comes_together_as_its_matrix_says():
    runs = OSCILLATOR.many(3, [(0.3, 1.0), (0.0, 1.0)], np.arange(0, 8.01, 0.05))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = fit(runs, settings()).model
    outcome = contraction(model, runs, simulate(model, runs), None, None)
    assert outcome is not None
    spread = np.asarray(model.region.std)[model.signals.observed_columns]
    expected = np.linalg.norm(expm(8.0 * OSCILLATOR_A) * spread / spread[:, None], 2)
    assert outcome.distance == pytest.approx(expected, rel=1e-3)
    assert outcome.frozen == pytest.approx(np.exp(-0.3 * 8.0), rel=1e-3)
    said = path_of(model).replace(" run0_1 ", " run0_0 ").replace(" run0_2 ", " run0_0 ")
    assert said == (
        f"two initial states of run run0_0 come together to {100 * outcome.distance:.3g} % "
        "of their distance within 8 s along the recorded inputs"
    )


def test_growth_that_eigenvalues_tell_of_is_not_told_twice():
    # Short against the slowest mode, or unstable with the schedule frozen.
    assert not Contraction("a", 1.0, 1.5, np.exp(-0.5)).unexpected
    assert not Contraction("a", 100.0, np.inf, np.exp(3.0)).unexpected
    assert Contraction("a", 100.0, 1.5, np.exp(-5.0)).unexpected
    assert "until one leaves the training range" in Contraction("a", 1.0, np.inf, 0.0).account
    assert "less than 0.01 %" in Contraction("a", 1.0, 1e-7, 0.0).account


def test_where_no_rollout_completes_nothing_is_said():
    runs = OSCILLATOR.many(2, [(0.3, 1.0), (0.0, 1.0)], np.arange(0, 8.01, 0.05))
    model = fit(runs, settings()).model
    assert contraction(model, [], [], None, None) is None

"""Properties of a whole fit that hold for any data: units, the order of runs, exact slopes."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmWarning
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from systems import DUFFING

KINDS = {
    "rbf": RBF(samples=30),
    "gp": GP(samples=30),
    "mlp": MLP(hidden=(8,), iterations=3, samples=400),
}
NAMES = ("q", "v", "u", "w", "y")
exponents = st.tuples(*[st.floats(-4, 4)] * len(NAMES))
# Every example is a fit: a failing one is told as it is.
few = settings(max_examples=3, deadline=None, phases=(Phase.generate,))
points = st.tuples(*[st.floats(-0.8, 0.8)] * 4)


@cache
def runs() -> tuple[Trajectory, ...]:
    time = np.arange(0, 10.01, 0.05)
    found = DUFFING.many(5, [(0.3, 1.0), (0.0, 1.0)], time, seed=11)
    return tuple(run.select(NAMES) for run in found)


def fitted(kind: str, data: tuple[Trajectory, ...]) -> DFSM:
    choices = FitSettings(
        states=(StateSpec(name="q"), StateSpec(name="v")),
        controls=("u",),
        disturbances=("w",),
        outputs=("y",),
        corrective=KINDS[kind],
        nonlinear_only=False,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        return fit(data, choices).model


unscaled = cache(lambda kind: fitted(kind, runs()))
alone = cache(lambda kind: fitted(kind, runs()[:1]))


def evaluate(model: DFSM, rows: np.ndarray) -> np.ndarray:
    """ξ̇ and y at rows of q, v, u, w."""
    x, u, w = rows[:, :2], rows[:, 2:3], rows[:, 3:]
    parts = [model.derivative(x, u, w), model.output(x, u, w)]
    return np.concatenate([np.asarray(p) for p in parts], axis=1)


@pytest.mark.parametrize("kind", KINDS)
@few
@given(exponents=exponents)
def test_units_change_predictions_by_rounding_only(kind, exponents):
    # One run: the order of several follows from their content, and with it folds and seeds.
    factors, run = 10.0 ** np.array(exponents), runs()[0]
    rows = run.values[::20, :4]
    expected = evaluate(alone(kind), rows) * factors[[0, 1, 4]]
    scaled = replace(run, values=run.values * factors)
    found = evaluate(fitted(kind, (scaled,)), rows * factors[:4])
    size = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / size, expected / size, atol=1e-6)


@few
@given(order=st.permutations(range(5)))
def test_any_order_of_the_runs_gives_the_same_model(order):
    other = fitted("rbf", tuple(runs()[k] for k in order))
    for a, b in zip(jax.tree.leaves(unscaled("rbf")), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=20, deadline=None)
@given(point=points)
def test_slopes_agree_with_central_differences_everywhere(kind, point):
    model, here, h = unscaled(kind), np.array(point), 1e-5
    A, B, C, D = model.jacobians(here[:2], here[2:3], here[3:])
    exact = np.concatenate([np.concatenate([A, C]), np.concatenate([B, D])], axis=1)
    steps = h * np.eye(4)
    slopes = (evaluate(model, here + steps) - evaluate(model, here - steps)).T / (2 * h)
    np.testing.assert_allclose(exact, slopes, rtol=1e-5, atol=1e-5 * np.abs(exact).max())

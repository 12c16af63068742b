"""Inputs that turn at nearly every sample: lines are fitted exactly, what is no line is told."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from dfsm.data.between import rough_ones, roughness
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings

SETTINGS = FitSettings(
    states=(StateSpec(name="x"),),
    controls=("u",),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def followed(u: np.ndarray, step: float, a: float = -1.0) -> np.ndarray:
    """Exact states of x' = a (x - u) under lines from sample to sample."""
    decay, x = np.exp(a * step), np.zeros(len(u))
    # x of a line u₀ + s t with the same start: u₀ + s t + s/a (1 - decay) + (x₀ - u₀) decay.
    for k in range(len(u) - 1):
        slope = (u[k + 1] - u[k]) / step
        x[k + 1] = u[k + 1] + slope / a * (1 - decay) + (x[k] - u[k]) * decay
    return x


def run_of(x: np.ndarray, u: np.ndarray) -> Trajectory:
    channels = (Channel("x"), Channel("u"))
    return Trajectory(np.arange(float(len(u))), np.stack([x, u], axis=1), channels, name="run")


def test_rough_lines_are_fitted_interval_by_interval():
    u = np.random.default_rng(0).normal(size=200)
    model = fit([run_of(followed(u, 1.0), u)], SETTINGS).model
    assert_allclose(model.f.coefficients[0, 0], [1, -1], rtol=0.01)
    assert "u turns at nearly every sample: taken for lines" in model.summary()
    assert model.provenance.record["verdicts"][0]["verdict"] == "usable"


def test_what_is_no_line_is_told_and_lowers_the_verdict():
    fine = np.random.default_rng(1).normal(size=1600)
    x = followed(fine, 1 / 8, a=-0.3)
    with pytest.warns(DfsmWarning, match=r"x_dot: 'u' turns at .* record it at a shorter step"):
        model = fit([run_of(x[::8], fine[::8])], SETTINGS).model
    entry = model.provenance.record["verdicts"][0]
    assert entry["doubt"]
    assert entry["verdict"] != "usable"
    assert "an input is too rough for its mesh (x_dot)" in entry["text"]


def test_what_is_smooth_is_not_rough():
    t = np.arange(0, 100, 0.5)
    smooth, rng = np.sin(t), np.random.default_rng(2)
    assert roughness(rng.normal(size=200)).rough
    for values in (smooth, smooth + 0.1 * rng.normal(size=200), np.cumsum(rng.normal(size=200))):
        assert not roughness(values).rough
    run = run_of(smooth, rng.normal(size=200))
    assert rough_ones([run], ("x", "u"), ("linear", "linear")) == ("u",)
    assert rough_ones([run], ("x", "u"), ("linear", "cubic")) == ()

"""What `fit` says of plants that are unstable without their controller."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from dfsm import Channel, DfsmWarning, FitSettings, StateSpec, Trajectory, fit
from dfsm.fitting.corrective import NoCorrection

A, B = np.array([[0.0, 1.0], [9.0, -0.2]]), np.array([[0.0], [2.0]])
STEP = 0.04
SETTINGS = FitSettings(
    states=(StateSpec(name="th", order=2, rate="om"),),
    controls=("u",),
    inputs="hold",
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def balanced(seed, push=0.0):
    """An inverted pendulum under a digital controller that is excited besides, and pushed."""
    rng, time = np.random.default_rng(seed), np.arange(600) * STEP
    wide = expm(np.block([[A, B], [np.zeros((1, 3))]]) * STEP)
    rates, phases = rng.uniform(0.5, 5, (8, 1)), rng.uniform(0, 6, (8, 1))
    wanted = 0.2 * np.sin(rates * time + phases).sum(axis=0)
    x, rows = np.array([0.1, 0.0]), []
    for k in range(len(time)):
        u = -15 * x[0] - 4 * x[1] + wanted[k]
        rows.append([*x, u])
        x = wide[:2, :2] @ x + wide[:2, 2] * (u + push * rng.standard_normal())
    channels = (Channel("th", "rad"), Channel("om", "rad/s"), Channel("u", "Nm"))
    return Trajectory(time, np.array(rows), channels, name=f"r{seed}")


def told(runs, settings):
    with pytest.warns(DfsmWarning) as caught:
        model = fit(runs, settings).model
    return model.provenance.record["verdicts"][0], [str(w.message) for w in caught]


def test_a_plant_that_is_fitted_exactly_and_unstable_is_to_be_tried_in_closed_loop():
    verdict, notes = told([balanced(k) for k in range(3)], SETTINGS)
    assert verdict["verdict"] == "not usable"
    assert "a plant that is unstable in open loop (it grows by 2.9 1/s)" in verdict["text"]
    assert (
        "try it in closed loop with a controller, or over windows of about 0.69 s"
        in (verdict["text"])
    )
    (note,) = [n for n in notes if n.startswith("the linear fit is unstable")]
    assert "linear.margin would spoil it" in note


def test_a_growth_that_the_residual_may_have_made_is_not_called_the_plants():
    verdict, notes = told([balanced(k, push=0.5) for k in range(3)], SETTINGS)
    assert "open loop" not in verdict["text"]
    assert not any("what the plant does" in note for note in notes)
    inputs = replace(SETTINGS, inputs="linear")
    assert "open loop" not in told([balanced(k) for k in range(3)], inputs)[0]["text"]


@pytest.mark.parametrize("recorded", [("u",), ("u", "wanted")])
def test_what_a_digital_controller_holds_is_told_however_smooth(recorded):
    rng, time = np.random.default_rng(4), np.arange(1500) * 0.1
    stable = np.array([[0.0, 1.0, 0.0], [-0.5, -0.2, 0.8], [0.0, 0.0, 0.0]])
    wide = expm(stable * 0.1)
    wanted = np.repeat(rng.uniform(0, 1, 15), 100)
    x, total, rows = np.zeros(2), 0.0, []
    for k in range(len(time)):
        total += 0.03 * (wanted[k] - x[0])
        u = 2 * (wanted[k] - x[0]) + total - 0.5 * x[1]
        rows.append([*x, u, wanted[k]])
        x = wide[:2, :2] @ x + wide[:2, 2] * u
    channels = tuple(Channel(n) for n in ("th", "om", "u", "wanted"))
    run = Trajectory(time, np.array(rows), channels)
    settings = replace(SETTINGS, inputs=None, disturbances=recorded[1:])
    verdict, notes = told([run], settings)
    assert any("set inputs: {u: hold}" in note for note in notes)
    assert verdict["verdict"] == "for trends only"
    model = fit([run], replace(settings, inputs={"u": "hold"})).model
    row = dict(zip(model.signals.order.names, model.f.coefficients[0, 1], strict=True))
    found = [float(row[n]) for n in ("u", "th", "th_dot")]
    assert found == pytest.approx([0.8, -0.5, -0.2], abs=1e-3)

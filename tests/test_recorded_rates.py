"""Recorded rates: which is whose, in which unit, and what is told where that is wrong."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from dfsm.config.proposal import propose
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings


def drive(seed: int) -> Trajectory:
    """Two inertias on a stiff shaft: J = 1 and 0.8, k = 60, c = 0.5."""
    rng = np.random.default_rng(seed)
    torque, h = np.repeat(rng.uniform(-5, 5, 40), 50), 0.002
    x, rows = np.zeros(4), []
    for u in torque:
        rows.append((*x, u))
        for _ in range(5):
            twist = 60 * (x[0] - x[2]) + 0.5 * (x[1] - x[3])
            x[1] += h * (u - twist)
            x[3] += h * twist / 0.8
            x[0] += h * x[1]
            x[2] += h * x[3]
    units = {"thM": "rad", "wM": "rad/s", "thL": "rad", "wL": "rad/s", "Tm": "Nm"}
    channels = tuple(Channel(name, unit) for name, unit in units.items())
    return Trajectory(0.01 * np.arange(len(rows)), np.array(rows), channels, name=f"run{seed}")


def oscillator(unit: str, rate_unit: str, scale: float, rate_scale: float) -> Trajectory:
    """θ'' = -4 θ - 0.4 θ' + 2 u in rad, recorded in other units; u is held."""
    u = np.repeat(np.random.default_rng(1).uniform(-1, 1, 30), 40)
    x, rows = np.array([0.3, 0.0]), []
    for v in u:
        rows.append((scale * x[0], rate_scale * x[1], v))
        for _ in range(50):
            x[1] += 0.001 * (-4 * x[0] - 0.4 * x[1] + 2 * v)
            x[0] += 0.001 * x[1]
    channels = (Channel("q", unit), Channel("v", rate_unit), Channel("u", "Nm"))
    return Trajectory(0.05 * np.arange(len(u)), np.array(rows), channels, name="run")


def settings(*states: StateSpec, control: str) -> FitSettings:
    return FitSettings(
        states=states, controls=(control,), corrective=NoCorrection(), nonlinear_only=False
    )


def test_each_rate_goes_to_its_own_angle() -> None:
    """Both speeds are much like the rate of both angles: the best match counts, one to one."""
    found = propose([drive(0), drive(1)], list(drive(0).names), [])
    assert found.states == [
        {"name": "thM", "order": 2, "rate": "wM"},
        {"name": "thL", "order": 2, "rate": "wL"},
    ]
    assert found.reasons["wL"] == "rate of thL"


@pytest.mark.parametrize(
    ("unit", "rate_unit", "scale", "rate_scale"),
    [
        ("m", "m/sec", 1, 1),
        ("m", "m s^-1", 1, 1),
        ("m", "m·s⁻¹", 1, 1),
        ("mm", "m/s", 1000, 1),
        ("deg", "rpm", 57.29577951308232, 9.549296585513721),
    ],
)
def test_a_rate_is_one_in_any_unit(
    unit: str, rate_unit: str, scale: float, rate_scale: float
) -> None:
    run = oscillator(unit, rate_unit, scale, rate_scale)
    found = propose([run], ["q", "v", "u"], [])
    assert found.states == [{"name": "q", "order": 2, "rate": "v"}]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        model = fit([run], settings(StateSpec(name="q", order=2, rate="v"), control="u")).model
    # Rows of q'' in the unit of q: on u, q and q'.
    row = np.asarray(model.f.coefficients)[0, 1]
    np.testing.assert_allclose(row, [2 * scale, -4, -0.4], rtol=0.01)


def test_a_rate_of_another_dimension_is_none() -> None:
    found = propose([oscillator("m", "kg/s", 1, 1)], ["q", "v", "u"], [])
    assert all("rate" not in state for state in found.states)


def test_the_rate_of_another_state_is_told() -> None:
    states = StateSpec(name="thM", order=2), StateSpec(name="thL", order=2, rate="wM")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        model = fit([drive(0)], settings(*states, control="Tm")).model
    match = "'wM' is named as the rate of 'thL', but is that of 'thM'"
    assert any(match in str(text.message) for text in told)
    verdicts = {v["name"]: v for v in model.provenance.record["verdicts"]}
    assert verdicts["thL"]["verdict"] != "usable"
    assert "the rate that is named with 'thL' is not its own" in verdicts["thL"]["text"]


def test_what_is_no_rate_is_told_and_a_true_one_is_not() -> None:
    run = oscillator("rad", "rad/s", 1, 1)
    twice = run.with_channels("w", 2 * run["v"])
    with pytest.warns(DfsmWarning, match="'w' is named as the rate of 'q', but is not its deriv"):
        fit([twice], settings(StateSpec(name="q", order=2, rate="w"), control="u"))
    noise = np.random.default_rng(0).standard_normal(len(run))
    noisy = run.with_channels("w", run["v"] + 0.05 * run["v"].std() * noise)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fit([noisy], settings(StateSpec(name="q", order=2, rate="w"), control="u"))
    assert not [text for text in told if "named as the rate" in str(text.message)]

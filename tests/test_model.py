"""Fitting systems whose f is known: what comes out, and what it says of itself."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import jax
import numpy as np
import pytest

import fits
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import fit
from dfsm.models.dfsm import DFSM
from dfsm.simulation.simulate import Status, simulate
from fits import LINEAR, SECOND, SMALL, TIME
from systems import (
    DUFFING,
    OSCILLATOR_A,
    OSCILLATOR_B,
    SPRING,
)


@pytest.fixture
def linear():
    return fits.linear()


@pytest.fixture
def duffing_runs():
    return fits.duffing_runs()


@pytest.fixture
def duffing():
    return fits.duffing()


@pytest.fixture
def scheduled():
    return fits.scheduled()


def decision(model: DFSM, name: str) -> dict:
    return next(r for r in model.provenance.record["rows"] if r["name"] == name)


# -- the fit finds what is known ----------------------------------------------------------------


def test_a_linear_system_is_recovered(linear):
    L = np.asarray(linear.model.f.coefficients)[0]
    np.testing.assert_allclose(L[:, :2], OSCILLATOR_B, atol=1e-5)
    np.testing.assert_allclose(L[:, 2:], OSCILLATOR_A, atol=1e-5)
    np.testing.assert_allclose(linear.model.f.offsets[0], 0, atol=1e-5)
    np.testing.assert_allclose(linear.model.g.coefficients[0], [[0.2, 0, 3, -1]], atol=1e-5)
    np.testing.assert_allclose(linear.model.g.offsets[0], [10], atol=1e-5)


def test_a_linear_system_gets_no_corrective_function(linear):
    assert linear.model.e is None
    assert linear.model.e_g is None
    assert linear.nonlinear is None
    for row in linear.model.provenance.record["rows"]:
        assert not row["corrected"]
        assert row["residual_rms"] < 1e-4 * row["std"]


def test_only_nonlinear_rows_are_corrected_and_kinematic_ones_are_exact(duffing):
    model = duffing.model
    assert [c.name for c in model.signals.states] == ["q", "q_dot"]
    assert [c.unit for c in model.signals.states] == ["m", "m/s"]
    assert model.corrected == (1,)
    assert model.corrected_outputs == (0,)
    np.testing.assert_array_equal(model.f.coefficients[0, 0], [0, 0, 0, 1])
    assert model.f.offsets[0, 0] == 0
    x = np.random.default_rng(0).normal(size=(20, 2))
    np.testing.assert_array_equal(model.derivative(x, [0.0], [0.0])[:, 0], x[:, 1])
    assert decision(model, "q_dot")["decision"].startswith("kinematic")
    assert decision(model, "q_ddot")["corrected"]
    assert decision(model, "q_ddot")["explained"] > 0.95
    assert decision(model, "y")["corrected"]
    assert not decision(model, "z")["corrected"]


def test_the_corrected_model_is_the_function_itself(duffing, duffing_runs):
    fresh = DUFFING.many(1, [(0, 2.5), (0, 2)], TIME, seed=77, spread=0.5)[0]
    x, v = fresh.select(["q", "v"]).values, fresh.select(["u", "w"]).values
    truth = DUFFING.f(x.T, v.T).T
    errors = []
    for model in (duffing.model.linear_fit(), duffing.model):
        found = np.asarray(model.derivative(x, v[:, :1], v[:, 1:]))
        errors.append(np.sqrt(np.mean((found - truth)[:, 1] ** 2)) / truth[:, 1].std())
    assert errors[0] > 0.3
    assert errors[1] < 0.03
    y = np.asarray(duffing.model.output(x, v[:, :1], v[:, 1:]))[:, 0]
    assert np.sqrt(np.mean((y - fresh["y"]) ** 2)) < 0.05 * fresh["y"].std()


def test_the_gate_decides_which_rows_are_corrected(duffing, duffing_runs):
    ratio = decision(duffing.model, "q_ddot")
    share = ratio["residual_rms"] / ratio["std"]
    choices = replace(LINEAR, states=SECOND, outputs=("y", "z"), corrective=SMALL)
    closed = fit(duffing_runs, replace(choices, gate=share * 1.01)).model
    assert closed.corrected == ()
    assert closed.e is None
    assert "gate" in decision(closed, "q_ddot")["decision"]
    off = fit(duffing_runs, replace(choices, corrective=NoCorrection())).model
    assert off.e is None
    assert off.e_g is None
    assert "switched off" in decision(off, "q_ddot")["decision"]
    some = fit(duffing_runs, replace(choices, corrected=("y",))).model
    assert some.corrected == ()
    assert some.corrected_outputs == (0,)
    assert "not among 'corrected'" in decision(some, "q_ddot")["decision"]
    with pytest.raises(DfsmError, match=r"corrected names 'q_dot_dott'.*q_ddot"):
        fit(duffing_runs, replace(choices, corrected=("q_dot_dott",)))


def test_lpv_interpolates_a_system_linear_in_its_schedule(scheduled):
    grid = np.asarray(scheduled.f.grid)
    for w in np.linspace(grid[0], grid[-1], 9):
        A = scheduled.jacobians([0.0, 0.0], [0.0], [w])[0]
        np.testing.assert_allclose(A[0], [0, 1], atol=1e-3)
        truth = [-(1 + 0.3 * w), -(0.5 + 0.05 * w)]
        np.testing.assert_allclose(A[1], truth, rtol=0.1, atol=0.1)
    assert scheduled.schedule == "w"
    assert "LPV in w, 5 points" in scheduled.summary()


@pytest.fixture(scope="module")
def spring() -> DFSM:
    runs = []
    for i, k in enumerate((2.0, 3.0, 4.0, 5.0, 6.0)):
        runs += SPRING.many(2, [(0, 3), (k, 0)], TIME, seed=10 + i)
    return fit(
        runs,
        replace(
            LINEAR, disturbances=(), parameters=("k",), corrective=RBF(samples=150, width=1.41)
        ),
    ).model


@pytest.mark.parametrize("k", [2.5, 4.5])
def test_a_parameter_generalises_to_a_value_between_those_trained_on(spring, k):
    (run,) = SPRING.many(1, [(0, 3), (k, 0)], TIME, seed=99)
    assert [c.name for c in spring.signals.inputs] == ["u", "q", "v", "k"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        result, plain = (simulate(m, run) for m in (spring, spring.linear_fit()))
    assert result.status is Status.COMPLETED
    error, without = (
        np.sqrt(np.mean((r.trajectory["q"] - run["q"]) ** 2)) / run["q"].std()
        for r in (result, plain)
    )
    assert error < 0.05
    assert error < without / 3


# -- summary, determinism -----------------------------------------------------------------------


def test_summary_tells_signals_decisions_and_stability(duffing, linear):
    text = duffing.model.summary()
    assert "states: q (m), q_dot (m/s)" in text
    assert "controls: u (N)" in text
    assert "q_dot (m/s): kinematic, its rate is a state" in text
    assert "q_ddot (m/s^2): corrected, residual" in text
    assert "z (m): linear fit, residual" in text
    assert "(80 points, length scales" in text
    assert "check: 6 of 6 training runs tried were simulated to their end" in text
    assert "UNSTABLE" not in text
    assert "eigenvalues (1/s): -0.3 ± 1.98i" in linear.model.summary()


def test_the_order_of_the_runs_does_not_change_a_bit(duffing, duffing_runs):
    choices = replace(LINEAR, states=SECOND, outputs=("y", "z"), corrective=SMALL)
    other = fit(duffing_runs[::-1], choices).model
    before, after = (jax.tree.leaves(m) for m in (duffing.model, other))
    assert len(before) == len(after) > 10
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)


def test_nonlinear_only_has_no_linear_part(duffing_runs):
    choices = replace(LINEAR, corrective=SMALL, nonlinear_only=True)
    result = fit(duffing_runs, choices)
    assert result.nonlinear is not None
    assert not np.asarray(result.nonlinear.f.coefficients).any()
    assert result.nonlinear.corrected == (0, 1)
    x = duffing_runs[0].select(["q", "v"]).values
    v = duffing_runs[0].select(["u", "w"]).values
    truth = DUFFING.f(x.T, v.T).T
    found = np.asarray(result.nonlinear.derivative(x, v[:, :1], v[:, 1:]))
    assert np.sqrt(np.mean((found - truth) ** 2, 0)).max() < 0.1 * truth.std(0).max()


def test_models_print_in_one_line(linear, duffing, scheduled):
    groups = "controls u (N); disturbances w (m/s)"
    assert repr(duffing.model) == (
        "<DFSM: LTI, 1 of 2 derivatives and 1 of 2 outputs corrected; states q (m), q_dot (m/s); "
        f"{groups}; outputs y (kN), z (m)>"
    )
    assert repr(scheduled).startswith("<DFSM: LPV in w, 0 of 2 derivatives and 0 of 1 outputs")
    assert re.fullmatch(
        rf"<FitResult after \d+\.\d s: {re.escape(repr(linear.model))}>", repr(linear)
    )
    kept = replace(linear, nonlinear=linear.model)
    assert repr(kept).endswith(">, and a nonlinear-only model>")
    # Where only the structure is left, as inside JAX, it prints too.
    assert repr(jax.tree.map(lambda _: None, scheduled)) == repr(scheduled)

"""Fitting systems whose f is known, and everything a model offers besides simulation."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import FitResult, fit
from dfsm.fitting.linear import LPV, LTI
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.models.signals import Azimuth, blade_harmonics
from dfsm.models.steady import steady_state
from dfsm.simulation.simulate import Status, simulate
from systems import (
    DUFFING,
    OSCILLATOR,
    OSCILLATOR_A,
    OSCILLATOR_B,
    SCHEDULED,
    SPRING,
    System,
    linear_model,
)

TIME = np.arange(0, 30.01, 0.05)
BOTH = (StateSpec(name="q"), StateSpec(name="v"))
SECOND = (StateSpec(name="q", order=2),)
LINEAR = FitSettings(
    states=BOTH,
    controls=("u",),
    disturbances=("w",),
    outputs=("y",),
    corrective=RBF(samples=40, width=0.5),
    nonlinear_only=False,
)
SMALL = GP(samples=80)


@pytest.fixture(scope="module")
def linear_runs():
    return OSCILLATOR.many(4, [(1, 2), (8, 3)], TIME)


@pytest.fixture(scope="module")
def linear(linear_runs) -> FitResult:
    return fit(linear_runs, LINEAR)


@pytest.fixture(scope="module")
def duffing_runs():
    return DUFFING.many(6, [(0, 3), (0, 2)], TIME, spread=0.8)


@pytest.fixture(scope="module")
def duffing(duffing_runs) -> FitResult:
    choices = replace(LINEAR, states=SECOND, outputs=("y", "z"), corrective=SMALL)
    return fit(duffing_runs, choices)


@pytest.fixture(scope="module")
def scheduled() -> DFSM:
    runs = SCHEDULED.many(8, [(0, 3), (10, 8)], TIME, seed=1)
    choices = replace(LINEAR, linear=LPV(schedule="w", points=5), corrective=NoCorrection())
    return fit(runs, choices).model


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


# -- evaluation ---------------------------------------------------------------------------------


def test_evaluation_broadcasts_over_leading_axes(duffing):
    model = duffing.model
    rng = np.random.default_rng(0)
    x, u, w = rng.normal(size=(4, 3, 2)), rng.normal(size=(3, 1)), np.array([0.5])
    many = model.derivative(x, u, w)
    outputs = model.output(x, u, w)
    assert many.shape == (4, 3, 2)
    assert outputs.shape == (4, 3, 2)
    for i in range(4):
        for j in range(3):
            one = model.derivative(x[i, j], u[j], w)
            np.testing.assert_allclose(many[i, j], one, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(outputs[i, j], model.output(x[i, j], u[j], w), atol=1e-9)


def test_join_and_split_are_inverse_and_in_the_documented_order(linear):
    model = linear.model
    inputs = model.join([1.0, 2.0], [3.0], [4.0])
    np.testing.assert_array_equal(inputs, [3, 4, 1, 2])
    assert [c.name for c in model.signals.inputs] == ["u", "w", "q", "v"]
    x, u, w, p = model.split(inputs)
    np.testing.assert_array_equal(model.join(x, u, w, p), inputs)


def test_groups_of_the_wrong_size_are_refused(linear):
    model = linear.model
    with pytest.raises(DfsmError, match=r"controls have shape \(2,\).* hold 1: u"):
        model.derivative([0, 0], [1, 2], [0])
    with pytest.raises(DfsmError, match=r"states have shape \(\).* hold 2: q, v"):
        model.derivative(0.0, [1], [0])
    with pytest.raises(DfsmError, match=r"parameters have shape \(1,\).* hold 0: none"):
        model.output([0, 0], [1], [0], [3])
    with pytest.raises(DfsmError, match=r"taken at one point, got shape \(5,\)"):
        model.jacobians(np.zeros((5, 2)), [1], [0])


def test_no_samples_give_no_values(linear):
    assert linear.model.derivative(np.zeros((0, 2)), [1.0], [0.0]).shape == (0, 2)
    assert linear.model.output(np.zeros((0, 2)), [1.0], [0.0]).shape == (0, 1)


def test_a_model_without_outputs():
    model = linear_model(OSCILLATOR_A, OSCILLATOR_B)
    assert model.output(np.zeros((3, 2)), [0.0, 0.0], []).shape == (3, 0)
    A, B, C, D = model.jacobians([0.0, 0.0], [0.0, 0.0], [])
    np.testing.assert_allclose(A, OSCILLATOR_A)
    np.testing.assert_allclose(B, OSCILLATOR_B)
    assert C.shape == (0, 2)
    assert D.shape == (0, 2)


def test_harmonics_average_to_zero_where_the_azimuth_is_not_given():
    model = linear_model(
        -np.eye(1), np.ones((1, 1)), np.array([[2.0]]), units=["rpm"], azimuth=Azimuth(speed="x0")
    )
    psi = 2 * np.pi * np.arange(36) / 36
    around = np.asarray(model.output(np.ones((36, 1)), [0.0], [], azimuth=psi))
    np.testing.assert_allclose(around[:, 0], 2 + np.cos(3 * psi), atol=1e-12)
    mean = model.output([1.0], [0.0], [])
    np.testing.assert_allclose(mean, around.mean(0), atol=1e-12)
    np.testing.assert_allclose(
        blade_harmonics(psi, 2), np.stack([np.cos(2 * psi), np.sin(2 * psi)], 1), atol=1e-12
    )


# -- linearization, equilibria ------------------------------------------------------------------


@pytest.mark.parametrize("which", ["duffing", "scheduled"])
def test_jacobians_agree_with_central_differences(which, duffing, scheduled):
    model = duffing.model if which == "duffing" else scheduled
    x, u, w = np.array([0.3, -0.4]), np.array([0.7]), np.array([9.3 if model is scheduled else 1.0])
    A, B, C, D = model.jacobians(x, u, w)
    h = 1e-5

    def central(function):
        columns = []
        for i in range(4):
            d = np.zeros(4)
            d[i] = h
            up = function(x + d[2:], u + d[:1], w + d[1:2])
            down = function(x - d[2:], u - d[:1], w - d[1:2])
            columns.append((np.asarray(up) - np.asarray(down)) / (2 * h))
        J = np.stack(columns, axis=1)
        return J[:, 2:], J[:, :2]

    for found, expected in zip(
        (A, B, C, D), (*central(model.derivative), *central(model.output)), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_linearize_names_its_signals(linear, duffing):
    system = linear.model.linearize([0.1, 0.2], [1.0], [8.0])
    assert system.state_labels == ["q", "v"]
    assert system.input_labels == ["u", "w"]
    assert system.output_labels == ["y"]
    np.testing.assert_allclose(system.A, OSCILLATOR_A, atol=1e-5)
    np.testing.assert_allclose(system.B, OSCILLATOR_B, atol=1e-5)
    np.testing.assert_allclose(system.C, [[3, -1]], atol=1e-5)
    np.testing.assert_allclose(system.D, [[0.2, 0]], atol=1e-5)
    bent = duffing.model.linearize([0.0, 0.0], [0.0], [0.0])
    # d/dq of -2 q - 3 q³ at 0 is -2; the linear fit averages over the whole swing.
    np.testing.assert_allclose(bent.A, [[0, 1], [-2, -0.8]], atol=0.4)
    assert duffing.model.linear_fit().linearize([0.0, 0.0], [0.0], [0.0]).A[1, 0] < -3


def test_eigenvalues_are_those_of_a_most_unstable_first():
    A = np.array([[0.5, 3.0], [0.0, -2.0]])
    ((point, values),) = linear_model(A, np.ones((2, 1))).eigenvalues()
    assert point == 0
    np.testing.assert_allclose(values, [0.5, -2.0])


def test_eigenvalues_per_schedule_point(scheduled):
    for w, values in scheduled.eigenvalues():
        truth = np.roots([1, 0.5 + 0.05 * w, 1 + 0.3 * w])
        np.testing.assert_allclose(
            np.sort_complex(values), np.sort_complex(truth), rtol=0.05, atol=0.05
        )


def test_steady_state_of_a_linear_system(linear):
    found = steady_state(linear.model, controls=[1.5], disturbances=[8.0])
    assert found.converged
    # 0 = -4 q + 2 * 1.5 + 0.5 * 8
    np.testing.assert_allclose(found.states, [1.75, 0], atol=1e-5)
    np.testing.assert_allclose(found.outputs, [3 * 1.75 + 0.3 + 10], atol=1e-4)
    np.testing.assert_allclose(
        np.sort_complex(found.eigenvalues), np.sort_complex(np.roots([1, 0.6, 4])), atol=1e-5
    )
    assert found.message == "steady state inside the training range"
    far = steady_state(linear.model, controls=[100.0], disturbances=[8.0])
    assert far.message == "steady state: outside the training range"


def test_steady_state_of_a_nonlinear_system(duffing):
    found = steady_state(duffing.model, controls=[0.9], disturbances=[0.0])
    assert found.converged
    q = next(r.real for r in np.roots([3, 0, 2, -1.8]) if abs(r.imag) < 1e-9)
    np.testing.assert_allclose(found.states, [q, 0], rtol=0, atol=0.02)
    np.testing.assert_allclose(
        np.sort_complex(found.eigenvalues),
        np.sort_complex(np.roots([1, 0.8, 2 + 9 * q**2])),
        atol=0.2,
    )


def test_steady_state_along_the_schedule(scheduled):
    found = steady_state(scheduled, schedule=10.0, controls=[1.0])
    assert found.converged
    np.testing.assert_allclose(found.states, [2 / 4, 0], atol=0.05)
    assert found.disturbances[0] == 10.0
    with pytest.raises(DfsmError, match="an LPV model needs a value of its schedule 'w'"):
        steady_state(scheduled)
    with pytest.raises(DfsmError, match="w = 40 is outside the training range"):
        steady_state(scheduled, schedule=40.0)


def test_no_steady_state_is_told():
    # ẋ0 = u is never zero while u is held at one.
    model = linear_model(np.array([[0.0, 0], [0, -1]]), np.array([[1.0], [0.0]]))
    found = steady_state(model, controls=[1.0])
    assert not found.converged
    assert "no steady state was found" in found.message


def test_an_unstable_steady_state_is_told():
    model = linear_model(np.array([[0.5]]), np.array([[1.0]]))
    found = steady_state(model, controls=[1.0])
    np.testing.assert_allclose(found.states, [-2.0])
    assert found.message == "steady state: unstable, growing at 0.5 1/s"


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


# -- bad input ----------------------------------------------------------------------------------


def changed(run: Trajectory, name: str, values) -> Trajectory:
    new = run.values.copy()
    new[:, run.column(name)] = values
    return replace(run, values=new)


def test_a_constant_control_is_refused(linear_runs):
    runs = [changed(r, "u", 2.5) for r in linear_runs]
    with pytest.raises(DfsmError, match=r"control 'u' is 2\.5 throughout all 4 runs"):
        fit(runs, LINEAR)
    # Different levels in different runs are information.
    runs = [changed(r, "u", float(i)) for i, r in enumerate(linear_runs)]
    assert fit(runs, replace(LINEAR, corrective=NoCorrection())).model.f.coefficients.shape[2] == 4


def test_nan_names_file_channel_and_time(linear_runs):
    values = linear_runs[2]["y"].copy()
    values[17] = np.nan
    runs = [*linear_runs[:2], changed(linear_runs[2], "y", values)]
    with pytest.raises(DfsmError, match=r"run0_2\.csv: channel 'y' has 1 NaN .* at 0\.85 s"):
        fit(runs, LINEAR)
    # In a channel that the fit does not read it does no harm.
    assert fit(runs, replace(LINEAR, outputs=(), corrective=NoCorrection())).model.g is None


def test_units_that_differ_are_refused(linear_runs):
    odd = replace(
        linear_runs[1],
        channels=tuple(
            replace(c, unit="ft/s") if c.name == "w" else c for c in linear_runs[1].channels
        ),
    )
    with pytest.raises(DfsmError, match=r"channel 'w' is in '(m/s|ft/s)' in .*csv but in '"):
        fit([linear_runs[0], odd], LINEAR)


def test_a_gap_in_the_window_is_warned_of(linear_runs):
    def cut(run):
        keep = (run.time < 10) | (run.time > 11.2)
        return replace(run, time=run.time[keep], values=run.values[keep])

    runs = [cut(linear_runs[0]), *linear_runs[1:]]
    choices = replace(LINEAR, corrective=NoCorrection())
    with pytest.warns(
        DfsmWarning, match=r"^runs/run0_0\.csv: there is a gap of 1\.25 s after 9\."
    ) as told:
        model = fit(runs, choices).model
    assert len(told) == 1
    assert "warning: runs/run0_0.csv: there is a gap" in model.summary()
    with pytest.warns(DfsmWarning, match=r"without it \(2 of the 4 runs have gaps\)$"):
        fit([cut(runs[1]), *runs[:1], *runs[2:]], choices)
    fit(runs, replace(choices, start=13.5))


def test_a_parameter_with_one_value_in_all_runs_is_warned_of():
    runs = SPRING.many(2, [(0, 3), (3.0, 0)], TIME, seed=10)
    choices = replace(
        LINEAR, disturbances=(), parameters=("k",), corrective=NoCorrection(), nonlinear_only=False
    )
    with pytest.warns(DfsmWarning, match="^input 'k' has the same value in all samples") as told:
        model = fit(runs, choices).model
    assert len(told) == 1
    np.testing.assert_array_equal(np.asarray(model.f.coefficients)[0, :, -1], 0)
    assert np.isfinite(model.provenance.record["condition"])


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (-0.3, "a correction explains nothing on data left out of its training"),
        (0.0004, "a correction explains nothing on data left out of its training"),
        (0.004, "a correction explains only 0.4% of its variance in cross-validation"),
    ],
)
def test_a_correction_that_is_not_worthwhile(duffing_runs, monkeypatch, share, text):
    def trained(inputs, residuals, *_):
        return SimpleNamespace(explained=np.full(residuals.shape[1], share), detail="")

    monkeypatch.setattr("dfsm.fitting.gate.fit_corrective", trained)
    choices = replace(LINEAR, states=SECOND, outputs=("y", "z"), nonlinear_only=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        model = fit(duffing_runs, choices).model
    assert model.e is model.e_g is None
    for name in ("q_ddot", "y"):
        assert decision(model, name)["decision"].endswith(text)


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


def test_a_channel_in_two_roles_is_refused(linear_runs):
    with pytest.raises(DfsmError, match="'u' is listed as control and as disturbance"):
        fit(linear_runs, replace(LINEAR, disturbances=("w", "u")))
    with pytest.raises(DfsmError, match="'q' is listed as state and as control"):
        fit(linear_runs, replace(LINEAR, controls=("q",)))
    with pytest.raises(DfsmError, match=r"'q' is a state, .* leave it out of outputs"):
        fit(linear_runs, replace(LINEAR, outputs=("y", "q")))


def test_an_input_may_also_be_an_output(linear_runs):
    model = fit(linear_runs, replace(LINEAR, outputs=("u",))).model
    assert model.g is not None
    np.testing.assert_allclose(model.g.coefficients[0], [[1, 0, 0, 0]], atol=1e-8)


def test_an_unknown_channel_names_the_file_and_near_ones(linear_runs):
    long = replace(
        linear_runs[0],
        channels=(Channel("PtfmPitch", "deg"), *linear_runs[0].channels[1:]),
    )
    with pytest.raises(DfsmError, match=r"run0_0\.csv: no channel 'PtfmPtich'; did you mean 'Ptfm"):
        fit([long], replace(LINEAR, states=(StateSpec(name="PtfmPtich"),)))


def test_bad_schedules_are_refused(linear_runs):
    with pytest.raises(DfsmError, match=r"linear\.schedule 'wind' is not an input .* u, w, q, v"):
        fit(linear_runs, replace(LINEAR, linear=LPV(schedule="wind")))


def test_a_window_longer_than_a_run_is_refused(linear_runs):
    with pytest.raises(DfsmError, match=r"run0_\d\.csv: runs from 0 s to 30 s, shorter than"):
        fit(linear_runs, replace(LINEAR, start=50.0))


def test_the_window_selects_the_samples(linear_runs):
    model = fit(linear_runs, replace(LINEAR, start=10.0, stop=20.0)).model
    inside = np.concatenate([r.window(10, 20)["u"] for r in linear_runs])
    np.testing.assert_allclose(model.region.mean[0], inside.mean(), rtol=1e-12)
    np.testing.assert_allclose([model.region.low[0], model.region.high[0]],
                               [inside.min(), inside.max()])  # fmt: skip


def test_fewer_samples_than_unknowns_is_refused(linear_runs):
    with pytest.raises(DfsmError, match="3 samples for 5 unknowns"):
        fit(linear_runs[:1], replace(LINEAR, start=1.0, stop=1.1))


def test_confounded_inputs_and_instability_are_warned_of(linear_runs):
    runs = [changed(r, "w", 2 * r["u"]) for r in linear_runs]
    with pytest.warns(DfsmWarning, match="cannot tell these inputs apart: (u, w|w, u)"):
        model = fit(runs, replace(LINEAR, corrective=NoCorrection())).model
    assert "warning: the runs cannot tell" in model.summary()
    falling = System(
        OSCILLATOR.states,
        OSCILLATOR.exogenous,
        OSCILLATOR.outputs,
        f=lambda x, v: np.stack([x[1], 0.09 * x[0] + v[0] + v[1]]),
        g=OSCILLATOR.g,
    )
    runs = falling.many(3, [(0, 0.1), (0, 0.1)], np.arange(0, 10, 0.02), spread=0.1)
    with pytest.warns(DfsmWarning, match=r"unstable at its only point \(fastest growth 0\.3 1/s\)"):
        assert "UNSTABLE" in fit(runs, replace(LINEAR, linear=LTI())).model.summary()

"""Inputs as they are between samples, samples on any mesh, and events: against exact answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from dfsm.data.between import is_held, parse_chosen, polynomials, resolved
from dfsm.data.derivatives import StateSpec
from dfsm.data.info import describe
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import load, save
from dfsm.numerics.time_mesh import same_instant, weights_over_time
from dfsm.refinement.record import record_of
from dfsm.simulation.simulate import SimulationSettings, simulate
from dfsm.validation.validate import validate

ONE = (StateSpec(name="x0"),)
LINEAR = FitSettings(states=ONE, controls=("u0",), corrective=NoCorrection(), nonlinear_only=False)
A, B = np.array([[0.0, 1.0], [-0.25, -0.2]]), np.array([[0.0, 0.0], [0.5, 0.3]])


def stepped(A: np.ndarray, B: np.ndarray, step: float, inputs: np.ndarray) -> np.ndarray:
    """Exact states from rest under held inputs, by the exponential of the augmented matrix."""
    n, m = B.shape
    whole = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * step)
    states = [np.zeros(n)]
    for u in inputs[:-1]:
        states.append(whole[:n, :n] @ states[-1] + whole[:n, n:] @ u)
    return np.array(states)


def run_of(time: np.ndarray, states: np.ndarray, inputs: np.ndarray, name: str = "run"):
    names = [f"x{i}" for i in range(states.shape[1])] + [f"u{i}" for i in range(inputs.shape[1])]
    values = np.hstack([states, inputs])
    return Trajectory(time, values, tuple(Channel(n) for n in names), name=name)


def levels(count: int, every: int, seed: int) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, -(-count // every)), every)[:count]


def coefficients(result) -> np.ndarray:
    return np.asarray(result.model.f.coefficients)[0]


def test_held_inputs_are_recognised_fitted_and_simulated_exactly(tmp_path):
    u = levels(300, 4, 1)[:, None]
    a = np.array([[-0.357]])
    run = run_of(np.arange(300.0), stepped(a, -a, 1.0, u), u)
    result = fit([run], LINEAR)
    np.testing.assert_allclose(coefficients(result), [[0.357, -0.357]], atol=2e-4)
    assert "u0 stays and jumps: held between samples" in result.model.summary()
    lines = coefficients(fit([run], replace(LINEAR, inputs="linear")))
    assert abs(lines[0, 1] + 0.357) > 0.05  # what the record says where it is joined by lines
    save(result.model, tmp_path / "m")
    model = load(tmp_path / "m")
    assert model.signals.between == ("hold",)
    followed = simulate(model, run)
    np.testing.assert_allclose(followed.trajectory["x0"], run["x0"], atol=2e-3)
    adaptive = simulate(model, run, settings=SimulationSettings(method="tsit5"))
    np.testing.assert_allclose(adaptive.trajectory["x0"], run["x0"], atol=2e-3)
    assert validate(model, [run]).runs[0].models["multi-fidelity"].derivative_errors["x0"] < 1e-3
    # Refinement at steps that end elsewhere: neither input nor state is averaged over a jump.
    record = record_of(model, run, 0.4, None, None)
    h = np.arange(len(record.states)) * 0.4
    whole = np.array([np.exp(-0.357 * (t - np.floor(t))) for t in h])
    k = np.floor(h + 1e-9).astype(int)
    exact = run["x0"][k] * whole + u[k, 0] * (1 - whole)
    np.testing.assert_allclose(record.states[:, 0], exact, atol=1e-3)


def test_a_smooth_command_that_is_updated_at_regular_moments_is_held():
    time = np.arange(600.0)
    command = np.sin(0.015 * time) + 0.6 * np.cos(0.034 * time)
    u = np.repeat(command[::4], 4)[:, None]
    a = np.array([[-0.05]])
    states = stepped(a, np.array([[0.1]]), 1.0, u)
    result = fit([run_of(time, states, u)], LINEAR)
    assert result.model.signals.between == ("hold",)
    np.testing.assert_allclose(coefficients(result), [[0.1, -0.05]], atol=1e-5)
    # As two rates are merged into one table, with the choice that the fit asks for.
    gaps = np.where(time[:, None] % 4 == 0, u, np.nan)
    merged = fit([run_of(time, states, gaps)], replace(LINEAR, slower="hold"))
    assert merged.model.signals.between == ("hold",)
    # A slow ramp that is rounded moves at regular moments, too, by one step of its rounding.
    assert not is_held(np.round(0.25 * time))


def test_a_state_of_order_2_under_a_held_and_a_smooth_input():
    fine, steps = 50, 400
    time = np.arange(steps) * 0.5
    held = levels(steps, 1, 3)
    inner = np.arange(steps * fine) * 0.5 / fine
    smooth = np.sin(0.37 * inner) + np.cos(0.11 * inner)
    # Held over a fiftieth of a step, in its middle: as good as smooth.
    middle = np.append((smooth[1:] + smooth[:-1]) / 2, smooth[-1])
    states = stepped(A, B, 0.5 / fine, np.stack([np.repeat(held, fine), middle], axis=1))[::fine]
    run = run_of(time, states[:, :1], np.stack([held, smooth[::fine]], axis=1))
    choices = replace(LINEAR, states=(StateSpec(name="x0", order=2),), controls=("u0", "u1"))
    result = fit([run], replace(choices, inputs={"u0": "hold", "u1": "cubic"}))
    np.testing.assert_allclose(coefficients(result)[1], [0.5, 0.3, -0.25, -0.2], atol=2e-3)


# Its state is no answer to its input.
@pytest.mark.filterwarnings("ignore:derivatives are not to be fitted here:dfsm.errors.DfsmWarning")
def test_samples_weigh_by_the_time_that_they_stand_for():
    rng = np.random.default_rng(0)
    time = np.concatenate([np.linspace(0, 0.1, 60)[:-1], np.arange(0.1, 60, 0.2)])
    u, x = np.sin(0.5 * time), np.cos(0.31 * time) + 0.3 * np.sin(time)
    # A derivative that no linear fit has: the first tenth of a second must not decide.
    y = 2 * u - x + 0.5 * np.exp(-time)
    run = run_of(time, x[:, None], np.stack([u, y], axis=1))
    model = fit([run], replace(LINEAR, outputs=("u1",))).model
    w = np.gradient(time)
    w = np.diff(time, prepend=time[0]) / 2 + np.diff(time, append=time[-1]) / 2
    X = np.stack([u, x, np.ones_like(u)], axis=1)
    expected = np.linalg.solve((X.T * w) @ X, (X.T * w) @ y)
    got = [*np.asarray(model.g.coefficients)[0, 0], np.asarray(model.g.offsets)[0, 0]]
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    info = describe(run)
    assert info.channels[2].mean == pytest.approx(np.average(y, weights=w))
    assert not info.warnings
    even = np.arange(0, 10, 0.1) + 0 * rng.normal(size=100)
    assert weights_over_time([even, even + 3]) is None


@pytest.mark.parametrize("apart", [2e-10, 0.0])
def test_an_event_is_one_instant_at_which_inputs_jump(apart):
    inputs = levels(400, 20, 5)[:, None]
    states = stepped(np.array([[-0.7]]), np.array([[1.0]]), 0.05, inputs)
    grid, jump = np.arange(400) * 0.05, np.arange(20, 400, 20)
    time = np.insert(grid, jump + 1, grid[jump] + apart)
    x = np.insert(states[:, 0], jump + 1, states[jump, 0])
    before = inputs[:, 0].copy()
    before[jump] = inputs[jump - 1, 0]
    u = np.insert(before, jump + 1, inputs[jump, 0])
    run = run_of(time, x[:, None], u[:, None])
    assert same_instant(run.time).sum() == len(jump)
    for chosen in (None, "linear")[: 1 + (apart > 0)]:
        result = fit([run], replace(LINEAR, inputs=chosen))
        np.testing.assert_allclose(coefficients(result), [[1.0, -0.7]], atol=2e-3)
        for method in ("rk4", "tsit5"):
            followed = simulate(result.model, run, settings=SimulationSettings(method=method))
            np.testing.assert_allclose(followed.trajectory["x0"], x, atol=1e-3)
    torn = run.values.copy()
    torn[jump[0] + 1, 0] += 0.5
    with pytest.raises(DfsmError, match=r"'x0' goes from .* in no time, at 1 s"):
        fit([replace(run, values=torn)], LINEAR)


def test_a_free_decay_has_no_inputs():
    time = np.arange(0, 60, 0.2)
    run = run_of(
        time, np.array([expm(A * t)[0] @ [5.0, 0.0] for t in time])[:, None], time[:, None][:, :0]
    )
    choices = replace(LINEAR, states=(StateSpec(name="x0", order=2),), controls=())
    result = fit([run], choices)
    np.testing.assert_allclose(coefficients(result)[1], [-0.25, -0.2], atol=1e-5)
    for method in ("rk4", "tsit5"):
        alone = simulate(
            result.model, run, initial=[5.0, 0.0], settings=SimulationSettings(method=method)
        )
        np.testing.assert_allclose(alone.trajectory["x0"], run["x0"], atol=1e-3)
    assert validate(result.model, [run]).mean_nrmse("multi-fidelity", "x0") < 1e-3


def test_a_state_may_rest_in_some_runs_but_not_in_all():
    time = np.arange(0, 20, 0.1)
    u = np.where(time < 8, 0.0, 1.0)[:, None]
    moving = run_of(time, stepped(A, B[:, :1], 0.1, u)[:, :1], u)
    resting = run_of(time, np.zeros((len(time), 1)), 0 * u, name="rest")
    choices = replace(LINEAR, states=(StateSpec(name="x0", order=2),))
    result = fit([moving, resting], choices)
    np.testing.assert_allclose(coefficients(result)[1], [0.5, -0.25, -0.2], atol=5e-3)
    assert simulate(result.model, moving).trajectory["x0"][0] == 0
    with pytest.raises(DfsmError, match="state 'x0' is constant in all training samples"):
        fit([resting, replace(resting, values=resting.values + time[:, None] * [0, 1])], choices)


def test_what_stays_and_jumps_is_held_and_what_is_chosen_is_checked():
    time = np.arange(0, 100, 0.1)
    limited = np.clip(np.sin(time), -0.3, 0.5)
    assert is_held(np.sign(np.sin(0.7 * time)))
    assert is_held(levels(1000, 3, 0))
    for smooth in (np.sin(time), limited, np.round(np.sin(0.1 * time), 3), 0 * time):
        assert not is_held(smooth)
    assert resolved({"a": "hold"}, ("a", "b")) == ("hold", "linear")
    assert parse_chosen("a=hold,b=cubic") == {"a": "hold", "b": "cubic"}
    for wrong in ("held", "a=held", "hold,b=linear"):
        with pytest.raises(DfsmError, match="--interpolation is"):
            parse_chosen(wrong)
    with pytest.raises(DfsmError, match="inputs: no channel 'uu0'; did you mean 'u0'"):
        fit([], replace(LINEAR, inputs={"uu0": "hold"}))
    values = np.stack([time, time, time], axis=1)[:3]
    pieces = polynomials(time[:3], values, ("hold", "linear", "linear"))
    np.testing.assert_allclose(pieces[2], [[0, 1, 1]] * 2)

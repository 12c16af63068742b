"""Hidden states on a system that hides one, from one record: against its equation and by hand."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

from benchmarks.twins import TWINS
from dfsm.config.proposal import propose
from dfsm.config.template import write_config
from dfsm.data.derivatives import StateSpec
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.hidden.windows import standard_of, windows_of
from dfsm.fitting.settings import FitSettings
from dfsm.models.corrective import Polynomial
from dfsm.models.corrective.polynomial import monomials
from dfsm.models.dfsm import DFSM
from dfsm.models.model_folder import load, save
from dfsm.numerics.subspace import observability, outputs_first, rate_of
from dfsm.refinement.settings import RefineSettings
from dfsm.simulation.hidden import told_state
from dfsm.simulation.simulate import SimulationSettings, Status, simulate

# That a test run leaves the training range by a little is not the point here.
pytestmark = pytest.mark.filterwarnings("ignore:.*outside the training range")
PAGE = Path(__file__).parents[1] / "docs" / "hidden-states.md"
Recorder = Callable[[int], Trajectory]
HIDDEN = HiddenSettings(count=1, form="polynomial")
SETTINGS = FitSettings(
    states=(StateSpec(name="y"),),
    controls=("u",),
    inputs="hold",
    nonlinear_only=False,
    hidden=HIDDEN,
)


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """What the example of the documentation makes: y' = h - 0.8 y, h' = u - h - 0.6 h³."""
    names: dict[str, Any] = {}
    code = PAGE.read_text(encoding="utf-8").split("```python")[1].split("```")[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        exec(compile(code, PAGE.name, "exec"), names)
    return names


@pytest.fixture
def model(page: dict[str, Any]) -> DFSM:
    return page["model"]


@pytest.fixture
def recorded(page: dict[str, Any]) -> Recorder:
    return page["record"]


def test_one_record_teaches_a_hidden_nonlinear_state(
    page: dict[str, Any], model: DFSM, recorded: Recorder, tmp_path: Path
) -> None:
    assert page["error"] < 0.05
    test = recorded(2)
    begin = 15.0
    result = simulate(model, test, start=begin)
    assert result.status is Status.COMPLETED
    record = test.window(begin, None)
    error = np.sqrt(np.mean((result.trajectory["y"] - record["y"]) ** 2)) / test["y"].std()
    assert error < 0.05
    # The linear part alone cannot.
    linear = simulate(model.linear_fit(), test, start=begin).trajectory["y"]
    assert np.sqrt(np.mean((linear - record["y"]) ** 2)) / test["y"].std() > 3 * error
    # What was left out in time told so.
    told = model.provenance.record["hidden"]
    assert told["left_out"] < 0.05
    assert [c.name for c in model.signals.latents] == ["hidden1"]
    save(model, tmp_path / "model")
    again = simulate(load(tmp_path / "model"), test, start=begin)
    np.testing.assert_array_equal(again.trajectory.values, result.trajectory.values)


def test_the_past_tells_the_hidden_state(model: DFSM, recorded: Recorder) -> None:
    """From its window or from the start of the record the rollout is the same one."""
    run = recorded(3)
    whole = simulate(model, run).trajectory
    late = told_state(model, run, 45.0)
    np.testing.assert_allclose(late, whole.select(["y", "hidden1"]).values[300], atol=0.05)
    # What comes after the start has no say.
    values = run.values.copy()
    values[run.time > 45.0, 1] += 1.0
    np.testing.assert_array_equal(told_state(model, replace(run, values=values), 45.0), late)


def test_a_model_tells_where_its_step_is_not_taken(model: DFSM, recorded: Recorder) -> None:
    assert model.signals.step is not None
    run = recorded(2)
    coarse = SimulationSettings(step=4 * model.signals.step)
    slow = replace(run, time=run.time[::4], values=run.values[::4])
    with pytest.warns(match="made for steps of"):
        simulate(model, slow, start=40.0, settings=coarse)


def test_bad_input(model: DFSM, recorded: Recorder) -> None:
    run = recorded(1)
    second = replace(SETTINGS, states=(StateSpec(name="y", order=2),))
    with pytest.raises(DfsmError, match="name it as"):
        fit([run], second)
    with pytest.raises(DfsmError, match="leave refine out"):
        fit([run], SETTINGS, RefineSettings())
    long = replace(SETTINGS, hidden=replace(HIDDEN, startup=200.0))
    with pytest.raises(DfsmError, match=r"hidden.startup is 200 s, but .* lasts 89.85 s"):
        fit([run], long)
    late = np.concatenate([np.full(4, run["y"][0]), run["y"][:-4]])
    both = run.with_channels("z", late)
    twice = replace(SETTINGS, states=(StateSpec(name="y"), StateSpec(name="z")))
    with pytest.raises(DfsmError, match=r"'z' is 'y' 0\.6 s later"):
        fit([both], twice)
    gap = run.window(0, 30)
    gap = replace(gap, time=gap.time + 0.1 * (gap.time > 20.0))
    with pytest.raises(DfsmError, match=r"samples 0\.15 to 0\.25 s apart, where 0\.15 s are usual"):
        fit([run, gap], SETTINGS)
    short = run.window(0, 5)
    with pytest.raises(DfsmError, match="less than the"):
        simulate(model, short)
    few = replace(SETTINGS, hidden=replace(HIDDEN, count=9))
    with pytest.raises(DfsmError, match="too few for"):
        fit([run.window(0, 20)], few)


@pytest.mark.parametrize("kind", ["tanh", "polynomial", "none"])
def test_slopes_of_the_error(kind: str, recorded: Recorder) -> None:
    """JᵀJ and Jᵀr against differences of rollouts, in two steps a sample."""
    run = recorded(1).window(0, 5).select(["y", "u"])
    windows = windows_of([run], standard_of([run], 1), ["linear"], 2)
    form = Form(2, 1, 1, kind, 2, monomials(3, 2))  # pyright: ignore[reportArgumentType]
    if kind == "none":
        form = replace(form, room=4)
    error = HiddenError(form, windows, 0.1)
    w = 0.2 * np.random.default_rng(0).standard_normal(error.size)
    _, slope = error.normal_equations(w)
    h = 1e-6 * np.eye(len(w))
    numeric = [(error.cost(w + d) - error.cost(w - d)) / 4e-6 for d in h]
    np.testing.assert_allclose(slope, numeric, rtol=1e-5, atol=1e-6)
    if kind == "none":
        # Room for more states changes nothing.
        own = HiddenError(replace(form, room=0), windows, 0.1)
        np.testing.assert_allclose(error.paths(w), own.paths(w), rtol=1e-12)


def test_stable_by_construction() -> None:
    """Whatever the weights are, P J + Jᵀ P is at most -2 ε P everywhere."""
    P = np.array([[1.0, 0.0], [0.0, 0.4]])
    form = Form(2, 1, 1, "tanh", 3, metric=tuple(map(tuple, P.tolist())), margin=0.05)
    rng = np.random.default_rng(1)
    parts = form.parts(jnp.asarray(3 * rng.standard_normal(form.size)))
    for z in rng.standard_normal((20, 3)):
        x, v = jnp.asarray(z[:2]), jnp.asarray(z[2:])
        J = np.asarray(jax.jacfwd(lambda x, v: form.rate(parts, x, v))(x, v))
        assert np.linalg.eigvalsh(P @ J + J.T @ P + 2 * 0.05 * P).max() < 1e-9


def test_subspace_finds_a_system() -> None:
    """Three states from one output: the eigenvalues of an exact discrete record."""
    A = np.array([[-0.3, 1.0, 0.0], [-1.0, -0.3, 0.5], [0.0, 0.0, -0.6]])
    B, C = np.array([0.2, 1.0, 1.0]), np.array([[1.0, 0.0, 0.3]])
    exact = expm(np.block([[A, B[:, None]], [np.zeros((1, 4))]]) * 0.4)
    rng, x, y = np.random.default_rng(0), np.zeros(3), []
    u = rng.standard_normal((400, 1))
    for value in u:
        y.append(C @ x)
        x = exact[:3, :3] @ x + exact[:3, 3] * value
    found = observability([(u, np.array(y))], 5)
    assert found.importance[2] > 1e3 * found.importance[3]
    back = outputs_first(*found.system(3))
    ours = np.sort_complex(np.linalg.eigvals(rate_of(back, 0.4)))
    np.testing.assert_allclose(ours, np.sort_complex(np.linalg.eigvals(A)), atol=1e-6)
    # What noise adds beside them is no faster than a rollout of RK4 can follow.
    noisy = observability([(u, np.array(y) + 0.1 * rng.standard_normal((400, 1)))], 6)
    rates = np.linalg.eigvals(rate_of(outputs_first(*noisy.system(6)), 1.0))
    assert np.abs(rates).max() < 2.3
    assert rates.real.max() < 0


def test_polynomial() -> None:
    factors = monomials(2, 3)
    assert factors == ((0, 0, 2), (0, 1, 2), (1, 1, 2), (0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1))
    weights = np.arange(14.0).reshape(2, 7)
    e = Polynomial(jnp.array([1.0, 0.0]), jnp.array([2.0, 1.0]), jnp.asarray(weights), factors)
    a, b = (3.0 - 1) / 2, 0.5
    expected = weights @ [a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3]
    np.testing.assert_allclose(e(jnp.array([3.0, b])), expected)
    wide = e.with_more_inputs(1, 2)
    np.testing.assert_allclose(wide(jnp.array([3.0, 9.0, -9.0, b])), expected)
    again = Polynomial.restored(e.arrays(), e.structure())
    np.testing.assert_array_equal(again(jnp.array([3.0, b])), e(jnp.array([3.0, b])))
    # Far out it goes on for as far as it was told, also when it is read again; else for four.
    far = jnp.array([1.0, 6.0])
    np.testing.assert_allclose(e(far), weights @ [0, 0, 16, 0, 0, 0, 64])
    wider = replace(e, reach=5.5)
    for further in (wider, Polynomial.restored(wider.arrays(), wider.structure())):
        np.testing.assert_allclose(further(far), weights @ [0, 0, 5.5**2, 0, 0, 0, 5.5**3])


def test_init_tells_what_is_driven(recorded: Recorder, tmp_path: Path) -> None:
    """Where derivatives do not tell, the past does: u drives y, and hidden states beside it."""
    run = recorded(1)
    proposal = propose([run], ["u", "y"], [])
    assert proposal.states == [{"name": "y", "order": 1}]
    assert [*proposal.controls, *proposal.disturbances] == ["u"]
    assert proposal.hidden
    # What the recorded channels leave of the derivative, and what to do, is said in the file.
    rate = np.diff(run["y"]) / np.diff(run.time)
    means = (run.values[1:] + run.values[:-1]) / 2
    known = np.column_stack([means, np.ones(len(rate))])
    left = rate - known @ np.linalg.lstsq(known, rate, rcond=None)[0]
    np.testing.assert_allclose(proposal.unexplained["y"], left.std() / rate.std(), rtol=1e-3)
    write_table(run, tmp_path / "run.csv")
    told = write_config([str(tmp_path / "run.csv")], tmp_path / "config.yaml")
    assert told.startswith("Derivatives are not to be fitted here")
    assert f"# {told}\nhidden: {{}}\n" in (tmp_path / "config.yaml").read_text(encoding="utf-8")


def test_a_fit_of_derivatives_tells_where_it_is_out_of_place(recorded: Recorder) -> None:
    """Behind a lag and a nonlinearity derivatives tell little: hidden states are named."""
    run = TWINS["wiener_hammerstein"].record(400, 1)
    settings = FitSettings(
        states=(StateSpec(name="y"),),
        disturbances=("u",),
        corrective=NoCorrection(),
        nonlinear_only=False,
    )
    match = "derivatives are not to be fitted here.* leaves 97% of that of 'y'.* set hidden: {} in"
    with pytest.warns(DfsmWarning, match=match):
        fit([run], settings)
    # Where y and u tell the rate, nothing is said.
    lag = [0.0]
    for v in run["u"][:-1]:
        lag.append(lag[-1] + 0.2 * (v - 0.5 * lag[-1]))
    first = replace(settings, states=(StateSpec(name="z"),), inputs="hold")
    told = fit([run.with_channels("z", np.array(lag))], first)
    assert not any("derivatives" in text for text in told.model.provenance.record["warnings"])


def test_the_data_tell_what_an_input_does_between_samples() -> None:
    """A fast smooth input, of which four samples make a period: a cubic is taken, and told."""
    time = np.arange(0, 60.0, 0.5)
    rng = np.random.default_rng(4)
    phases, rates = rng.uniform(0, 6, 6), np.array([0.7, 1.1, 1.7, 2.3, 2.9, 3.3])
    smooth = lambda t: np.sin(np.multiply.outer(t, rates) + phases).sum(axis=-1)  # noqa: E731
    fine = np.arange(0, 59.51, 0.01)
    x = solve_ivp(lambda t, x: smooth(t) - x, (0, 59.6), [0.0], t_eval=fine, max_step=0.05).y[0]
    y = CubicSpline(fine, x)(time)
    run = Trajectory(
        time, np.stack([smooth(time), y], axis=1), (Channel("u", ""), Channel("y", "")), name="a"
    )
    settings = replace(SETTINGS, inputs=None, hidden=HiddenSettings(count=0, form="none"))
    model = fit([run], settings).model
    assert model.signals.between == ("cubic",)
    assert any("cubic was taken" in text for text in model.provenance.record["checks"])


def test_init_tells_twins_apart() -> None:
    """Each of our twins of published benchmarks gets hidden states and its input."""
    for twin in TWINS.values():
        proposal = propose([twin.record(600, 1)], ["u", "y"], [])
        assert proposal.hidden, twin.name
        assert [s["name"] for s in proposal.states] == ["y"]

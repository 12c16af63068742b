"""Latent states on a system that hides one, and their equations against references."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lsim

from dfsm.control import DirectTranscription, OptimalControlProblem, solve
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.doubts import memory_doubt
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV, LTI, fit_linear
from dfsm.fitting.settings import FitSettings
from dfsm.models.corrective import GaussianUnits, Perceptron
from dfsm.models.latents import Poles, as_states, evolve, latent_path, poles, with_poles
from dfsm.models.model_folder import load, load_all, save
from dfsm.models.signals import Provenance
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import record_of
from dfsm.refinement.refine import refine
from dfsm.refinement.rollout_error import ErrorWeights, RolloutError
from dfsm.refinement.settings import RefineSettings
from dfsm.simulation.simulate import Status, initial_state, simulate
from dfsm.validation.validate import compared, validate
from systems import DUFFING, cost_slopes, wander

TIME = np.arange(0, 60.01, 0.1)
START = 20.0
SETTINGS = FitSettings(
    states=(StateSpec(name="q"),),
    controls=("u",),
    disturbances=("w",),
    outputs=("y",),
    start=START,
    linear=LPV(schedule="w", points=2, margin=0.05),
    corrective=NoCorrection(),
    nonlinear_only=False,
)
REFINEMENT = RefineSettings(windows=(10.0,), step=0.2, iterations=8, latents=2)
# Where latent states are not the point; most of a refinement is compiling what follows them.
WITHOUT = replace(REFINEMENT, windows=(5.0,), iterations=2, latents=0)


def driven(seed: int) -> Trajectory:
    """q' = -0.5 q + h + 0.2 w with h' = -0.3 h + 0.3 (u + w) that no channel holds; y = q + 2 h."""
    rng = np.random.default_rng(seed)
    u, w = (wander(rng, 0.5, TIME[-1], 2.0)(TIME) for _ in range(2))
    A = np.array([[-0.5, 1.0], [0.0, -0.3]])
    B = np.array([[0.0, 0.2], [0.3, 0.3]])
    q, h = lsim((A, B, np.eye(2), np.zeros((2, 2))), np.stack([u, w], axis=1), TIME)[1].T
    channels = (Channel("q", "m"), Channel("u", "N"), Channel("w", "m/s"), Channel("y", "m"))
    values = np.stack([q, u, w, q + 2 * h], axis=1)
    return Trajectory(TIME, values, channels, name=f"run{seed}")


@pytest.fixture(scope="module")
def runs() -> list[Trajectory]:
    return [driven(seed) for seed in range(6)]


@pytest.fixture(scope="module")
def plain(runs):
    return fit(runs, SETTINGS).model


@pytest.fixture(scope="module")
def model(runs):
    return fit(runs, SETTINGS, REFINEMENT).model


def error(model, run: Trajectory, channel: str) -> float:
    found = simulate(model, run, start=START).trajectory
    truth = run.window(START)[channel]
    return float(np.sqrt(np.mean((found[channel] - truth) ** 2)) / truth.std())


def test_a_hidden_state_is_found(plain, model):
    test = driven(99)
    assert error(plain, test, "q") > 0.2
    assert error(model, test, "q") < 0.03
    # Outputs are fitted along rollouts, where the latent states exist.
    assert error(plain, test, "y") > 0.2
    assert error(model, test, "y") < 0.05


def test_pairs_follow_their_equation(model):
    found = Poles(
        jnp.array([0.3, 0.05]),
        jnp.array([1.2, 0.0]),
        jnp.array([[1.0 + 2.0j, 0.5], [0.3, -1.0j]]),
        jnp.array([0.1, 0.2j]),
    )
    v = np.stack([np.interp(TIME, driven(7).time, driven(7)[n]) for n in ("u", "w")], axis=1)
    path = np.asarray(
        evolve(found, jnp.full(len(TIME) - 1, 0.1), jnp.asarray(v), jnp.asarray(v[0]))
    )
    rate = -np.asarray(found.decay) - 1j * np.asarray(found.frequency)
    force = v @ np.asarray(found.drive).T + np.asarray(found.offset)
    start = -force[0] / rate
    for k in range(2):
        sys = np.array([[rate[k].real, -rate[k].imag], [rate[k].imag, rate[k].real]])
        both = np.stack([force[:, k].real, force[:, k].imag], axis=1)
        x0 = [start[k].real, start[k].imag]
        exact = lsim((sys, np.eye(2), np.eye(2), np.zeros((2, 2))), both, TIME, X0=x0)[1]
        np.testing.assert_allclose(path[:, k], exact[:, 0] + 1j * exact[:, 1], atol=5e-4)
    assert as_states(jnp.asarray(path)).shape == (len(TIME), 4)


def test_rollouts_carry_them_along(model):
    run = driven(3)
    states = simulate(model, run, start=START).trajectory
    names = [c.name for c in model.signals.latents]
    path = latent_path(model, run)[run.time >= START]
    spread = np.maximum(path.std(axis=0), 1e-9)
    assert (np.abs(states.select(names).values - path) < 1e-3 * spread).all()
    np.testing.assert_array_equal(initial_state(model, run, START)[1:], path[0])


def test_nothing_measured_after_the_start_enters(model):
    run = driven(3)
    values = run.values.copy()
    values[run.time > START, 0] += 5.0
    one, other = (simulate(model, r, start=START) for r in (run, replace(run, values=values)))
    np.testing.assert_array_equal(one.trajectory.values, other.trajectory.values)


def test_initial_states_may_be_given_without_them(model):
    run = driven(3)
    whole = simulate(model, run, start=START, initial=initial_state(model, run, START))
    some = simulate(model, run, start=START, initial=[run.window(START)["q"][0]])
    np.testing.assert_array_equal(whole.trajectory.values, some.trajectory.values)
    with pytest.raises(DfsmError, match=r"initial has shape \(2,\), expected \(3,\)"):
        simulate(model, run, start=START, initial=[0.0, 0.0])


def test_a_record_that_begins_at_the_start_begins_at_rest(model):
    run = driven(3).window(START)
    assert simulate(model, run).status is Status.COMPLETED
    x0 = initial_state(model, run, START)
    mean = run.select(model.signals.driving).values[run.time <= START + 20.0].mean(axis=0)
    full = model.derivative(x0, mean[:1], mean[1:])
    # Only the first sample was there to tell what came before.
    assert np.isfinite(np.asarray(full)).all()


def test_their_rows_are_stable_and_know_no_schedule(model):
    L = np.asarray(model.f.coefficients)
    np.testing.assert_array_equal(L[0, 1:], L[1, 1:])
    assert (np.asarray(poles(model).decay) > 0).all()
    n_uw = len(model.signals.driving)
    assert (L[:, 1:, n_uw] == 0).all()
    for _, values in model.eigenvalues():
        assert len(values) == 3
        assert values.real.max() < 0


def test_a_model_with_other_dynamics_has_its_own_history(model):
    for told in ("one", "other"):
        marked = replace(model, provenance=Provenance({"told": told}))
        assert with_poles(marked, poles(marked)).provenance.record == {"told": told}


def test_everything_else_takes_them(model, tmp_path, runs):
    assert "latent1" in model.summary()
    save(model, tmp_path / "m")
    again = load(tmp_path / "m")
    np.testing.assert_array_equal(
        simulate(model, runs[0]).trajectory.values, simulate(again, runs[0]).trajectory.values
    )
    A, B, C, _ = model.jacobians(np.zeros(3), [0.0], [0.0])
    assert A.shape == (3, 3)
    assert B.shape == (3, 2)
    assert C.shape == (1, 3)
    checked = validate(model, [driven(98)], start=START)
    assert [c.name for c in checked.channels] == ["q", "y"]
    assert checked.runs[0].models["multi-fidelity"].derivative_errors["q"] < 0.05
    assert len(model.region.low) == len(model.signals.inputs)
    assert simulate(model, driven(97), start=START).outside < 0.2


def test_an_optimum_starts_from_what_went_before(model):
    """Latent states are no choice of the optimizer where a run tells them."""
    run = driven(98)
    cost = {"horizon": (START, 30.0), "cost": lambda s: s.x.q**2 + s.u.u**2}
    problem = OptimalControlProblem(model=model, disturbances=run, **cost)
    known = initial_state(model, run, START)[1:]
    assert list(problem.latent_starts) == ["latent1", "latent2"]
    solution = solve(problem, DirectTranscription(mesh=10, refine=None), simulate=False)
    assert solution.solved
    names = ["latent1", "latent2"]
    np.testing.assert_allclose(solution.trajectory.select(names).values[0], known, rtol=1e-9)
    chosen = replace(problem, initial={"latent1": (None, None)})
    assert list(chosen.latent_starts) == ["latent2"]
    untold = replace(problem, disturbances=run.select(["w"]))
    assert untold.latent_starts == {"latent1": [None], "latent2": [None]}


@pytest.mark.parametrize("kind", ["units", "perceptron", "none"])
def test_slopes_written_out_are_those_of_the_model(model, kind):
    rng = np.random.default_rng(0)
    inputs, units = len(model.signals.inputs), 4
    arrays = [rng.normal(size=s) for s in ((inputs, units), (1, units), (units, inputs))]
    centres, out, first = map(jnp.asarray, arrays)
    shift, scale = jnp.zeros(inputs), jnp.full(inputs, 2.0)
    e = {
        "units": GaussianUnits(shift, scale, centres, out, jnp.zeros(1)),
        "perceptron": Perceptron(shift, scale, (first, out), (jnp.zeros(units), jnp.zeros(1))),
        "none": None,
    }[kind]
    full = replace(model, e=e, corrected=() if e is None else (0,))
    parameters = Parametrization.of(full, np.array([0.7]))
    at = jnp.asarray(0.1 * rng.normal(size=parameters.size))
    slopes = jax.jit(jax.jacfwd(lambda t, point: parameters.at(t).derivative(*full.split(point))))
    written, of_latents = map(eqx.filter_jit, (parameters.slopes, parameters.latent_slopes))
    for _ in range(3):
        point = jnp.asarray(rng.normal(size=inputs))
        there = parameters.at(at)
        found = np.zeros((3, parameters.size))
        weight = rng.normal()
        rows = written(at, there, point[None, None], jnp.full((1, 1, 1, 1), weight))[0]
        found[:1] = rows / weight
        found[1:, parameters.latent_columns[0]] = of_latents(there, point)[0]
        np.testing.assert_allclose(found, slopes(at, point), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("length", [5.0, 10.0])  # less than a block of steps, and one and a rest
def test_sensitivities_agree_with_differences(model, runs, length):
    # As in the refinement of the model, so that what was compiled for it serves here.
    record = record_of(model, runs[0], 0.2, START, None)
    parameters = Parametrization.of(model, np.array([0.7]))
    problem = RolloutError(parameters, [[record]], length, ErrorWeights(np.ones(1)))
    at = 0.01 * np.random.default_rng(0).normal(size=parameters.size)
    _, Jtr = problem.normal_equations(at)
    slopes = cost_slopes(problem, at)
    np.testing.assert_allclose(2 * Jtr, slopes, rtol=1e-5, atol=1e-7)


def test_a_nonlinear_model_beside_it_has_none(runs, tmp_path):
    choices = replace(SETTINGS, corrective=RBF(samples=20), nonlinear_only=True)
    found = fit(runs, choices, replace(REFINEMENT, iterations=2))
    save(found.model, tmp_path / "m", found.nonlinear)
    again = load_all(tmp_path / "m")
    checked = validate(compared(*again.values()), [driven(98)], start=START)
    assert list(checked.models) == ["linear-fit", "multi-fidelity", "nonlinear-only"]
    assert all(checked.completed(name) for name in ("linear-fit", "multi-fidelity"))
    assert not again["nonlinear-only"].signals.latents


def test_an_odd_number_or_nothing_to_drive_them_is_refused():
    with pytest.raises(DfsmError, match=r"refine\.latents is 3, expected an even number"):
        replace(REFINEMENT, latents=3)
    with pytest.raises(DfsmError, match=r"refine\.latent_inputs is .*, expected at least one name"):
        replace(REFINEMENT, latent_inputs=())


def test_constant_coefficients(runs):
    choices = replace(SETTINGS, linear=LPV(schedule="w", points=3, constant=("u",), margin=0.05))
    L = np.asarray(fit(runs, choices).model.f.coefficients)
    assert (L[:, 0, 0] == L[0, 0, 0]).all()
    assert np.ptp(L[:, 0, 1]) > 0
    # With latent states refinement gains whichever runs are held out.
    refined = fit(runs, choices, replace(WITHOUT, latents=2)).model
    L = np.asarray(refined.f.coefficients)
    assert len(refined.signals.latents) == 2
    assert np.ptp(L[:, 0, 0]) == 0
    assert np.ptp(L[:, 0, 1]) > 0
    with pytest.raises(DfsmError, match=r"linear\.constant names 'torque', which is not an input"):
        fit(runs, replace(choices, linear=LPV(schedule="w", constant=("torque",))))


@pytest.fixture(scope="module")
def by_wind(runs, plain):
    """A model whose latent states disturbances alone drive."""
    choices = replace(REFINEMENT, latent_inputs=("w",), windows=(5.0,), iterations=2)
    return refine(plain, runs, choices, start=START).model


@pytest.mark.parametrize("scheme", ["trapezoidal", "radau"])
def test_what_disturbances_alone_drive_is_not_solved_for(by_wind, scheme):
    problem = OptimalControlProblem(
        model=by_wind,
        horizon=(START, 40.0),
        cost=lambda s: (s.x.q - 0.1 * s.x.latent1) ** 2 + 0.1 * s.u.u**2,
        disturbances=driven(98),
    )
    # A bound, however wide, makes it a state like any other.
    asked = replace(problem, bounds={"latent1": (-10.0, 10.0)})
    method = DirectTranscription(scheme=scheme, mesh=200, refine=None)
    found, other = solve(problem, method), solve(asked, method, simulate=False)
    assert set(problem.latent_paths(np.array([START]))) == {"latent1", "latent2"}
    assert not asked.latent_paths(np.array([START]))
    assert found.solved
    assert other.solved
    assert found.objective == pytest.approx(other.objective, rel=2e-3)
    names = ["latent1", "latent2"]
    for name in names:
        # Known exactly, so that an adaptive integrator finds the same.
        assert found.replays[0].deviation[name] < 1e-4 * np.ptp(found.trajectory[name])
    assert found.costates[0].names == ("q",)
    assert other.costates[0].names == ("q", *names)


def test_what_controls_drive_is_solved_for(model):
    cost = {"horizon": (START, 30.0), "cost": lambda s: s.x.q**2}
    problem = OptimalControlProblem(model=model, disturbances=driven(98), **cost)
    assert not problem.latent_paths(np.array([START]))


def test_staying_inside_does_not_bind_what_only_disturbances_drive(by_wind):
    """Unusual wind takes latent states beyond their training range; nobody can help it."""
    run, model = driven(98), by_wind
    values = run.values.copy()
    values[:, run.names.index("w")] *= 1.6
    wild = replace(run, values=values)
    path = latent_path(model, wild)[TIME >= START]
    low, high = (np.asarray(a)[-2:] for a in (model.region.low, model.region.high))
    assert ((path < low) | (path > high)).any()
    problem = OptimalControlProblem(
        model=model,
        horizon=(START, 50.0),
        cost=lambda s: (s.x.q - 0.1) ** 2,
        disturbances=wild,
    )
    method = DirectTranscription(mesh=100, refine=None, stay_inside=True)
    with pytest.warns(DfsmWarning, match=r"of the horizon: latent2 goes to .* w goes to [^;]*$"):
        assert solve(problem, method, simulate=False).solved


@pytest.mark.filterwarnings("ignore:derivatives are not to be fitted here:dfsm.errors.DfsmWarning")
@pytest.mark.parametrize(
    ("linear", "rollouts"),
    [
        (LTI(), replace(WITHOUT, iterations=3, network=4)),
        (LPV(schedule="w", points=3), replace(WITHOUT, latents=2)),
    ],
)
def test_known_coefficients(runs, linear, rollouts, tmp_path):
    linear = replace(linear, known={"q": {"u": 0.125, "q": -0.4}}, margin=0.05)
    for refinement in (None, rollouts):
        model = fit(runs, replace(SETTINGS, linear=linear), refinement).model
        L = np.asarray(model.f.coefficients)
        assert (L[:, 0, 0] == 0.125).all()
        assert (L[:, 0, 2] == -0.4).all()
        assert model.g is not None
        assert not (np.asarray(model.g.coefficients)[:, 0, 0] == 0.125).any()
        save(model, tmp_path / "model")
        assert load(tmp_path / "model").f.known == ((0, 0), (0, 2))
    if rollouts.network:
        assert model.e is not None  # taught by rollouts, and without a say in this
        assert_effect(model, 0.125)


def test_the_others_are_fitted_to_what_known_coefficients_leave():
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(3000, 3)) @ rng.normal(size=(3, 3))
    targets = inputs @ rng.normal(size=(3, 2)) + rng.normal(size=(3000, 2))
    known = {(1, 0): 0.7}
    L = np.asarray(
        fit_linear([(inputs, targets)], ["a", "b", "c"], LTI(), known=known).model.coefficients
    )[0]
    X = np.column_stack([inputs, np.ones(3000)])
    free = np.linalg.lstsq(X, targets[:, 0], rcond=None)[0]
    rest = np.linalg.lstsq(X[:, 1:], targets[:, 1] - 0.7 * inputs[:, 0], rcond=None)[0]
    np.testing.assert_allclose(L[0], free[:3], rtol=1e-9)
    np.testing.assert_allclose(L[1], [0.7, *rest[:2]], rtol=1e-9)


@pytest.mark.parametrize("kind", [RBF(samples=20), GP(samples=20), MLP(hidden=(4,), iterations=20)])
def test_a_correction_does_not_change_known_coefficients(kind):
    # The effect of u that is given is wrong, and nothing is to make up for it.
    bent = DUFFING.many(3, [(0, 3), (0, 2)], np.arange(0, 15.01, 0.05), spread=0.8)
    states = (StateSpec(name="q", order=2),)
    choices = FitSettings(
        states=states,
        controls=("u",),
        disturbances=("w",),
        corrective=kind,
        linear=LTI(known={"q": {"u": 2.0}}),
        nonlinear_only=False,
    )
    model = fit(bent, choices).model
    assert model.e is not None
    assert_effect(model, 2.0)


def assert_effect(model, expected):
    """The last observed state's derivative changes with u by so much everywhere."""
    rng = np.random.default_rng(0)
    row = len(model.signals.observed) - 1
    low, high = np.asarray(model.region.low), np.asarray(model.region.high)
    for point in rng.uniform(low, high, (20, len(low))):
        B = model.jacobians(*model.split(point))[1]
        assert B[row, 0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"speed": {"u": 1.0}}, r"linear\.known names 'speed', which is not a state; "),
        ({"q": {"v": 1.0}}, r"linear\.known\.q names 'v', which is no input of the model; "),
    ],
)
def test_known_coefficients_of_what_there_is_not(runs, known, said):
    with pytest.raises(DfsmError, match=said):
        fit(runs, replace(SETTINGS, linear=LTI(known=known)))


def test_only_chosen_inputs_drive_them(runs, plain, model, by_wind):
    assert ((np.asarray(poles(by_wind).drive) != 0) == [False, True]).all()
    assert memory_doubt(plain) == memory_doubt(by_wind) == []
    assert "latent states answer u" in " ".join(model.provenance.record["checks"])
    with pytest.raises(DfsmError, match=r"refine\.latent_inputs names 'q', which is no control or"):
        refine(plain, runs, replace(REFINEMENT, latent_inputs=("q",)), start=START)


def test_shared_coefficients_are_those_of_one_regression(runs):
    """Against one least-squares problem with an offset and slopes of its own per window."""
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(4000, 3))
    schedule = inputs[:, 2]
    targets = (2.0 * inputs[:, 0] + schedule * inputs[:, 1] + 0.01 * rng.normal(size=4000))[:, None]
    edges = np.array([[-9.0, 0.0], [0.0, 9.0]])
    names = ["a", "b", "s"]
    found = fit_linear(
        [(inputs, targets)], names, LPV(schedule="s", points=2, constant=("a",)), edges
    )
    left = (schedule < 0)[:, None]
    own = np.column_stack([np.ones(4000), inputs[:, 1:]])
    X = np.column_stack([inputs[:, 0], own * left, own * ~left])
    reference = np.linalg.lstsq(X, targets[:, 0], rcond=None)[0]
    L = np.asarray(found.model.coefficients)[:, 0]
    assert L[:, 0] == pytest.approx(reference[0], rel=1e-6)
    np.testing.assert_allclose(L[:, 1], reference[[2, 5]], rtol=1e-2)


def test_lti_models_take_latents_too(runs):
    found = fit(runs, replace(SETTINGS, linear=LTI(margin=0.05)), REFINEMENT).model
    assert error(found, driven(99), "q") < 0.03

"""Rollout refinement on a system that is known: biased fits are mended, good ones are kept."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lsim

from conftest import changed, write_config
from dfsm.core.host import from_host
from dfsm.data.derivatives import StateSpec
from dfsm.data.hold_out import HoldOut
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning, hushed
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LTI
from dfsm.fitting.settings import FitSettings
from dfsm.models.corrective import GaussianUnits, Perceptron
from dfsm.models.model_folder import load
from dfsm.models.signals import Provenance
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Stop
from dfsm.refinement import trial
from dfsm.refinement.growth import StabilityKept
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import record_of
from dfsm.refinement.refine import refine
from dfsm.refinement.rollout_error import ErrorWeights, RolloutError
from dfsm.refinement.settings import RefineSettings
from dfsm.refinement.start import start_network
from dfsm.simulation.simulate import simulate
from systems import OSCILLATOR_A, cost_slopes, linear_model, wander

TIME = np.arange(0, 60.01, 0.05)
SETTINGS = FitSettings(
    states=(StateSpec(name="q", order=2),),
    controls=("u",),
    linear=LTI(),
    corrective=NoCorrection(),
    nonlinear_only=False,
)
CHOICES = RefineSettings(windows=(5.0, None), step=0.1, iterations=10)


def driven(seed: int, hidden: float = 1.0) -> Trajectory:
    """q'' = -4 q - 0.6 q' + 2 u + w, where w is a force that no channel holds."""
    rng = np.random.default_rng(seed)
    u, w = (wander(rng, 0.5, TIME[-1], 2.0)(TIME) for _ in range(2))
    system = (OSCILLATOR_A, np.array([[0.0, 0.0], [2.0, hidden]]), np.eye(2), np.zeros((2, 2)))
    q = lsim(system, np.stack([u, w], axis=1), TIME)[1][:, 0]
    channels = (Channel("q", "m"), Channel("u", "N"))
    return Trajectory(TIME, np.stack([q, u], axis=1), channels, name=f"run{seed}")


def rollout_error(model, run: Trajectory) -> float:
    found = simulate(model, run).trajectory["q"]
    return float(np.sqrt(np.mean((found - run["q"][: len(found)]) ** 2)) / run["q"].std())


@pytest.fixture(scope="module")
def runs() -> list[Trajectory]:
    return [driven(seed) for seed in range(6)]


@pytest.fixture(scope="module")
def biased(runs):
    """A fit whose damping is wrong, as derivative fits of real data are."""
    model = fit(runs, SETTINGS).model
    L = model.f.coefficients.at[0, 1, 2].set(-0.05)
    return replace(model, f=replace(model.f, coefficients=L))


@pytest.fixture(scope="module")
def mended(runs, biased):
    return refine(biased, runs, CHOICES)


def test_a_biased_fit_is_mended(biased, mended):
    result = mended
    assert result.improved
    assert result.after < 0.5 * result.before
    damping = float(result.model.f.coefficients[0, 1, 2])
    assert damping == pytest.approx(-0.6, abs=0.15)
    test = driven(99)
    assert rollout_error(result.model, test) < 0.8 * rollout_error(biased, test)
    # Kinematic rows are laws, not parameters.
    np.testing.assert_array_equal(result.model.f.coefficients[0, 0], biased.f.coefficients[0, 0])
    names = result.model.provenance.record["refinement"]
    assert sorted(names["training"] + names["validation"]) == [f"run{k}" for k in range(6)]
    assert len(names["validation"]) == 1


def test_training_errors_fall_within_a_stage(mended):
    for stage in range(3):
        errors = [entry["training"] for entry in mended.history if entry["stage"] == stage]
        assert (np.diff(errors) <= 0).all()


def test_the_runs_held_out_train_at_last(runs, biased, mended):
    result = mended
    stages = [entry["stage"] for entry in result.history]
    assert 0 < stages.count(2) <= stages.count(1)
    assert all(("validation" in entry) == (entry["stage"] < 2) for entry in result.history)
    records = [record_of(biased, run, CHOICES.step, None, None) for run in runs]
    parameters = Parametrization.of(result.model, np.ones(2))
    everything = RolloutError(parameters, [[r] for r in records], None, ErrorWeights(np.ones(2)))
    error = everything.relative(np.zeros(parameters.size))
    assert result.history[-1]["training"] == pytest.approx(error, rel=1e-9)


def test_the_true_model_is_not_made_worse():
    clean = [driven(seed, hidden=0.0) for seed in range(4)]
    model = fit(clean, SETTINGS).model
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        result = refine(model, clean, CHOICES)
    assert result.after <= result.before
    test = driven(99, hidden=0.0)
    assert rollout_error(result.model, test) <= 1.05 * rollout_error(model, test)


def test_correlated_errors_count_as_in_generalised_least_squares(runs, biased):
    rho, count = 0.7, 3
    parameters = Parametrization.of(biased, np.array([1.0, 3.0]))
    at = np.zeros(parameters.size)
    records = [record_of(biased, run, 0.1, 0.0, 20.0) for run in runs[:count]]
    spread = np.sqrt(np.mean([r.states.var(axis=0) for r in records], axis=0))
    errors = []
    for run, record in zip(runs, records, strict=False):
        with hushed():
            rollout = simulate(biased, run, stop=20.0).trajectory.select(("q", "q_dot"))
        errors.append(((rollout.values[2::2] - record.states[1:]) / spread).ravel())
    covariance = (1 - rho) * np.eye(count) + rho
    expected = np.einsum("it,ij,jt", errors, np.linalg.inv(covariance), errors)
    problem = RolloutError(parameters, [records], None, ErrorWeights(np.ones(2), rho))
    # The refinement averages inputs over its steps.
    assert problem.cost(at) == pytest.approx(expected, rel=0.02)
    alone = RolloutError(parameters, [records[:1]], None, ErrorWeights(np.ones(2), rho))
    plain = RolloutError(parameters, [records[:1]], None, ErrorWeights(np.ones(2)))
    assert alone.cost(at) == plain.cost(at)


def following(seed: int, other: int | None = None) -> Trajectory:
    """q'' = -4 q - 0.6 q' + 2 u + d + w, where u follows w, which no channel holds, and d is known.

    `other` is the seed of something that is added to u.
    """
    rng = np.random.default_rng(seed)
    d, w = (wander(rng, 0.5, TIME[-1], 2.0)(TIME) for _ in range(2))
    u = 0.5 * w
    if other is not None:
        u = u + 0.3 * wander(np.random.default_rng(other), 0.3, TIME[-1], 2.0)(TIME)
    B = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 1.0]])
    system = (OSCILLATOR_A, B, np.eye(2), np.zeros((2, 3)))
    q = lsim(system, np.stack([u, d, w], axis=1), TIME)[1][:, 0]
    channels = (Channel("q", "m"), Channel("u", "N"), Channel("d", "N"))
    return Trajectory(TIME, np.stack([q, u, d], axis=1), channels, name=f"run{seed}")


def test_runs_with_the_same_disturbances_show_what_controls_do():
    runs = [following(s, other) for s in range(4) for other in (None, 50 + s)]
    model = fit(runs, replace(SETTINGS, disturbances=("d",))).model
    found = {}
    for correlation in (0.0, 0.99):
        choices = replace(CHOICES, windows=(None,), correlation=correlation)
        with hushed():  # 0 cannot do better than the start
            refined = refine(model, runs, choices)
        found[correlation] = float(refined.model.f.coefficients[0, 1, 0])
    # Least squares takes what u follows for what u does: 2 + 1 / 0.5, less what is added to u.
    assert found[0.0] > 3
    assert refined.improved
    assert found[0.99] == pytest.approx(2.0, abs=0.3)
    record = refined.model.provenance.record["refinement"]
    # Runs that match have the same name here.
    assert not set(record["validation"]) & set(record["training"])


def test_runs_are_held_out_several_times_and_then_all_train(runs, biased):
    settings = replace(CHOICES, windows=(5.0,), iterations=3, hold_out=HoldOut(share=0.3, splits=2))
    result = refine(biased, runs, settings)
    assert result.improved and len(result.splits) == 2  # noqa: PT018
    assert np.mean(result.splits, axis=0) == pytest.approx([result.before, result.after])
    splits = result.model.provenance.record["refinement"]["splits"]
    assert splits[0]["validation"] != splits[1]["validation"]
    assert "held out 2 times" in result.message
    last = [entry["training"] for entry in result.history if "split" not in entry]
    assert 1 <= len(last) <= 3
    assert float(result.model.f.coefficients[0, 1, 2]) == pytest.approx(-0.6, abs=0.15)


def test_where_refinement_does_not_help_the_start_is_returned(runs, biased, monkeypatch):
    class Nothing(LevenbergMarquardt):
        def __iter__(self):
            return iter(())

    monkeypatch.setattr(trial, "LevenbergMarquardt", Nothing)
    with pytest.warns(DfsmWarning, match="refinement did not lower the error"):
        result = refine(biased, runs, CHOICES)
    assert result.model is biased
    assert not result.improved


def test_why_a_stage_ended_is_told(runs, biased):
    enough = refine(biased, runs, replace(CHOICES, iterations=50))
    # Three stages of a handful of parameters, without noise to overfit, are soon at a minimum.
    assert set(enough.ended) == {Stop.DECREASE.value}
    assert len(enough.ended) == len({entry["stage"] for entry in enough.history}) == 3
    assert enough.model.provenance.record["refinement"]["ended"] == list(enough.ended)
    few = refine(biased, runs, replace(CHOICES, windows=(5.0,), iterations=1))
    assert few.ended == ("as many steps as allowed (1)",) * 2
    late = refine(biased, runs, replace(CHOICES, windows=(5.0,), seconds=0.0))
    assert late.ended == ("the time was up (refine.seconds)",)


def test_the_seed_decides_which_runs_are_held_out(runs, biased):
    short = replace(CHOICES, windows=(5.0,), iterations=1)
    seeds = (0, 0, 1, 2, 3)
    held = [refine(biased, runs, short, seed=s).model.provenance.record for s in seeds]
    names = [tuple(r["refinement"]["validation"]) for r in held]
    assert names[0] == names[1]
    assert len(set(names)) > 1


@pytest.mark.parametrize("size", [1, 3])  # of a group of runs with correlated errors
def test_slopes_agree_with_differences(runs, biased, size):
    records = [record_of(biased, run, 0.1, 0.0, 20.0) for run in runs[:size]]
    parameters = Parametrization.of(biased, np.array([1.0, 3.0]))
    problem = RolloutError(parameters, [records], 10.0, ErrorWeights(np.ones(2), 0.7))
    at = 0.01 * np.random.default_rng(0).normal(size=parameters.size)
    JtJ, Jtr = problem.normal_equations(at)
    assert JtJ.shape == (parameters.size, parameters.size)
    slopes = cost_slopes(problem, at)
    np.testing.assert_allclose(2 * Jtr, slopes, rtol=1e-5, atol=1e-6)


def curvatures(runs, model, step: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """JᵀJ as it is approximated, and by differences."""
    records = [record_of(model, run, step, 0.0, 20.0) for run in runs[:2]]
    parameters = Parametrization.of(model, np.array([1.0, 3.0]))
    problem = RolloutError(parameters, [records], length, ErrorWeights(np.ones(2)))
    at, eps = 0.01 * np.random.default_rng(0).normal(size=parameters.size), 1e-5
    errors = sys.modules[RolloutError.__module__]._errors

    def residuals(w: np.ndarray) -> np.ndarray:
        (group,), (scale,) = problem._groups, problem._scales
        return np.concatenate([np.ravel(errors(parameters, w, part, scale)) for part in group])

    directions = eps * np.eye(parameters.size)
    J = [(residuals(at + d) - residuals(at - d)) / (2 * eps) for d in directions]
    return problem.normal_equations(at)[0], np.array(J) @ np.array(J).T


@pytest.mark.parametrize("length", [1.0, 10.0])
def test_curvature_is_nearly_that_of_all_steps(runs, biased, length):
    """In long windows one step of four stands for all."""
    found, expected = curvatures(runs, biased, 0.1, length)
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


def test_slopes_in_the_middle_of_steps_err_with_their_square(runs, biased):
    errors = []
    for step in (0.1, 0.05):
        found, expected = curvatures(runs, biased, step, 0.5)
        errors.append(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)


@pytest.mark.parametrize("network", [0, 3])
def test_growth_adds_to_the_cost_with_exact_slopes(runs, biased, network):
    """Slopes against differences where an eigenvalue is past the margin, and the wall."""
    # Growth of -0.003 1/s is between the margin and the wall.
    L = biased.f.coefficients.at[0, 1, 2].set(-0.006)
    model = replace(biased, f=replace(biased.f, coefficients=L))
    if network:
        model = start_network(model, network, np.array([1.0, 3.0]), 0)
    parameters = Parametrization.of(model, np.array([1.0, 3.0]))
    kept = StabilityKept(parameters, 1000)
    rng = np.random.default_rng(0)
    draws = (1e-4 * rng.normal(size=parameters.size) for _ in range(200))
    at = next(w for w in draws if 0 < kept.cost(w) < np.inf)
    slopes = cost_slopes(kept, at)
    np.testing.assert_allclose(2 * kept.normal_equations(at)[1], slopes, rtol=1e-4, atol=1e-4)
    draws = (0.5 * rng.normal(size=parameters.size) for _ in range(200))
    assert any(kept.cost(w) == np.inf for w in draws)


def test_growth_of_a_start_that_is_unstable_is_left_alone(biased):
    L = biased.f.coefficients.at[0, 1, 2].set(0.2)
    unstable = replace(biased, f=replace(biased.f, coefficients=L))
    kept = StabilityKept(Parametrization.of(unstable, np.array([1.0, 3.0])), 1000)
    zero = np.zeros(4)
    assert kept.cost(zero) == 0
    assert not kept.normal_equations(zero)[0].any()


def test_growth_where_eigenvalues_meet_is_finite(biased):
    """Two eigenvalues at -0.001 1/s with one eigenvector: past the margin, and without a slope."""
    L = biased.f.coefficients.at[0, 1, 1:3].set(jnp.array([-(0.001**2), -0.002]))
    kept = StabilityKept(
        Parametrization.of(replace(biased, f=replace(biased.f, coefficients=L)), np.ones(2)), 1000
    )
    zero = np.zeros(4)
    assert 0 < kept.cost(zero) < np.inf
    for part in kept.normal_equations(zero):
        assert np.isfinite(part).all()


def test_a_network_is_added_that_changes_nothing_yet(runs, biased):
    added = start_network(biased, 5, np.array([1.0, 3.0]), 0)
    before, after = (simulate(m, runs[0]).trajectory.values for m in (biased, added))
    np.testing.assert_allclose(before, after)
    choices = replace(CHOICES, windows=(5.0,), network=5, iterations=4)
    refined = refine(biased, runs, choices).model
    assert isinstance(refined.e, Perceptron)
    assert np.asarray(refined.e.weights[-1]).any()
    assert refined.corrected == (1,)


def test_decay_keeps_a_model_near_its_start(runs, biased):
    far, near = (
        refine(biased, runs, replace(CHOICES, decay=d, iterations=4)).model.f.coefficients
        for d in (0.0, 1e6)
    )
    start = biased.f.coefficients
    assert np.abs(near - start).max() < 0.3 * np.abs(far - start).max()


@pytest.mark.parametrize("kind", ["units", "perceptron", "none"])
def test_deviations_change_what_they_should(kind):
    rng = np.random.default_rng(0)

    def drawn(*shape: int) -> np.ndarray:
        return rng.normal(size=shape)

    units = GaussianUnits(
        *map(from_host, (np.zeros(3), np.ones(3), drawn(3, 4), drawn(1, 4), np.zeros(1)))
    )
    network = Perceptron(
        from_host(np.zeros(3)),
        from_host(np.ones(3)),
        (from_host(drawn(4, 3)), from_host(drawn(1, 4))),
        (from_host(np.zeros(4)), from_host(np.zeros(1))),
    )
    model = linear_model(OSCILLATOR_A, np.array([[0.0], [2.0]]))
    if kind != "none":
        e = units if kind == "units" else network
        model = replace(model, e=e, corrected=(1,))
    parameters = Parametrization.of(model, np.array([1.0, 2.0]))
    extra = {"units": 5, "perceptron": 21, "none": 0}[kind]
    assert parameters.size == 2 * 4 + extra
    point = np.array([0.3, -0.2]), np.array([0.7]), np.zeros(0)
    zero = from_host(np.zeros(parameters.size))
    np.testing.assert_array_equal(parameters.at(zero).derivative(*point), model.derivative(*point))
    slopes = jax.jit(jax.jacfwd(lambda w: parameters.at(w).derivative(*point)))(zero)
    assert (np.abs(np.asarray(slopes)).max(axis=0) > 0).all()
    # Only the last row is corrected, and its spread is the unit of change.
    assert (np.asarray(slopes)[0, 8:] == 0).all()


def test_what_is_made_of_a_model_has_its_history(biased):
    """Not that of another model of the same size, for which it was compiled."""
    zero = np.zeros(4)
    for told in ("one", "other"):
        model = replace(biased, provenance=Provenance({"told": told}))
        changed = Parametrization.of(model, np.ones(2)).at(jnp.asarray(zero))
        assert changed.provenance.record == {"told": told}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"windows": ()}, "refine.windows is .*, expected at least one length"),
        ({"windows": (0.01,)}, "expected lengths in s, longer than refine.step"),
        ({"step": 0.0}, "refine.step is 0"),
        ({"hold_out": 1.0}, "refine.hold_out is 1.0, expected a share between 0 and 1"),
        ({"iterations": 0}, "refine.iterations is 0, expected at least 1"),
        ({"weights": {"q": -1.0}}, "refine.weights.q is -1.0, expected 0 or more"),
    ],
)
def test_settings_that_make_no_sense(changes, said):
    with pytest.raises(DfsmError, match=said):
        replace(CHOICES, **changes)


def test_bad_input(runs, biased):
    with pytest.raises(DfsmError, match=r"refine\.weights names 'speed', which is no state"):
        refine(biased, runs, replace(CHOICES, weights={"speed": 1.0}))
    with pytest.raises(DfsmError, match="one run cannot be split"):
        refine(biased, runs[:1], CHOICES)


def test_no_step_is_begun_after_the_time_given(runs, biased):
    result = refine(biased, runs, replace(CHOICES, seconds=0.0))
    assert len(result.history) == len(CHOICES.windows)
    # Every length of windows has a share of it: half of it is for training on all runs.
    settings = replace(CHOICES, windows=(5.0, 10.0), seconds=100.0)
    course = trial.Course(biased, settings, (None, None), (), 0, perf_counter() - 40.0)
    assert [late() for late in course.late_by_stage(0.0, 0.5)] == [True, False]


def test_the_command_line_refines(here, dfsm):
    content = changed("corrective", value={"kind": "none"})
    content["refine"] = {"windows": [2.0], "step": 0.1, "iterations": 2}
    write_config(Path("c.yaml"), content)
    result = dfsm("fit", "c.yaml", "-o", "m")
    assert result.code == 0
    record = load("m").provenance.record
    if "refinement" in record:
        assert "the error of rollouts over those held out (" in " ".join(result.out.split())
    else:
        assert "refinement did not lower the error" in result.err
    write_config(Path("c.yaml"), content | {"refine": content["refine"] | {"windows": [-1.0]}})
    refused = dfsm("fit", "c.yaml", "-o", "other")
    assert refused.code == 2
    assert "refine.windows is -1.0" in refused.err
    assert not Path("other").exists()

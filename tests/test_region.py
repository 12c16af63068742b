"""Distances from the training data against their definition, and what follows from them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.control import DirectTranscription, OptimalControlProblem, solve
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV, LTI
from dfsm.fitting.region import whiten
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import load, save
from dfsm.numerics.hats import hats
from dfsm.simulation.simulate import simulate
from systems import wander

TIME = np.arange(0, 80.01, 0.1)
SETTINGS = FitSettings(
    states=(StateSpec(name="q"),),
    controls=("u",),
    disturbances=("w",),
    linear=LTI(),
    corrective=NoCorrection(),
    nonlinear_only=False,
    inputs="linear",  # though Euler's rule holds them
)


def controlled(seed: int) -> Trajectory:
    """q' = -q + u + w under the law u = -2 q + 0.2 v: u and q hardly vary apart."""
    rng = np.random.default_rng(seed)
    w, v = (wander(rng, 0.5, TIME[-1], 2.0)(TIME) for _ in range(2))
    q = np.zeros(len(TIME))
    for k in range(len(TIME) - 1):
        q[k + 1] = q[k] + 0.1 * (-3 * q[k] + 0.2 * v[k] + w[k])
    channels = (Channel("q", "m"), Channel("u", "N"), Channel("w", "N"))
    return Trajectory(TIME, np.stack([q, -2 * q + 0.2 * v, w], axis=1), channels, name=f"r{seed}")


@pytest.fixture(scope="module")
def runs() -> list[Trajectory]:
    return [controlled(seed) for seed in range(8)]


@pytest.fixture(scope="module", params=["LTI", "LPV"])
def model(request, runs):
    linear = LTI() if request.param == "LTI" else LPV(schedule="w", points=2)
    return fit(runs, replace(SETTINGS, linear=linear)).model


def test_without_a_schedule_it_is_mahalanobis_distance(runs):
    region = fit(runs, SETTINGS).model.region
    data = np.concatenate([r.select(["u", "w", "q"]).values for r in runs])
    points = np.random.default_rng(0).normal(size=(50, 3))
    C = np.linalg.inv(np.cov(data.T) + 1e-4 * np.diag(data.var(axis=0)))
    apart = points - data.mean(axis=0)
    expected = np.einsum("ni,ij,nj->n", apart, C, apart)
    found = np.asarray(region.distance(points))
    np.testing.assert_allclose(found / found[0], expected / expected[0], rtol=1e-3)


@pytest.mark.filterwarnings("ignore:.*rollouts spend:dfsm.errors.DfsmWarning")
def test_new_runs_are_inside_as_often_as_the_quantile_says(model):
    shares = [simulate(model, controlled(100 + k)).outside for k in range(10)]
    assert 0.005 < np.mean(shares) < 0.05  # 2 % are promised


def test_combinations_that_never_occurred_are_outside(model):
    names = [c.name for c in model.signals.inputs]
    low, high = np.asarray(model.region.low), np.asarray(model.region.high)
    point = dict(zip(names, (low + high) / 2, strict=True))
    # Both within their ranges; the law never lets them have the same sign.
    point |= {"u": 0.7 * high[0], "q": 0.7 * high[2]}
    inputs = np.array([point[n] for n in names])
    assert (inputs > low).all()
    assert (inputs < high).all()
    assert bool(model.region.outside(inputs))
    assert float(model.region.distance(inputs)) > 1
    assert not bool(model.region.outside((low + high) / 2))


def test_what_is_chosen_takes_what_disturbances_leave(model):
    region = model.region
    mean, std = np.asarray(region.mean), np.asarray(region.std)
    inputs = mean + std * np.random.default_rng(0).normal(size=(500, 3))
    whole, chosen = np.asarray(region.distance(inputs)), np.asarray(region.distance_chosen(inputs))
    # As far as is usual is the same for both, but where the disturbance itself is far off.
    near = np.abs(inputs[:, 1] - mean[1]) < std[1]
    assert 20 < (whole[near] > 1).sum() < near.sum() - 20
    np.testing.assert_array_equal(chosen[near] > 1, whole[near] > 1)
    # The nearest controls and states to given disturbances add nothing.
    if model.schedule is None:
        W = np.asarray(region.whitening[0])
        w = 0.7
        rows = W[1:]
        best = np.linalg.lstsq(rows[:, [0, 2]], -rows[:, 1] * (w - mean[1]), rcond=None)[0]
        point = np.array([best[0] + mean[0], w, best[1] + mean[2]])
        assert float(region.distance_chosen(point)) == pytest.approx(0, abs=1e-12)
        far = mean + np.array([0.0, 50.0 * std[1], 0.0])
        added = float(region.distance(far)) - float(np.sum((W[0] @ (far - mean)) ** 2))
        assert float(region.distance_chosen(far)) == pytest.approx(added / 0.2)


@pytest.mark.parametrize("name", ["distance", "distance_chosen"])
def test_slopes_are_exact(model, name):
    distance = getattr(model.region, name)
    point = jnp.array([0.3, 0.1, -0.4])
    slopes = jax.grad(distance)(point)
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        there, here = (float(distance(point + s)) for s in (step, -step))
        assert float(slopes[k]) == pytest.approx((there - here) / 2e-6, rel=1e-6, abs=1e-6)


def test_it_is_kept(model, tmp_path):
    save(model, tmp_path / "m")
    again = load(tmp_path / "m").region
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_array_equal(model.region.distance(points), again.distance(points))
    assert (again.fixed, again.schedule) == (1, model.f.schedule)


def test_an_optimum_stays_near_the_data_if_asked(model):
    """Pushing q up against the law leaves the data at once."""
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 5.0),
        disturbances=controlled(50),
        cost=lambda s: -s.x.q,
        bounds={"u": (-40.0, 40.0), "q": (-20.0, 20.0)},
    )
    with pytest.warns(DfsmWarning, match="stay_inside keeps it near") as told:
        free, kept = (
            solve(
                problem,
                DirectTranscription(mesh=20, refine=None, stay_inside=inside),
                simulate=False,
            )
            for inside in (False, True)
        )
    assert len(told) == 1
    assert free.solved
    assert kept.solved
    assert free.outside > 0.5
    inputs = kept.trajectory.select(["u", "w", "q"]).values
    assert np.asarray(model.region.distance_chosen(inputs)).max() < 1 + 1e-6
    assert kept.objective > free.objective
    # Solved without the distance, then with a bound on it that is four times tighter at most each
    # time; an optimum as the guess saves the first.
    method = DirectTranscription(mesh=20, refine=None, stay_inside=True)
    again = solve(problem, method, free, simulate=False)
    far = model.region.distance_chosen(free.trajectory.select(["u", "w", "q"]).values).max()
    assert len(again.meshes) == np.ceil(np.log(far) / np.log(4))
    assert len(kept.meshes) == len(again.meshes) + 1 > 2
    assert again.objective == pytest.approx(kept.objective, rel=1e-6)
    # Only the last bound is worth finer meshes.
    refined = solve(problem, replace(method, refine=1e-6), simulate=False)
    intervals = [mesh["intervals"] for mesh in refined.meshes]
    assert intervals[: len(kept.meshes)] == [20] * len(kept.meshes)
    assert refined.error <= 1e-6
    assert max(intervals) > 20


def test_a_single_run_is_judged_by_its_quarters(runs):
    inputs = runs[0].select(["u", "w", "q"]).values
    one = np.zeros(len(inputs), dtype=int)
    _, reach = whiten(inputs, [slice(0, len(inputs))], one, None, np.array([1]))
    ends = np.searchsorted(np.arange(len(inputs)) * 4 // len(inputs), range(5))
    quarters = [slice(a, b) for a, b in pairwise(ends.tolist())]
    _, several = whiten(inputs, quarters, one, None, np.array([1]))
    assert reach == several


def test_hats_add_up_to_one():
    values = hats(np.array([0.0, 1.0, 3.0]), np.array([-1.0, 0.5, 2.0, 9.0]))
    np.testing.assert_allclose(values.sum(axis=1), 1)
    np.testing.assert_allclose(values[1], [0.5, 0.5, 0])

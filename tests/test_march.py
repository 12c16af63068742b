"""Many runs in one batch, as an accelerator takes them, forced on the processor.

The reference is the single run, which other tests hold against solve_ivp and closed forms.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import gpu
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.models.corrective import GaussianUnits
from dfsm.models.signals import Azimuth
from dfsm.simulation import march
from dfsm.simulation.fastest import fastest_rates
from dfsm.simulation.integrate import Case, mesh_of
from dfsm.simulation.simulate import SimulationSettings, Status, simulate
from systems import linear_model, wander

A = np.array([[0.0, 1.0], [-4.0, -0.4]])
UNITS = GaussianUnits(
    shift=jnp.zeros(4),
    scale=jnp.full(4, 2.0),
    centres=jnp.asarray(np.random.default_rng(0).normal(size=(4, 3))),
    weights=jnp.asarray(np.random.default_rng(1).normal(size=(1, 3))),
    bias=jnp.zeros(1),
)
# Its outputs turn with the azimuth, the integral of the first state.
MODEL = linear_model(
    A,
    np.array([[0.0, 0.0], [2.0, 1.0]]),
    np.array([[1.0, 2.0]]),
    np.zeros((1, 2)),
    corrective=UNITS,
    names=["speed", "rate"],
    units=["rpm", "rpm/s"],
    azimuth=Azimuth(speed="speed", angle="psi"),
)
CHANNELS = (*MODEL.signals.states, *MODEL.signals.controls, Channel("psi", "deg"))


def run(seed: int, time: np.ndarray) -> Trajectory:
    rng = np.random.default_rng(seed)
    inputs = [wander(rng, 0.5, 3.0, 2.0)(time) for _ in MODEL.signals.controls]
    state = [np.full(len(time), v) for v in rng.uniform(-0.5, 0.5, 2)]
    turned = np.full(len(time), rng.uniform(0, 360))
    return Trajectory(time, np.stack([*state, *inputs, turned], axis=1), CHANNELS, f"run{seed}")


IRREGULAR = np.sort(np.concatenate([[0, 12], np.random.default_rng(2).uniform(0, 12, 70)]))
TIMES = (np.linspace(0, 12, 61), np.linspace(3, 9, 31), IRREGULAR, np.linspace(0, 60, 1201))
RUNS = [run(seed, time) for seed, time in enumerate(TIMES)]


@pytest.mark.parametrize(
    "settings",
    [
        SimulationSettings(),
        SimulationSettings(step=0.05, interpolation={"u0": "hold", "u1": "cubic"}),
    ],
)
def test_a_batch_has_the_results_of_single_runs(monkeypatch, settings):
    alone = [simulate(MODEL, one, settings=settings) for one in RUNS]
    monkeypatch.setattr(march, "in_batches", lambda: True)
    # Outputs in parts that do not divide the samples.
    monkeypatch.setattr(march, "_SEEN_AT_ONCE", 1200)
    for result, single in zip(simulate(MODEL, RUNS, settings=settings), alone, strict=True):
        assert result.status is single.status is Status.COMPLETED
        assert result.trajectory.name == single.trajectory.name
        assert result.outside == pytest.approx(single.outside, abs=1e-12)
        np.testing.assert_array_equal(result.trajectory.time, single.trajectory.time)
        np.testing.assert_allclose(
            result.trajectory.values, single.trajectory.values, rtol=0, atol=1e-11
        )


def test_a_batch_too_large_for_the_memory_is_split(monkeypatch):
    meshes = [mesh_of(RUNS[i % 2].select(MODEL.signals.exogenous), None, "linear")
              for i in range(7)]  # fmt: skip
    assert [sorted(rows) for rows in march._batches(MODEL, meshes)] == [list(range(7))]
    # Two inputs, two states, one output, and two more numbers a sample, twice; room for three runs.
    monkeypatch.setattr(march, "_ASSUMED", 3 * 2 * 8 * 7 * march.padded(61, march._FEWEST_SAMPLES))
    split = list(march._batches(MODEL, meshes))
    assert sorted(len(rows) for rows in split) == [2, 2, 3]
    # Runs of one length stand together, and none is lost.
    assert [i for rows in split for i in rows] == [1, 3, 5, 0, 2, 4, 6]


def test_a_batch_that_the_device_refuses_is_halved(monkeypatch):
    alone = [simulate(MODEL, one) for one in RUNS]
    real, tried = march._march_batch, []

    def with_room_for_two(model, cases, pool=None):
        tried.append(len(cases))
        if len(cases) > 2:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")
        return real(model, cases, pool)

    monkeypatch.setattr(march, "in_batches", lambda: True)
    monkeypatch.setattr(march, "_march_batch", with_room_for_two)
    for result, single in zip(simulate(MODEL, RUNS), alone, strict=True):
        np.testing.assert_allclose(
            result.trajectory.values, single.trajectory.values, rtol=0, atol=1e-11
        )
    assert tried == [4, 2, 2]


def test_the_fastest_rate_of_a_run_does_not_depend_on_the_others():
    values = [one.select(MODEL.signals.exogenous).values for one in RUNS]
    values[1] = np.full_like(values[1], np.nan)
    alone = [rate for one in values for rate in fastest_rates(MODEL, [one])]
    assert fastest_rates(MODEL, values) == pytest.approx(alone, rel=1e-12)
    assert alone[0] > 1
    assert alone[1] in (0.0, alone[0])


def test_few_sizes_are_compiled():
    sizes = [march.padded(n) for n in range(1, 4097)]
    assert all(n <= size <= n + n // 8 + 1 for n, size in zip(range(1, 4097), sizes, strict=True))
    assert len(set(sizes)) < 90

    def case(i: int):
        return Case(mesh_of(RUNS[i].select(MODEL.signals.exogenous), None, "linear"),
                          np.zeros(2), 0.0, np.zeros((len(RUNS[i]), 0)))  # fmt: skip

    shapes = {tuple(part.shape for part in march._march_batch(MODEL, [case(i)])) for i in range(3)}
    assert len(shapes) == 1


def test_without_a_gpu_there_is_one_sentence():
    assert gpu.run() == gpu.NONE

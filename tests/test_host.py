"""Arrays of the host on their way to JAX: the same values, and nothing is compiled."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.core.host import from_host, traced
from dfsm.models.corrective import GaussianUnits, Perceptron
from systems import linear_model

# Sizes that no other test has, so that nothing is compiled for them yet.
STATES, CONTROLS, SAMPLES = 6, 5, 37


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """Names of what JAX traces, lowers and compiles from now on."""
    events = list[str]()

    def listen(name: str, _seconds: float, **_: object) -> None:
        events.append(name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield events
    jax.monitoring.unregister_event_duration_listener(listen)


def test_what_only_moves_values_compiles_nothing(compiled):
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(STATES, STATES)), rng.normal(size=(STATES, CONTROLS))
    model = linear_model(A, B)
    x, u = rng.normal(size=(SAMPLES, STATES)), rng.normal(size=(SAMPLES, CONTROLS))
    inputs = model.join(x, u, [])
    parts = model.split(inputs)
    beyond = model.region.beyond(20 * np.asarray(inputs))
    count = STATES + CONTROLS
    shift, scale, bias = np.zeros(count), np.ones(count), rng.normal(size=3)
    centres, out, first = (rng.normal(size=s) for s in ((count, 7), (3, 7), (7, count)))
    units = GaussianUnits(*map(from_host, (shift, scale, centres, out, bias)))
    arrays = [from_host(a) for a in (shift, scale, first, out, np.zeros(7), bias)]
    network = Perceptron(*arrays[:2], tuple(arrays[2:4]), tuple(arrays[4:]))
    wider = [f.select([2, 0]).ignoring([1]).with_more_inputs(4, 2) for f in (units, network)]
    assert compiled == []
    np.testing.assert_array_equal(inputs, np.concatenate([u, x], axis=1))
    for part, values in zip(parts, (x, u, x[:, :0], x[:, :0]), strict=True):
        np.testing.assert_array_equal(part, values)
    np.testing.assert_array_equal(beyond, abs(20 * np.asarray(inputs)) > 10 * (1 + 2e-9))
    point = np.insert(x[0, :1], 0, np.zeros(count - 1))
    for before, after in zip((units, network), wider, strict=True):
        # The input that is ignored is in the middle of its range, and those added have no effect.
        there = np.insert(np.where(np.arange(count) == 1, 9.0, point), [4, 4], 5.0)
        np.testing.assert_allclose(after(there), np.asarray(before(point))[[2, 0]], rtol=1e-12)


def test_values_are_copied_and_arrays_of_jax_are_taken_as_they_are():
    values = np.arange(4096.0)
    array = from_host(values)
    values[:] = 0.0
    np.testing.assert_array_equal(array, np.arange(4096.0))
    assert from_host(array) is array
    assert [from_host(v).dtype for v in (1.5, [1, 2], np.float32(1))] == [
        np.float64,
        np.int64,
        np.float32,
    ]
    seen = list[bool]()
    doubled = jax.jit(lambda x: (seen.append(traced(array, x)), 2 * from_host(x) + from_host(1.0)))
    assert float(doubled(jnp.asarray(3.0))[1]) == 7.0
    assert seen == [True]
    assert not traced(array, values)

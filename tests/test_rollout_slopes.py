"""Steps that stand for others, and slopes along a rollout that are known."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.slopes import path_of, sensitivities, slope_of_sum, spread_steps
from systems import linear_model


@pytest.mark.parametrize("steps", [39, 40, 41, 42, 43, 400])
@pytest.mark.parametrize("every", [1, 2, 3, 4, 5])
def test_steps_that_stand_for_all_stand_in_the_middle(steps, every):
    kept, counts = spread_steps(steps, every)
    assert counts.sum() == steps
    assert (np.diff(kept) > 0).all()
    assert len(kept) == -(-steps // every)
    at = np.arange(1, steps + 1.0)
    # Squares of what grows linearly; the last step of each block would be off by a tenth.
    assert counts @ at[kept] ** 2 == pytest.approx(np.sum(at**2), rel=0.01)


def test_curvature_of_slopes_that_grow_along_a_window():
    """x' = a x + b u + c near a = 0: the slope by c is the time, which JᵀJ sums up squared."""
    model = linear_model(np.zeros((1, 1)), np.ones((1, 1)))
    parameters = Parametrization.of(model, np.ones(1))
    step, steps = 0.25, 40
    v = 0.5 + np.zeros((2 * steps + 1, 1))
    errors = np.random.default_rng(0).normal(size=(steps, 1))
    at = jnp.zeros(parameters.size)
    start = jnp.zeros((0, 2, 0)), jnp.zeros((1, parameters.size))
    drive = jnp.asarray(v[:-2:2]), jnp.asarray(v[1::2]), jnp.asarray(v[2::2])
    path = path_of(model, step, jnp.zeros(1), drive)
    sums = {}
    compiled = eqx.filter_jit(sensitivities)
    for every in (1, 4):
        S = compiled(parameters, at, step, path, start, every)
        J = np.asarray(S)[:, 0] * np.sqrt(spread_steps(steps, every)[1])[:, None]
        sums[every] = J.T @ J
    offset = parameters.size - 1
    time = step * np.arange(1, steps + 1)
    assert sums[1][offset, offset] == pytest.approx(np.sum(time**2), rel=1e-12)
    np.testing.assert_allclose(sums[4], sums[1], rtol=0.01, atol=1e-9)
    _, total = eqx.filter_jit(slope_of_sum)(parameters, at, step, path, jnp.asarray(errors))
    assert float(total[offset]) == pytest.approx(time @ errors[:, 0], rel=1e-12)

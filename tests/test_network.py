"""Normal equations of tanh networks against a Jacobian from JAX, and the steps made from them."""

from __future__ import annotations

from itertools import islice, pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.fitting.corrective.network import NetworkError, evaluate, layers
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Step

SIZES = [(3, 4, 2), (3, 4, 5, 2), (2, 3, 3, 3, 1), (1, 1, 6)]


def drawn(sizes: tuple[int, ...], samples: int = 1300):
    """Weights and samples, more than fit into one block."""
    rng = np.random.default_rng(0)
    count = sum(o * (i + 1) for i, o in pairwise(sizes))
    z = rng.normal(size=(samples, sizes[0]))
    return rng.normal(size=count), z, rng.normal(size=(samples, sizes[-1]))


def by_hand(w, z, sizes):
    """The network written out for one sample."""
    *hidden, last = layers(w, sizes)
    for W in hidden:
        z = jnp.tanh(W[:, :-1] @ z + W[:, -1])
    return last[:, :-1] @ z + last[:, -1]


@pytest.mark.parametrize("sizes", SIZES)
def test_normal_equations_are_those_of_the_jacobian(sizes):
    w, z, targets = drawn(sizes)
    slopes = jax.jacrev(by_hand)
    both = jax.jit(jax.vmap(lambda *at: (by_hand(*at, sizes), slopes(*at, sizes)), (None, 0)))
    found, J = map(np.asarray, both(w, z))
    residuals, J = found - targets, J.reshape(-1, len(w))
    error = NetworkError.of(sizes, z, targets)
    JtJ, Jtr = error.normal_equations(w)
    np.testing.assert_allclose(JtJ, J.T @ J, rtol=0, atol=1e-11 * np.abs(J.T @ J).max())
    np.testing.assert_allclose(Jtr, J.T @ residuals.ravel(), rtol=0, atol=1e-11 * abs(Jtr).max())
    assert error.cost(w) == pytest.approx((residuals**2).sum(), rel=1e-12)


@pytest.mark.parametrize("sizes", SIZES)
def test_many_samples_at_once_are_the_samples_one_by_one(sizes):
    w, z, _ = drawn(sizes, 5)
    found = np.asarray(evaluate(w, z, sizes))
    one = jax.jit(lambda row: by_hand(w, row, sizes))
    np.testing.assert_allclose(found, [one(row) for row in z], atol=1e-14)


def test_steps_lead_to_the_network_that_made_the_targets():
    sizes = (2, 3, 2)
    w, z, _ = drawn(sizes)
    targets = np.asarray(evaluate(w, z, sizes))
    problem = NetworkError.of(sizes, z, targets)
    start = w + 0.3 * np.random.default_rng(1).normal(size=w.shape)
    costs = [
        problem.cost(s.weights) for s in islice(LevenbergMarquardt(problem, Step(start), 0), 30)
    ]
    assert (np.diff([problem.cost(start), *costs]) < 0).all()
    assert costs[-1] < 1e-16 * (targets**2).sum()


def test_a_penalty_makes_the_weights_small():
    sizes = (2, 3, 1)
    w, z, targets = drawn(sizes)
    problem = NetworkError.of(sizes, z, targets)
    sizes_of = []
    for penalty in (1.0, 1e4):
        *_, last = islice(LevenbergMarquardt(problem, Step(w), penalty), 30)
        sizes_of.append(np.linalg.norm(last.weights))
    assert sizes_of[1] < 0.1 * sizes_of[0]

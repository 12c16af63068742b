"""Levenberg-Marquardt on problems with known answers, and why it stops there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Step, Stop


@dataclass
class Residuals:
    """|r(w)|² with slopes from JAX; `share` scales JᵀJ, `wall` is where the cost is infinite."""

    r: Callable[[jax.Array], jax.Array]
    share: float = 1.0
    wall: Callable[[Array], bool] = lambda _: False
    evaluated: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.r, self.J = jax.jit(self.r), jax.jit(jax.jacfwd(self.r))

    def cost(self, weights: Array) -> float:
        value = np.inf if self.wall(weights) else float(jnp.sum(self.r(jnp.asarray(weights)) ** 2))
        self.evaluated.append(value)
        return value

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        w = jnp.asarray(weights)
        J, r = np.asarray(self.J(w)), np.asarray(self.r(w))
        return self.share * J.T @ J, J.T @ r


def rosenbrock(w: jax.Array) -> jax.Array:
    return jnp.stack([10 * (w[1] - w[0] ** 2), 1 - w[0]])


def powell_singular(w: jax.Array) -> jax.Array:
    """Powell (1962): the Jacobian at the solution, zero, has rank two."""
    a, b, c, d = w
    return jnp.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


def solve(
    problem: Residuals, start: list[float], limit: int = 200, penalty: float = 0.0
) -> tuple[list[Array], Stop | None]:
    steps = LevenbergMarquardt(problem, Step(np.array(start)), penalty)
    return [s.weights for s in islice(steps, limit)], steps.stop


def test_rosenbrock():
    problem = Residuals(rosenbrock)
    path, stop = solve(problem, [-1.2, 1.0])
    np.testing.assert_allclose(path[-1], [1, 1], atol=1e-6)
    assert stop in (Stop.SLOPE, Stop.STEP, Stop.DECREASE)
    assert len(path) < 30
    assert (np.diff([problem.cost(w) for w in path]) < 0).all()


def test_powell_singular():
    """Convergence is linear here, a factor of two per step, and goes on to the end."""
    problem = Residuals(powell_singular)
    path, stop = solve(problem, [3.0, -1.0, 0.0, 1.0])
    assert problem.cost(path[-1]) < 1e-25
    assert np.abs(path[-1]).max() < 1e-5
    assert stop is not None
    assert len(path) < 100


def test_a_linear_problem_takes_a_step_or_two():
    rng = np.random.default_rng(0)
    X, y = rng.normal(size=(50, 4)), rng.normal(size=50)
    problem = Residuals(lambda w: jnp.asarray(X) @ w - y)
    steps = LevenbergMarquardt(problem, Step(np.zeros(4), 1e-9), 0.0)
    path = [s.weights for s in steps]
    np.testing.assert_allclose(path[-1], np.linalg.lstsq(X, y)[0], rtol=1e-8)
    assert len(path) <= 2
    assert steps.stop in (Stop.SLOPE, Stop.DECREASE)


def test_a_penalty_is_part_of_the_problem():
    rng = np.random.default_rng(0)
    X, y = rng.normal(size=(50, 4)), rng.normal(size=50)
    path, _ = solve(Residuals(lambda w: jnp.asarray(X) @ w - y), [1.0] * 4, penalty=30.0)
    expected = np.linalg.solve(X.T @ X + 30 * np.eye(4), X.T @ y)
    np.testing.assert_allclose(path[-1], expected, rtol=1e-5)


def test_a_flat_start_stops_by_its_slope():
    # A maximum of the error: it is stationary, and no model of second order leads away from it.
    path, stop = solve(Residuals(lambda w: jnp.cos(w) + 2), [0.0, 0.0])
    assert path == []
    assert stop is Stop.SLOPE


def test_a_solution_at_the_start_is_left_alone():
    problem = Residuals(rosenbrock)
    path, stop = solve(problem, [1.0, 1.0])
    assert path == []
    assert stop is Stop.SLOPE
    assert problem.evaluated == [0.0]


def test_steps_are_judged_by_the_model_that_they_were_made_from():
    """With a curvature of half or twice the true one the same solution comes, in more steps."""
    counts = {}
    for share in (0.4, 1.0, 4.0):
        path, _ = solve(Residuals(rosenbrock, share), [-1.2, 1.0], 500)
        np.testing.assert_allclose(path[-1], [1, 1], atol=1e-3)
        counts[share] = len(path)
    assert counts[1.0] < min(counts[0.4], counts[4.0])


def test_a_step_that_gains_next_to_nothing_of_what_was_promised_is_refused():
    # Slopes a hundred thousand times too steep promise far too much; the error still falls.
    class Wrong(Residuals):
        def normal_equations(self, weights):
            JtJ, Jtr = super().normal_equations(weights)
            return JtJ, 1e5 * Jtr

    path, stop = solve(Wrong(lambda w: w + 1e-3), [1.0])
    assert path == []
    assert stop is Stop.STUCK


def test_a_wall_is_not_crossed_and_an_infinite_start_is_told():
    problem = Residuals(rosenbrock, wall=lambda w: bool(w[0] > 0.5))
    path, stop = solve(problem, [-1.2, 1.0])
    assert all(w[0] <= 0.5 for w in path)
    assert path[-1][0] > 0.4
    assert stop is not None
    path, stop = solve(problem, [0.6, 1.0])
    assert path == []
    assert stop is Stop.NOT_FINITE


def test_where_the_caller_ends_there_is_no_reason():
    path, stop = solve(Residuals(rosenbrock), [-1.2, 1.0], limit=3)
    assert len(path) == 3
    assert stop is None


@pytest.mark.parametrize("stop", Stop)
def test_every_reason_is_a_phrase(stop):
    assert len(stop.value.split()) > 4

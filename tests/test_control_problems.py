"""Problems with known answers, by every method; orders of convergence; exact derivatives."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from benchmarks.known_problems import PROBLEMS, Known
from dfsm.control import DirectTranscription, MultipleShooting, SingleShooting, solve
from dfsm.control.guess import start_of
from dfsm.control.nlp.transcription import Transcription

# One object per problem, so that all tests share its compiled functions.
KNOWN: dict[str, Known] = {}


def known(name: str) -> Known:
    if name not in KNOWN:
        KNOWN[name] = PROBLEMS[name]()
    return KNOWN[name]


def relative_error(found: float, name: str) -> float:
    return abs(found - known(name).value) / abs(known(name).value)


@pytest.mark.parametrize("scheme", ["hermite_simpson", "radau"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_known_answers(name, scheme):
    method = DirectTranscription(scheme=scheme)
    found = solve(known(name).problem, method, known(name).guess, simulate=False)
    assert found.solved, found.message
    assert found.error <= method.refine
    assert found.violation <= 1e-7
    assert relative_error(found.objective, name) < 1e-6
    assert max(found.errors[k] for k in ("dynamics", "cost", "constraints")) <= method.refine
    # Below its tolerance the solver says nothing.
    true = max(relative_error(found.objective, name), method.tolerance)
    assert 0.1 <= max(found.errors["objective"], method.tolerance) / true <= 10
    assert found.objective == pytest.approx(found.final_cost + found.integral_cost)


@pytest.mark.parametrize(
    ("scheme", "degree", "order"),
    [("trapezoidal", 1, 2), ("hermite_simpson", 1, 4), ("radau", 2, 3), ("radau", 3, 5)],
)
def test_orders_of_convergence(scheme, degree, order):
    errors = []
    for intervals in (5, 10, 20):
        method = DirectTranscription(scheme=scheme, degree=degree, mesh=intervals, refine=None)
        found = solve(known("Hager1").problem, method, simulate=False)
        errors.append(relative_error(found.objective, "Hager1"))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (rates > order - 0.35).all(), (errors, rates)


def test_the_linear_quadratic_problem_is_recognised():
    assert solve(known("Hager1").problem, simulate=False).linear_quadratic
    assert not solve(known("Vanderpol").problem, simulate=False).linear_quadratic


def test_costates_are_the_slopes_of_the_optimal_value():
    # J*(x0, T) = x0² tanh T, so that ∂J*/∂x = 2 x tanh(T − t) along the solution.
    for scheme in ("hermite_simpson", "radau"):
        method = DirectTranscription(scheme=scheme, mesh=40)
        found = solve(known("Hager1").problem, method, simulate=False)
        costates = found.costates[0]
        x, _ = found.at(costates.time)
        expected = 2 * x[:, 0] * np.tanh(1 - costates.time)
        np.testing.assert_allclose(costates["x1"], expected, atol=2e-3)


# -- derivatives --------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["hermite_simpson", "radau"])
@pytest.mark.parametrize("name", ["HagerHouRao1", "Brachistochrone"])
def test_derivatives_agree_with_differences(name, scheme):
    problem = known(name).problem
    grid = DirectTranscription(scheme=scheme, mesh=3).grid()
    start = start_of(problem, known(name).guess, grid.tau)
    shot = Transcription(problem, grid, start)
    assert_exact(shot.program, shot.scaled(start))


def assert_exact(program, middle):
    rng = np.random.default_rng(0)
    z = middle + 0.1 * rng.standard_normal(program.n)
    lam = rng.standard_normal(program.m)
    J = dense(program.jacobian_pattern, program.jacobian(z), (program.m, program.n))
    H = dense(program.hessian_pattern, program.hessian(z, 0.7, lam), (program.n, program.n))
    H = H + np.triu(H, 1).T

    def slope(z):
        J = dense(program.jacobian_pattern, program.jacobian(z), (program.m, program.n))
        return 0.7 * program.gradient(z) + J.T @ lam

    h = 1e-6
    for i in range(program.n):
        e = h * np.eye(program.n)[i]
        column = (program.constraints(z + e) - program.constraints(z - e)) / (2 * h)
        np.testing.assert_allclose(J[:, i], column, atol=1e-7)
        change = (program.objective(z + e) - program.objective(z - e)) / (2 * h)
        assert program.gradient(z)[i] == pytest.approx(change, abs=1e-7)
        np.testing.assert_allclose(H[:, i], (slope(z + e) - slope(z - e)) / (2 * h), atol=1e-6)


def dense(pattern, values, shape):
    rows, starts = pattern
    full = np.zeros(shape)
    for column, (first, last) in enumerate(itertools.pairwise(starts)):
        full[rows[first:last], column] = values[first:last]
    return full


# -- shooting -----------------------------------------------------------------------------------

# Controls that are linear between nodes cannot follow a kink, and lag behind a curve by h².
SHOT = {
    "Hager1": 1e-7,
    "Vanderpol": 2e-4,
    "Brachistochrone": 1e-7,
    "HagerHouRao1": 1e-7,
    "TwoLinkRobot, energy": 1e-3,
}


@pytest.mark.parametrize("name", SHOT)
def test_multiple_shooting(name):
    found = solve(known(name).problem, MultipleShooting(), known(name).guess, simulate=False)
    assert found.solved, found.message
    assert relative_error(found.objective, name) < SHOT[name]


@pytest.mark.parametrize("name", ["Hager1", "Vanderpol"])
def test_single_shooting(name):
    found = solve(known(name).problem, SingleShooting(pieces=40), simulate=False)
    assert found.solved, found.message
    assert relative_error(found.objective, name) < SHOT[name]


def test_a_solution_of_one_method_starts_another():
    problem = known("Vanderpol").problem
    shot = solve(problem, MultipleShooting(), simulate=False)
    cold = solve(problem, DirectTranscription(mesh=60, refine=None), simulate=False)
    warm = solve(problem, DirectTranscription(mesh=60, refine=None), shot, simulate=False)
    again = solve(problem, DirectTranscription(mesh=60, refine=None), warm, simulate=False)
    assert warm.objective == pytest.approx(cold.objective, rel=1e-8)
    assert again.iterations < warm.iterations < cold.iterations

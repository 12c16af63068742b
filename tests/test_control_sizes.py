"""What variables are divided by: rounding tells no size, and what runs away need not be unbounded.

All optima are known: with effort ∫ u² dt a double integrator that comes back to where it began in
4 s, with its speed reversed from 1 to −1, takes u = −1/2 and costs 1.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from cart import QUICK
from dfsm.control import Ending, MultipleShooting, OptimalControlProblem, solve
from dfsm.control.nlp import ipopt
from dfsm.data.trajectory import Channel
from dfsm.simulators import ODESystem

DOUBLE = ODESystem(
    f=lambda x, u, w, p: jnp.stack([x[1], u[0]]),
    states=(Channel("x"), Channel("v")),
    controls=(Channel("u"),),
)
SPRING = ODESystem(
    f=lambda x, u, w, p: jnp.stack([x[1], u[0] - x[0] - x[1]]),
    states=(Channel("x"), Channel("v")),
    controls=(Channel("u"),),
)


def effort(s):
    return s.u.u**2


def back(**changes) -> OptimalControlProblem:
    fields = {"model": DOUBLE, "horizon": (0.0, 4.0), "cost": effort}
    fields |= {"initial": {"x": 0.0, "v": 1.0}, "final": {"x": 0.0, "v": -1.0}}
    return OptimalControlProblem(**(fields | changes))


@pytest.mark.parametrize("method", [QUICK, MultipleShooting(segments=5)])
@pytest.mark.parametrize("tiny", [float(np.sin(np.pi)), 1e-20, 1e-10, 1e-8])
def test_an_end_that_is_0_but_for_rounding_is_no_size(tiny, method):
    problem = back(initial={"x": tiny, "v": 1.0}, final={"x": tiny / 2, "v": -1.0})
    found = solve(problem, method, simulate=False)
    assert found.ending is Ending.SOLVED
    assert found.objective == pytest.approx(1.0, rel=1e-7)


def test_a_start_where_a_simulation_came_to_rest():
    # Nothing in the start is larger, so that only the solve can tell that it is no size.
    def problem(x, v):
        return OptimalControlProblem(
            model=SPRING,
            horizon=(0.0, 5.0),
            cost=lambda s: s.u.u**2 + (s.x.x - 1) ** 2,
            initial={"x": x, "v": v},
        )

    true = solve(problem(0.0, 0.0), QUICK, simulate=False).objective
    found = solve(problem(-3.6e-11, 2.0e-11), QUICK, simulate=False)
    assert found.solved, found.message
    assert found.objective == pytest.approx(true, rel=1e-8)
    assert len(found.meshes) == 2


def test_a_limit_that_touches_an_end_but_for_rounding():
    # 0.1 + 0.2 − 0.3 = 5.6e-17 is the lower limit, 0 both ends: the limit holds anyway.
    found = solve(back(bounds={"x": (0.1 + 0.2 - 0.3, None)}), QUICK, simulate=False)
    assert found.objective == pytest.approx(1.0, rel=1e-7)
    # sin² (π t / 4), in 4 s: up along the limit and down again, with ends at 0 and 1.5e-32.
    bound = {"x": (lambda t: np.sin(np.pi * t / 4) ** 2, None)}
    free = back(bounds=bound, initial={"x": 0.0}, final={"x": 0.0})
    low = solve(free, QUICK, simulate=False)
    assert low.solved, low.message
    assert low.violation < 1e-8


@pytest.mark.parametrize("kind", ["constraints", "boundary"])
def test_a_limit_of_a_constraint_that_is_rounding_is_no_size(kind):
    tiny = 0.1 + 0.2 - 0.3
    changes: dict[str, Any]
    if kind == "constraints":
        changes = {"constraints": {"above": (lambda s: s.x.x + (1 + s.x.v) / 4, tiny, None)}}
    else:
        changes = {"boundary": {"apart": (lambda a, b: a.x.v + b.x.v, tiny, tiny)}}
        changes["final"] = {"x": 0.0}
    found = solve(back(**changes), QUICK, simulate=False)
    assert found.solved, found.message
    assert found.objective == pytest.approx(1.0, rel=1e-6)


def test_a_problem_that_is_small_as_a_whole_keeps_its_sizes():
    # The same in 1e-9 of the units: nothing here is beside anything large.
    small = {"initial": {"x": 1e-9, "v": 1e-9}, "final": {"x": 1e-9, "v": -1e-9}}
    found = solve(back(**small, cost=lambda s: 1e18 * s.u.u**2), QUICK, simulate=False)
    assert found.solved, found.message
    np.testing.assert_allclose(found.trajectory["u"], -0.5e-9, rtol=1e-6)


def test_what_runs_away_while_the_objective_rises_is_not_unbounded(monkeypatch):
    monkeypatch.setattr(ipopt, "_ending", lambda _word: "unbounded")
    found = solve(back(), QUICK, simulate=False)
    assert found.ending is Ending.FAILED
    assert "runs away to" in found.reason
    assert "the objective does not fall" in found.message
    assert "falls without limit" not in found.message


def test_what_falls_without_limit_is_unbounded_from_a_tiny_start_too():
    problem = back(initial={"x": 1e-17, "v": 0.0}, final={}, cost=lambda s: s.x.x)
    found = solve(problem, QUICK, simulate=False)
    assert found.ending is Ending.UNBOUNDED
    assert found.reason.startswith("u runs away to -")


def test_a_tiny_start_that_no_step_leaves_is_no_optimum():
    # With |u| ≤ 1 the lowest ∫ x dt over 4 s is −4³/6.
    problem = back(
        initial={"x": 1e-12, "v": 0.0}, final={}, bounds={"u": (-1, 1)}, cost=lambda s: s.x.x
    )
    found = solve(problem, QUICK, simulate=False)
    assert found.objective == pytest.approx(-64 / 6, rel=1e-4)

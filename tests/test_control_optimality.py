"""Optimality conditions are measured at the result, and endings say what was measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from cart import QUICK, problem, solved
from dfsm.control import Ending, MultipleShooting, load_solution, save_solution, solve
from dfsm.control.nlp import ipopt
from dfsm.control.nlp.optimality import optimality
from dfsm.control.nlp.program import Block, Program
from dfsm.control.nlp.terms import Term
from dfsm.control.solution import HELD, Optimality

SAVED = Path(__file__).parent / "data" / "saved_by_0.1" / "solution"


def quadratic(scale=(1.0, 1.0), row_scale=1.0) -> Program:
    """(x − 2)² + (y − 1)² subject to x + y ≤ 2 and y ≥ 0: at (1.5, 0.5) with a multiplier of 1."""
    term = Term(lambda z, data, common: ((z[0] - 2) ** 2 + (z[1] - 1) ** 2)[None])
    block = Block(term, np.array([[0, 1]]), {}, {}, sparse.csr_matrix((1, 1)), np.ones(1))
    limits = tuple(map(np.array, ([-np.inf, 0.0], [np.inf, np.inf], [-np.inf], [2.0])))
    ones = sparse.csr_matrix(np.ones((1, 2)))
    return Program([block], ones, limits, np.array(scale), np.array([row_scale]), [], [])


@pytest.mark.parametrize(
    ("z", "multiplier", "bounds", "expected"),
    [
        # The solution.
        ((1.5, 0.5), 1.0, (0.0, 0.0), (0.0, 0.0, 0.0)),
        # ∂f = (−2, 0): the slope (−1, 1) is half of the objective's.
        ((1.0, 1.0), 1.0, (0.0, 0.0), (0.5, 0.0, 0.0)),
        # ∂f = (−2, −1); the constraint is 0.5 from its limit.
        ((1.0, 0.5), 1.0, (0.0, 0.0), (0.5, 0.0, 0.25)),
        # ∂f = 0, and x + y = 3.
        ((2.0, 1.0), 0.0, (0.0, 0.0), (0.0, 1.0, 0.0)),
        # A multiplier that pushes y from a limit that it does not have is none.
        ((1.5, 0.5), 1.0, (7.0, 7.0), (0.0, 0.0, 0.0)),
        # One that holds y at its lower limit, 0.5 away.
        ((1.5, 0.5), 1.0, (0.0, -0.2), (0.2, 0.0, 0.1)),
        # y below its lower limit: ∂f = (0, −4), x + y = 1, a slope of 1 and 3.
        ((2.0, -1.0), 1.0, (0.0, 0.0), (0.75, 1.0, 0.25)),
    ],
)
def test_conditions_of_a_quadratic_program_known_by_hand(z, multiplier, bounds, expected):
    measured = optimality(quadratic(), np.array(z), np.array([multiplier]), np.array(bounds))
    values = (measured.stationarity, measured.violation, measured.complementarity)
    assert values == pytest.approx(expected, abs=1e-14)
    assert measured.worst == pytest.approx(max(expected), abs=1e-14)


def test_conditions_are_those_of_the_scaled_program():
    # Variables in units of (2, 4), the constraint in units of 10: ∂f = (2·−2, 4·−1) at (1, 0.5).
    program = quadratic((2.0, 4.0), 10.0)
    measured = optimality(program, np.array([0.5, 0.125]), np.array([10.0]), np.zeros(2))
    values = (measured.stationarity, measured.violation, measured.complementarity)
    assert values == pytest.approx((2 / 4, 0.0, 0.5 / 4))
    program.objective_scale = 0.0
    measured = optimality(program, np.array([2.0, 1.0]), np.zeros(1), np.zeros(2))
    assert measured == Optimality(0.0, pytest.approx(0.6), 0.0)


def test_what_cannot_be_measured_does_not_hold():
    measured = optimality(quadratic(), np.array([np.nan, 0.0]), np.zeros(1), np.zeros(2))
    assert np.isnan(measured.stationarity)
    assert not measured.held(1.0)


@pytest.mark.parametrize("method", [QUICK, MultipleShooting(segments=5, pieces=4)])
def test_a_solution_tells_how_well_its_conditions_hold(method):
    solution = solved(problem(bounds={"force": (-1.45, 1.45)}), method)
    assert solution.ending is Ending.SOLVED
    assert solution.optimality.worst < 1e-7
    assert solution.optimality.violation == pytest.approx(solution.violation)
    assert "optimality conditions hold to" in solution.summary()
    loose = solved(problem(bounds={"force": (-1.45, 1.45)}), replace(method, tolerance=1e-3))
    assert loose.optimality.complementarity > 10 * solution.optimality.complementarity


def test_a_tolerance_below_rounding_ends_early_at_a_solution():
    tight = problem(bounds={"force": (-1.45, 1.45)})
    solution = solved(tight, replace(QUICK, tolerance=1e-17))
    assert solution.ending in (Ending.ACCEPTABLE, Ending.STALLED)
    assert solution.optimality.worst < 1e-12
    assert solution.reason.startswith("the optimality conditions hold to ")
    assert solution.objective == pytest.approx(solved(tight).objective, rel=1e-6)


def options(monkeypatch, **changes):
    original = ipopt._ipopt
    names = {f"ipopt.{name}": value for name, value in changes.items()}
    monkeypatch.setattr(ipopt, "_ipopt", lambda *a: original(*a) | names)


STALL = {"tiny_step_tol": 0.5, "tiny_step_y_tol": 1e9}
ACCEPT = {"acceptable_tol": 1.0, "acceptable_iter": 1}


@pytest.mark.parametrize(
    ("changes", "why"), [(STALL, "steps became too small"), (ACCEPT, "the solver ended early")]
)
def test_an_early_end_far_from_a_solution_is_none(monkeypatch, changes, why):
    hard = problem(cost=lambda s: s.u.force**2 * (1 + s.x.place**2), bounds={"force": (-2, 2)})
    options(monkeypatch, **changes)
    solution = solve(hard, QUICK)
    assert solution.ending is Ending.INACCURATE
    assert not solution.solved
    assert solution.replays == ()
    assert solution.optimality.worst > HELD
    assert f"{why} where the optimality conditions hold to" in solution.message
    # They would do where no more is asked for.
    assert solution.optimality.held(2 * solution.optimality.worst)


def test_early_ends_are_told_apart():
    assert ipopt._ending("Search_Direction_Becomes_Too_Small") == "stalled"
    assert ipopt._ending("Solved_To_Acceptable_Level") == "acceptable"


def test_measured_conditions_are_stored_and_old_folders_have_none(tmp_path):
    old = load_solution(SAVED)
    assert old.solved
    assert old.optimality is None
    assert "optimality conditions" not in old.summary()
    save_solution(old, tmp_path / "old")
    assert load_solution(tmp_path / "old").optimality is None
    new = replace(old, ending=Ending.STALLED, optimality=Optimality(1e-9, 2e-9, np.nan))
    save_solution(new, tmp_path / "new")
    manifest = json.loads((tmp_path / "new" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["format"] == 1
    again = load_solution(tmp_path / "new")
    assert again.ending is Ending.STALLED
    assert again.optimality.violation == 2e-9
    assert np.isnan(again.optimality.complementarity)

"""What docs/results/optimal-control.md states: tables, figure, the program in expressions."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import control, control_tables
from benchmarks.casadi_expressions import solve_with_expressions
from benchmarks.known_problems import PROBLEMS
from dfsm.control import DirectTranscription, solve

ROOT = Path(__file__).parents[1]


POWERS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")


def documented(name: str) -> list[list[str]]:
    """Rows of a table of the page, below its head."""
    text = (ROOT / "docs" / "results" / "optimal-control.md").read_text(encoding="utf-8")
    block = text.split(f"<!-- {name} -->")[1].split("<!-- end -->")[0]
    rows = [line for line in block.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


def figures(errors: list[float]) -> dict:
    """Made-up orders of all schemes on two problems."""
    found = {
        "theory": 2,
        "tolerance": 1e-8,
        "intervals": [5, 10, 20],
        "errors": errors,
        "orders": [2.0, -1.5],
    }
    return {
        f"{problem}, {scheme}": found | {"problem": problem, "scheme": scheme}
        for problem in control.SMOOTH
        for scheme in control.ORDERS
    }


# -- the page -----------------------------------------------------------------------------------


def test_the_page_has_every_problem_scheme_and_number_of_points():
    assert [row[0] for row in documented("known")] == list(PROBLEMS)
    assert len(documented("orders")) == len(control.SMOOTH) * len(control.ORDERS)
    assert [int(row[0]) for row in documented("control_speed")] == list(control.POINTS)
    assert documented("expressions")


def test_multiple_shooting_stands_where_it_was_run():
    shot = [row[0] for row in documented("known") if row[4] != "–"]
    assert sorted(shot) == sorted(control.SHOT)


# -- tables and figure --------------------------------------------------------------------------


def test_known_answers_in_a_table():
    found = {"ending": "SOLVED", "relative_error": 3.21e-8, "iterations": 7, "seconds": 0.0512}
    short = found | {"ending": "COARSE"}
    lines = control_tables.known_table(
        {"P": {"value": -0.5, "hermite_simpson": found, "radau": short}}
    )
    assert lines[2] == "| P | −0.5 | 3.2·10⁻⁸, 7, 0.051 s | coarse | – |"


def test_true_and_estimated_errors_stand_side_by_side():
    hs, radau = ({"relative_error": e, "estimate": 2 * e} for e in (1e-7, 3e-9))
    lines = control_tables.estimates_table({"P": {"hermite_simpson": hs, "radau": radau}})
    assert lines[2] == "| P | 1.0·10⁻⁷ | 2.0·10⁻⁷ | 3.0·10⁻⁹ | 6.0·10⁻⁹ |"


def test_the_documented_estimates_are_within_a_factor_of_ten():
    rows = documented("estimates")
    assert [row[0] for row in rows] == list(PROBLEMS)
    for row in rows:
        errors = [float(cell.replace("·10", "e").translate(POWERS)) for cell in row[1:]]
        for true, estimated in (errors[:2], errors[2:]):
            # Below its tolerance the solver says nothing.
            ratio = max(estimated, control.TOLERANCE) / max(true, control.TOLERANCE)
            assert 0.1 <= ratio <= 10, row


def test_orders_below_the_tolerance_are_in_brackets():
    lines = control_tables.orders_table(figures([1e-3, 1e-7, 1e-9]))
    assert lines[0] == "| problem, scheme | theory | 5 → 10 | 10 → 20 |"
    assert lines[3] == "| Hager1, Hermite–Simpson | 2 | 2.00 | (−1.50) |"


def test_the_table_of_speed_shows_how_time_grows():
    found = {"ending": "SOLVED", "iterations": 20, "ms_per_iteration": 5.0}
    slower = found | {"ending": "LIMIT", "ms_per_iteration": 50.0}
    lines = control_tables.control_speed_table({"250": found, "1000": slower})
    assert lines[2:] == [
        "| 250 | 20 | 5.00 | 20.0 | – |",
        "| 1000 | limit | 50.0 | 50.0 | 4 × the points, 10 × the time |",
    ]


def test_the_table_of_expressions_leaves_out_what_was_not_run():
    ours = {"objective": -1.0, "iterations": 10, "seconds": 0.5, "seconds_compile": 2.0}
    theirs = {"objective": -1.0, "iterations": 10, "seconds_setup": 0.3, "seconds_solve": 5.0}
    parts = dict.fromkeys(("dfsm", "dfsm, compiled", "dfsm, warm start"), ours)
    parts |= {"casadi": theirs, "casadi, compiled": None, "ms_per_iteration": {"dfsm": 50.0}}
    lines = control_tables.expressions_table(parts)
    assert lines[-1] == "| CasADi expressions | −1.0000 | 10 | 0.30 | 5.0 | 500 | 10 |"
    assert len(lines) == 6


def test_the_figure_shows_every_scheme(tmp_path):
    pytest.importorskip("matplotlib")
    from benchmarks.figures import draw_orders

    draw_orders(figures([1e-3, 1e-7, 0.0]), tmp_path / "figure.svg")
    drawn = (tmp_path / "figure.svg").read_text(encoding="utf-8")
    for text in ("trapezoidal, h²", "Radau 2, h³", "Hermite–Simpson, h⁴", "Radau 3, h⁵"):
        assert f"<!-- {text} -->" in drawn
    assert all(f"<!-- {problem}" in drawn for problem in control.SMOOTH)
    draw_orders(figures([1e-3, 1e-7, 0.0]), tmp_path / "again.svg")
    assert (tmp_path / "again.svg").read_text(encoding="utf-8") == drawn


# -- the same program in expressions ------------------------------------------------------------


def test_casadi_expressions_give_the_same_optimum():
    problem = control.turbine()
    method = DirectTranscription(scheme="trapezoidal", mesh=29, refine=None, tolerance=1e-7)
    ours = solve(problem, method, simulate=False)
    theirs = solve_with_expressions(problem, 30)
    assert ours.solved
    assert theirs["ending"] == "Solve_Succeeded"
    assert theirs["objective"] == pytest.approx(ours.objective, rel=1e-6)
    assert theirs["iterations"] == ours.iterations

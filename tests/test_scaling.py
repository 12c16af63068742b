"""Errors and costs over the number of inputs: what docs/method.md states."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import fit_tables, scaling

ROOT = Path(__file__).parents[1]

# One of ten test runs is swung further than the training runs usually are.
pytestmark = pytest.mark.filterwarnings("ignore:.*rollouts spend:dfsm.errors.DfsmWarning")

CHEAP = ("rbf, equal", "rbf, per_input")
KINDS = (scaling.LINEAR, *scaling.KINDS)
INPUTS = [3 * masses for masses in scaling.MASSES]


@pytest.fixture(scope="module")
def documented() -> list[list[str]]:
    """Rows of the tables in docs/method.md, heads included."""
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    block = text.split("<!-- scaling -->")[1].split("<!-- end -->")[0]
    rows = [line for line in block.splitlines() if line.startswith("|") and "---" not in line]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


@pytest.fixture(scope="module")
def smallest() -> dict[str, dict[str, float]]:
    """Figures of two masses and the kinds that train in seconds."""
    return scaling.chain(2, {name: scaling.KINDS[name] for name in CHEAP})["results"]


def test_the_documentation_has_every_kind_and_number_of_inputs(documented):
    errors, costs = documented[: len(KINDS) + 1], documented[len(KINDS) + 1 :]
    for head, *rows in (errors, costs):
        assert head[1:] == [f"{n} inputs" for n in INPUTS]
        assert [row[0] for row in rows] == list(KINDS)
        assert all(len(row) == len(head) for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [scaling.LINEAR, *CHEAP])
def test_two_masses_have_the_errors_of_the_documentation(documented, smallest, kind):
    cell = next(row for row in documented if row[0] == kind)[1]
    derivative, rollout = (float(v) / 100 for v in re.findall(r"([\d.]+) %", cell))
    assert smallest[kind]["derivative"] == pytest.approx(derivative, rel=0.2)
    assert smallest[kind]["rollout"] == pytest.approx(rollout, rel=0.2)
    assert smallest[kind]["completed"] == scaling.TEST


def test_the_table_says_where_nothing_was_corrected():
    found = {"derivative": 0.381, "rollout": None, "training_s": 0.034, "evaluation_ratio": None}
    lines = fit_tables.scaling_table({"16": {"inputs": 48, "results": {"mlp": found}}})
    assert lines[2] == "| mlp | 38 % / – |"
    assert lines[-1] == "| mlp | 0.03 s / – |"


def test_the_figure_shows_every_kind(tmp_path):
    pytest.importorskip("matplotlib")
    from benchmarks.figures import draw_scaling

    found = {"derivative": 0.1, "rollout": 0.1, "training_s": 1.0, "evaluation_ratio": None}
    results = dict.fromkeys(KINDS, found) | {scaling.LINEAR: found | {"evaluation_ratio": 1.0}}
    figures = {str(n): {"inputs": n, "results": results} for n in INPUTS}
    draw_scaling(figures, tmp_path / "figure.svg")
    drawn = (tmp_path / "figure.svg").read_text(encoding="utf-8")
    assert all(f"<!-- {kind} -->" in drawn for kind in KINDS)
    draw_scaling(figures, tmp_path / "again.svg")
    assert (tmp_path / "again.svg").read_text(encoding="utf-8") == drawn

"""The accuracy figures of the README are what the demo's models give."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import accuracy, derivatives, readme  # noqa: E402


def table(name: str) -> list[list[str]]:
    """Cells of a table of the README, below its head."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    block = text.split(f"<!-- {name} -->")[1].split("<!-- end -->")[0]
    rows = [line.strip("| ").split(" | ") for line in block.strip().splitlines()]
    return [[cell.strip(" |") for cell in row] for row in rows if not set(row[0]) <= set("-|")]


def agrees(stated: str, found: str) -> bool:
    """Equal up to what another processor's rounding does to a long rollout."""
    numbers = [re.findall(r"\d+\.?\d*", cell) for cell in (stated, found)]
    if len(numbers[0]) != len(numbers[1]):
        return False
    pairs = zip(*numbers, strict=True)
    return all(float(a) == pytest.approx(float(b), rel=0.03, abs=0.011) for a, b in pairs)


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_accuracy_table() -> None:
    head, *rows = table("accuracy")
    figures = accuracy.run()
    wanted_head, _, *wanted = readme.accuracy_table(figures)
    assert head == [cell.strip() for cell in wanted_head.strip("| ").split(" | ")]
    assert len(rows) == len(wanted)
    for row, line in zip(rows, wanted, strict=True):
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        assert row[0] == cells[0]
        assert all(agrees(a, b) for a, b in zip(row[1:], cells[1:], strict=True)), (row, cells)


def test_derivatives_table() -> None:
    # Eight of the 38 runs: their worst errors bound the figures stated for all from below.
    cells = {row[0]: row[1:] for row in table("derivatives")}["default (quantisation step known)"]
    rate, acceleration = ([float(x) for x in re.findall(r"\d+\.?\d*", c)] for c in cells)
    found = derivatives.run(ROOT / "examples" / "iea15", "iea15_2dof_12mps_s0[1-4]*")["worst"]
    assert isinstance(found, dict)
    assert found["dfsm_default"]["rate"] <= 1.01 * rate[1] <= 0.2
    assert found["dfsm_default"]["acceleration"] <= 1.01 * acceleration[1] <= 5.0
    assert acceleration[0] <= 4.0

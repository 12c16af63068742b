"""The accuracy figures of the documentation are what the turbine's demo gives."""

from __future__ import annotations

import re

import pytest

from benchmarks import accuracy, derivatives, fit_tables
from stated import ROOT, table

pytestmark = pytest.mark.slow


def agrees(stated: str, found: str) -> bool:
    """Equal up to what another processor's rounding does to a long rollout."""
    numbers = [re.findall(r"\d+\.?\d*", cell) for cell in (stated, found)]
    if len(numbers[0]) != len(numbers[1]):
        return False
    pairs = zip(*numbers, strict=True)
    return all(float(a) == pytest.approx(float(b), rel=0.03, abs=0.011) for a, b in pairs)


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_accuracy_table() -> None:
    """One model of a region, and the refined one for all winds."""
    head, *rows = table("accuracy")
    stated = {row[0]: row[1:] for row in rows}
    assert list(stated) == list(accuracy.demo().WINDS)
    # The region's model has all channels of the table, so the columns are the same.
    wanted_head, _, *wanted = fit_tables.accuracy_table(accuracy.run("6 m/s", "all winds"))
    assert head == [cell.strip() for cell in wanted_head.strip("| ").split(" | ")]
    for line in wanted:
        label, *cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        pairs = zip(stated[label], cells, strict=True)
        assert all(agrees(a, b) for a, b in pairs), (label, stated[label], cells)


def test_derivatives_table() -> None:
    # Eight of the 38 runs: their worst errors bound the figures stated for all from below.
    cells = {row[0]: row[1:] for row in table("derivatives")}["default (quantisation step known)"]
    rate, acceleration = ([float(x) for x in re.findall(r"\d+\.?\d*", c)] for c in cells)
    found = derivatives.run(ROOT / "examples" / "iea15", "iea15_2dof_12mps_s0[1-4]*")["worst"]
    assert isinstance(found, dict)
    assert found["dfsm_default"]["rate"] <= 1.01 * rate[1] <= 0.2
    assert found["dfsm_default"]["acceleration"] <= 1.01 * acceleration[1] <= 5.0
    assert acceleration[0] <= 4.0

"""What docs/method.md states of models with and without the mass of a robot arm's second link."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import dfsm
from benchmarks import fit_tables, parameters

ROOT = Path(__file__).parents[1]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:.*linear fit is unstable:dfsm.errors.DfsmWarning"),
]

TOLD, UNTOLD = "with m2", "without m2"


@pytest.fixture(scope="module")
def figures():
    with warnings.catch_warnings():
        # A mass beyond those trained is outside the training range, and the model says so.
        warnings.simplefilter("ignore", dfsm.DfsmWarning)
        return parameters.run()


@pytest.mark.parametrize("where", ["trained masses", "masses in between"])
def test_errors_are_those_of_another_class_than_without_the_parameter(figures, where):
    told, untold = (figures["errors"][name][where] for name in (TOLD, UNTOLD))
    assert told["completed"] == told["runs"] == 120
    assert told["derivative"] < 0.15 * untold["derivative"]
    assert told["rollout"] < 0.05 * untold["rollout"]


def test_masses_in_between_are_as_good_as_trained_ones(figures):
    found = figures["errors"][TOLD]
    assert found["masses in between"]["derivative"] < min(
        0.02, 4 * found["trained masses"]["derivative"]
    )
    assert found["masses in between"]["rollout"] < min(0.01, 2 * found["trained masses"]["rollout"])


def test_the_corrective_function_is_what_knows_the_mass(figures):
    linear = figures["errors"]["with m2, linear fit"]["masses in between"]
    assert figures["errors"][TOLD]["masses in between"]["derivative"] < 0.1 * linear["derivative"]


def test_poles_at_the_stationary_point_of_unseen_masses(figures):
    # Between the lightest and the heaviest they move by 0.32 1/s.
    assert max(p["largest_error"] for p in figures["poles"].values()) < 0.08
    fastest = [(p["true"][0], p["model"][0]) for p in figures["poles"].values()]
    true, found = np.array(fastest).T
    np.testing.assert_allclose(np.diff(found), np.diff(true), rtol=0.2)


def test_the_table_of_the_documentation(figures):
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    stated = text.split("<!-- parameters -->")[1].split("<!-- end -->")[0].strip().splitlines()
    found = fit_tables.parameters_table(figures)
    assert len(stated) == len(found)
    for row, line in zip(stated, found, strict=True):
        assert row.split("|")[1] == line.split("|")[1]
        a, b = (np.array(re.findall(r"[\d.]+(?= %)", s), dtype=float) for s in (row, line))
        # Over many training steps another processor's rounding leads to another network.
        assert (np.abs(np.log(a / b)) < np.log(2)).all(), (row, line)

"""The peer of docs/results/floating-turbine.md: inputs, judge and row, without the peer itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dfsm
from benchmarks import peer, turbine_tables
from benchmarks.accuracy import bundled
from benchmarks.rollouts import judged
from dfsm.core.files import json_value

ROOT = Path(__file__).parents[1]

START = round(peer.WARM_UP / peer.STEP)


@pytest.fixture(scope="module")
def run() -> dfsm.Trajectory:
    return bundled().runs(["06"], range(10, 11))[0]


@pytest.fixture(scope="module")
def record(run: dfsm.Trajectory) -> np.ndarray:
    """Recorded outputs from the start of rollouts on."""
    return peer.resampled(run)[1][START:]


def test_inputs_are_means_over_steps_and_outputs_their_first_values(run):
    u, y = peer.resampled(run)
    begin = bundled().START - peer.WARM_UP
    first = (run.time >= begin) & (run.time < begin + peer.STEP)
    assert u.shape == (len(y), len(peer.INPUTS) + 1)
    assert u[0, 0] == pytest.approx(run["GenTq"][first].mean())
    assert y[START, 0] == run["PtfmPitch"][run.time == bundled().START][0]
    assert y[-1, 0] == run["PtfmPitch"][-1]
    elevation = run["Wave1Elev"][run.time >= begin][:: round(peer.STEP / 0.05)]
    rate = np.diff(elevation) / peer.STEP
    assert np.corrcoef(rate, u[:-1, -1])[0, 1] > 0.98
    assert u[:, -1].std() == pytest.approx(rate.std(), rel=0.05)


def test_a_perfect_prediction_has_no_error_and_the_mean_has_one(run, record):
    perfect = peer.states(run, record, record)
    mean = peer.states(run, np.tile(record.mean(axis=0), (len(record), 1)), record)
    for values, wanted in ((perfect, 0), (mean, 1)):
        found = judged([run], [values])
        assert found["diverged"] == 0
        for name in peer.OUTPUTS:
            assert found["filtered"][name] == pytest.approx(wanted, abs=0.01)
            assert found["unfiltered"][name] == pytest.approx(wanted, abs=0.01)
        assert np.isnan(found["filtered"]["PtfmPitch_dot"])


@pytest.mark.parametrize("last", [np.nan, 1e3])
def test_a_rollout_that_diverged_is_counted_and_not_scored(run, record, last):
    gone = record.copy()
    gone[-1, 1] = last
    assert peer.states(run, gone, record) is None
    good = peer.states(run, record, record)
    found = judged([run, run], [None, good])
    assert (found["diverged"], found["of"]) == (1, 2)
    assert found["filtered"]["GenSpeed"] < 0.01


def test_the_row_has_a_dash_for_what_was_not_predicted(run, record):
    values = peer.states(run, record, record)
    found = {
        "fit_s": 99.6,
        "closed loop": judged([run], [values]),
        "perturbed": judged([run], [None]),
    }
    row = turbine_tables.rollouts_table(json_value({"models": {peer.NAME: found}}))[-1]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells == [peer.NAME, "0.00 (0.00)", "– (–)", "0.00 (0.00)", "–, –", "1 of 2", "100 s"]


def test_the_page_has_the_peer_in_the_columns_of_the_other_models():
    text = (ROOT / "docs" / "results" / "floating-turbine.md").read_text(encoding="utf-8")
    tables = [
        text.split(f"<!-- {name} -->")[1].split("<!-- end -->")[0].strip().splitlines()
        for name in ("rollouts", "peer")
    ]
    assert tables[0][:2] == tables[1][:2]
    assert [row.split(" | ")[0] for row in tables[1][2:]] == [f"| {peer.NAME}"]

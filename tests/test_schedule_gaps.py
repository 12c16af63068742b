"""Stretches of a schedule that no training run has seen are told, with where to run."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import dfsm
from systems import SCHEDULED


def told(means: tuple[float, ...], points: int) -> list[str]:
    time = np.arange(0, 30.01, 0.05)
    runs = [SCHEDULED.many(1, [(0, 1), (m, 2)], time, seed=k)[0] for k, m in enumerate(means)]
    settings = dfsm.FitSettings(
        states=(dfsm.StateSpec(name="q", order=2),),
        controls=("u",),
        disturbances=("w",),
        linear=dfsm.LPV(schedule="w", points=points),
        corrective=dfsm.NoCorrection(),
        nonlinear_only=False,
    )
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        dfsm.fit(runs, settings)
    return [str(w.message) for w in seen if "no training run operates" in str(w.message)]


def test_a_wide_gap_is_told_with_where_to_run():
    (text,) = told((2.0, 8.0), points=4)
    assert "coefficients there are interpolated" in text
    place = float(text.rsplit("at about ", 1)[1].split()[0])
    assert place == pytest.approx(5.0, abs=0.3)


def test_runs_one_spacing_apart_leave_no_gap():
    assert told((2.0, 4.0, 6.0, 8.0), points=4) == []

"""One definition of equidistant, for filters, spectra, files and pages."""

from __future__ import annotations

import numpy as np
import pytest

from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.numerics import time_mesh
from dfsm.numerics.filters import low_pass
from dfsm.numerics.spectra import spectrum
from dfsm.numerics.time_mesh import mean_over, rms_over, std_over, time_step, without_rounding

STEP = 0.00625
EXACT = STEP * np.arange(96001)


def written(time: np.ndarray, decimals: int) -> np.ndarray:
    """Times as a text file brings them back."""
    return np.array([float(f"{t:.{decimals}f}") for t in time])


EVEN = {
    "double": EXACT,
    "far from zero": 1e6 + EXACT,
    "single": EXACT.astype(np.float32).astype(float),
    # An hour in single precision is off by more than a thousandth of a step.
    "long single": (0.01 * np.arange(400000)).astype(np.float32).astype(float),
    "F10.4": written(EXACT, 4),
    "window of F10.4": written(EXACT, 4)[1234:5678] - 7.7125,
    "three decimals": written(0.0125 * np.arange(4000), 3),
    "two samples": np.array([0.0, 0.1]),
}


def moved(time: np.ndarray, steps: float) -> np.ndarray:
    """One time in the middle is early or late."""
    time = time.copy()
    time[len(time) // 2] += steps * (time[1] - time[0])
    return time


UNEVEN = {
    "gap": np.delete(EXACT, 40000),
    "gap in F10.4": np.delete(written(EXACT, 4), 40000),
    "gap at the end": np.delete(EXACT, -2),
    # Each step is a 1e-7th longer than the one before: 0.6 % longer at the end.
    "drift": STEP * np.arange(60001) * (1 + 5e-8 * np.arange(60001)),
    "drift in F10.4": written(STEP * np.arange(60001) * (1 + 5e-8 * np.arange(60001)), 4),
    "late": moved(EXACT, 0.01),
    # A decimal more than the step has: it was not rounding that moved this one.
    "late in decimals": moved(written(0.05 * np.arange(1001), 3), 0.02),
    "whole numbers": np.array([0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]),
}


@pytest.mark.parametrize("time", [pytest.param(t, id=n) for n, t in EVEN.items()])
def test_rounded_times_are_equidistant_everywhere(time):
    truth = (time[-1] - time[0]) / (len(time) - 1)
    assert time_step(time) == pytest.approx(truth, rel=1e-12)
    values = np.sin(time)
    run = Trajectory(time, values[:, None], (Channel("x"),), name="a", source="b")
    assert run.time_step == time_step(time)
    if len(time) > 2:
        spectrum(time, values)
        low_pass(time, values, 0.2)


@pytest.mark.parametrize("time", [pytest.param(t, id=n) for n, t in UNEVEN.items()])
def test_gaps_and_drifts_are_not_equidistant_anywhere(time):
    assert time_step(time) is None
    with pytest.raises(DfsmError, match="needs an equidistant time mesh"):
        spectrum(time, np.sin(time))
    with pytest.raises(DfsmError, match="needs an equidistant mesh"):
        low_pass(time, np.sin(time), 0.2)


def test_times_beyond_single_precision_are_times():
    time = 1e300 * np.arange(5)
    assert time_step(time) == pytest.approx(1e300)
    assert np.array_equal(without_rounding(time), time)


@pytest.mark.parametrize("weighted", [False, True])
def test_figures_of_many_samples_are_those_of_all_at_once(monkeypatch, weighted):
    rng = np.random.default_rng(5)
    values, weights = 7 + rng.normal(size=(1001, 3)), rng.uniform(0.5, 1.5, 1001)
    at_once = np.average(values, axis=0, weights=weights if weighted else None)
    squares = np.average((values - at_once) ** 2, axis=0, weights=weights if weighted else None)
    monkeypatch.setattr(time_mesh, "_ROWS", 100)
    told = weights if weighted else None
    np.testing.assert_allclose(mean_over(values, told), at_once, rtol=1e-13)
    np.testing.assert_allclose(std_over(values, told), np.sqrt(squares), rtol=1e-13)
    np.testing.assert_allclose(rms_over(values, told) ** 2, squares + at_once**2, rtol=1e-13)
    np.testing.assert_allclose(std_over(values[:, 0], told), np.sqrt(squares[0]), rtol=1e-13)

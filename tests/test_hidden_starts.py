"""Where searches for hidden states begin: short windows, steps per sample, and what is proposed."""

from __future__ import annotations

import numpy as np
import pytest

from dfsm.config.proposal import propose
from dfsm.data.trajectory import Trajectory
from dfsm.fitting.fit import fit
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.hidden.windows import standard_of, windows_of
from dfsm.fitting.settings import FitSettings
from dfsm.models.signals import StateSpec
from dfsm.simulation.simulate import simulate
from driven import duffing, record, swept

NOISE = (0.0, 0.01)


def shaken(step: float, band: float, seed: int, noise: tuple[float, float]) -> Trajectory:
    time = step * np.arange(1000)
    return record(duffing, [0.0, 0.0], (swept(seed, 1.2, band), False), time, noise)


@pytest.mark.parametrize(("step", "band", "most"), [(0.05, 2.0, 0.3), (0.2, 1.0, 0.05)])
def test_a_strong_spring_is_found_from_a_linear_system_that_tells_nothing(
    step: float, band: float, most: float
) -> None:
    """Rollouts over whole records lead nowhere here, nor does one step of RK4 per coarse sample."""
    settings = FitSettings(
        states=(StateSpec(name="y"),),
        disturbances=("u",),
        inputs="cubic",
        hidden=HiddenSettings(count=1, form="polynomial"),
        nonlinear_only=False,
    )
    model = fit([shaken(step, band, 1, NOISE)], settings).model
    test = shaken(step, band, 2, (0.0, 0.0))
    free = simulate(model, test, start=float(test.time[50])).trajectory
    assert len(free) == len(test) - 50
    assert np.std(free["y"] - test["y"][50:]) < most * test["y"].std()


def test_pieces_of_windows_hold_what_trains() -> None:
    run = shaken(0.05, 2.0, 1, NOISE).select(("y", "u"))
    windows = windows_of([run], standard_of([run], 1), ("linear",), 1)
    pieces = windows.pieces(40)
    assert 38 <= pieces.y.shape[1] <= 42
    assert not pieces.left_out.any()
    for k, (window, sample) in enumerate(pieces.first):
        count = int(np.count_nonzero(pieces.h[k])) + 1
        own = slice(sample, sample + count)
        np.testing.assert_array_equal(pieces.y[k, :count], windows.y[window, own])
        np.testing.assert_array_equal(pieces.used[k, :count], windows.used[window, own])
        np.testing.assert_array_equal(pieces.v[k, : count - 1], windows.v[window, own][:-1])
    # Samples where pieces meet are in both.
    ends = np.count_nonzero(np.diff(pieces.first[:, 1]) < 50)
    assert pieces.used.sum() <= windows.used.sum() + ends + 1


@pytest.mark.parametrize(("samples", "noise", "hidden"), [(10, 0.0, True), (100, 0.0, False)])
def test_few_samples_per_swing_tell_no_second_derivative(
    samples: int, noise: float, hidden: bool
) -> None:
    step = 2 * np.pi / samples
    push = swept(3, 1.0, 0.2)
    resonance = lambda t, x, u: [x[1], -x[0] - 0.2 * x[1] + u]  # noqa: E731
    time = step * np.arange(100 * samples)
    run = record(resonance, [0.0, 0.0], (push, False), time, (0.0, noise))
    proposed = propose([run], run.names, [])
    assert proposed.hidden == hidden
    assert proposed.states == [{"name": "y", "order": 1 if hidden else 2}]
    assert bool(proposed.coarse) == hidden


def test_noise_leaves_few_samples_per_swing() -> None:
    time = 2 * np.pi / 100 * np.arange(10_000)
    resonance = lambda t, x, u: [x[1], -x[0] - 0.2 * x[1] + u]  # noqa: E731
    run = record(resonance, [0.0, 0.0], (swept(3, 1.0, 0.2), False), time, (0.0, 0.02))
    proposed = propose([run], run.names, [])
    assert proposed.hidden
    assert proposed.coarse["y"] < 40

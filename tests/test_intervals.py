"""Prediction intervals: coverage on new runs, and what they refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dfsm.corrective import NoCorrection
from dfsm.derivatives import StateSpec
from dfsm.errors import DfsmError
from dfsm.fit import fit
from dfsm.intervals import calibrate
from dfsm.linear import LPV, LTI
from dfsm.samples import FitSettings
from dfsm.simulate import simulate
from dfsm.trajectory import Channel, Trajectory
from systems import wander

pytestmark = pytest.mark.filterwarnings("ignore:.*rollouts spend:dfsm.errors.DfsmWarning")

TIME = np.arange(0, 40.01, 0.1)
SETTINGS = FitSettings(
    states=(StateSpec(name="q"),),
    disturbances=("w",),
    outputs=("y",),
    linear=LPV(schedule="w", points=3, margin=0.1),
    corrective=NoCorrection(),
    nonlinear_only=False,
)


def run(seed: int) -> Trajectory:
    """q' = -q + w + a force that no channel holds, twice as strong in high winds; y = 2 q."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-2, 2)
    w, hidden = (wander(rng, m, 1.0)(TIME) for m in (mean, 0.0))
    hidden = hidden * np.where(w > 0, 2.0, 1.0)
    q = np.zeros(len(TIME))
    for k in range(len(TIME) - 1):
        q[k + 1] = q[k] + 0.1 * (-q[k] + w[k] + hidden[k])
    channels = (Channel("q", "m"), Channel("w", "m/s"), Channel("y", "m"))
    return Trajectory(TIME, np.stack([q, w, 2 * q], axis=1), channels, name=f"run{seed}")


@pytest.fixture(scope="module")
def model():
    return fit([run(seed) for seed in range(8)], SETTINGS).model


@pytest.mark.parametrize("level", [0.7, 0.9])
def test_new_runs_lie_inside_as_often_as_promised(model, level):
    found = calibrate(model, [run(seed) for seed in range(100, 160)], level=level)
    assert found.channels == ("q", "y")
    new = [run(seed) for seed in range(200, 260)]
    shares = [found.coverage(simulate(model, r), r, r) for r in new]
    np.testing.assert_allclose(np.mean(shares, axis=0), level, atol=0.05)
    # y = 2 q, and the hidden force is stronger where the wind is.
    np.testing.assert_allclose(found.half_width[:, 1], 2 * found.half_width[:, 0], rtol=0.05)
    assert found.half_width[-1, 0] > 1.3 * found.half_width[0, 0]


def test_few_runs_do_not_make_them_narrow(model):
    """With three calibration runs the mean over many draws still covers about what it says."""
    shares = []
    for draw in range(12):
        found = calibrate(model, [run(1000 + 3 * draw + k) for k in range(3)], level=0.8)
        new = run(2000 + draw)
        shares.append(found.coverage(simulate(model, new), new, new)[0])
    assert np.mean(shares) > 0.7


def test_ends_lie_around_the_rollout(model):
    found = calibrate(model, [run(seed) for seed in range(100, 104)])
    new = run(300)
    rollout = simulate(model, new)
    low, high = found.around(rollout, new)
    middle = rollout.trajectory.select(found.channels).values
    np.testing.assert_allclose((low.values + high.values) / 2, middle, atol=1e-12)
    assert (high.values > low.values).all()
    assert found.runs == tuple(f"run{k}" for k in range(100, 104))


def test_a_model_without_a_schedule():
    choices = replace(SETTINGS, linear=LTI(margin=0.1))
    model = fit([run(seed) for seed in range(8)], choices).model
    found = calibrate(model, [run(seed) for seed in range(100, 110)])
    assert found.schedule is None
    new = run(300)
    assert 0.5 < found.coverage(simulate(model, new), new, new)[0] <= 1


def test_bad_input(model):
    with pytest.raises(DfsmError, match="at least 3 runs, 2 were given"):
        calibrate(model, [run(1), run(2)])
    with pytest.raises(DfsmError, match=r"level is 1.5, expected a share between 0 and 1"):
        calibrate(model, [run(1), run(2), run(3)], level=1.5)

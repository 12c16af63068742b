"""What is said of a path that leaves the training data: channel, how far, how long, since when."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import dfsm
from dfsm.data.trajectory import Channel
from dfsm.models.departures import departures, told
from dfsm.models.region import Region
from dfsm.simulation import outcome
from systems import linear_model

CHANNELS = (Channel("Tq", "kN m"), Channel("valve", "%"), Channel("w", "rpm"))
TIME = np.arange(0.0, 10.0, 0.1)


def region() -> Region:
    """Torque and speed between -1 and 1 that are all but equal, a valve that stood at 40."""
    C = np.array([[1.0, 0.0, 0.99], [0.0, 1.0, 0.0], [0.99, 0.0, 1.0]]) / 3
    W = np.linalg.inv(np.linalg.cholesky(C))[None] / 4
    low, high = np.array([-1.0, 40.0, -1.0]), np.array([1.0, 40.0, 1.0])
    std, middle = np.array([0.6, 0.0, 0.6]), np.array([0.0, 40.0, 0.0])
    values = (low, high, middle, std, np.zeros(1), middle[None], W)
    return Region(*map(jnp.asarray, values))


def found(torque, valve=40.0, speed=0.0, **more):
    inputs = np.stack(np.broadcast_arrays(torque, valve, speed, TIME)[:3], axis=1)
    where = region()
    outside = np.asarray(where.outside(inputs))
    return departures(where, CHANNELS, TIME, inputs, outside, **more)


def test_a_path_inside_has_nothing_to_tell():
    assert found(0.5, speed=0.5) == ()
    assert told(()) == ""


def test_a_signal_beyond_its_range_is_named_with_how_far_and_how_long():
    (first,) = found(np.where(TIME > 7.45, 1.8, 0.9), speed=np.where(TIME > 7.45, 1.0, 0.9))
    assert first.channels == ("Tq",)
    assert str(first) == (
        "Tq goes to 1.8 kN m (trained -1 to 1), 25.0% of the time, first at 7.5 s"
    )
    # Each sample counts for the time that it stands for.
    weights = np.where(TIME > 7.45, 3.0, 1.0)
    (weighted,) = found(np.where(TIME > 7.45, 1.8, 0.9), speed=0.95, weights=weights)
    assert weighted.share == 0.5


def test_signals_inside_their_ranges_that_never_went_together_are_named_together():
    (first,) = found(np.where(TIME < 2.95, 0.9, 0.0), speed=np.where(TIME < 2.95, -0.9, 0.0))
    assert set(first.channels) == {"Tq", "w"}
    assert "each inside their range but go together as in no training run" in str(first)
    assert (round(first.share, 3), first.first) == (0.3, 0.0)


def test_a_control_that_stood_still_in_training_comes_first():
    """However short the time: the model has no way to know what it does."""
    constant, other = found(np.where(TIME > 3, 2.0, 0.0), valve=np.where(TIME > 9, 55.0, 40.0))
    assert constant.channels == ("valve",)
    assert constant.constant
    assert str(constant).startswith(
        "valve goes to 55 %, but was 40 in all training runs: the model cannot know what it does, "
    )
    assert other.channels == ("Tq",)
    assert told((constant, other, other, other, other)).endswith("; and 2 more")


def test_a_rollout_looks_for_departures_when_asked(monkeypatch):
    """Of thousands of rollouts somebody reads the words of a few."""
    model = linear_model(-np.eye(1), np.eye(1), span=1.0)
    values = np.where(TIME < 0.25, 1.5, 0.0)[:, None] * [1.0, 0.0]
    channels = (*model.signals.controls, *model.signals.states)
    asked = []
    monkeypatch.setattr(outcome, "departures", lambda *a: asked.append(a) or departures(*a))
    result = dfsm.simulate(model, dfsm.Trajectory(TIME, values, channels))
    assert 0 < result.outside < 0.05
    assert not asked
    (first,) = result.departures
    assert str(first).startswith("u0 goes to 1.5")
    assert result.departures is result.departures
    assert len(asked) == 1

"""What latent states remember of the time before a record begins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.models.latents import Poles, evolve, latent_state
from dfsm.models.model_folder import load_all
from dfsm.models.past import with_past
from systems import wander

STEP = 0.5
NAMES = ("wind", "stairs", "set-point")


def record(stop: float = 400.0) -> Trajectory:
    """Wind that wanders, stairs that jump at every sample, and a set-point that steps late."""
    rng, time = np.random.default_rng(2), np.arange(0, stop + STEP / 2, STEP)
    stairs = rng.integers(-3, 4, len(time)) / 2
    values = np.stack([wander(rng, 0.3, stop, 2.0)(time), stairs, time > 20.0], axis=1)
    return Trajectory(time, values, tuple(Channel(n, "-") for n in NAMES), name="record")


SAVED = Path(__file__).parent / "data" / "saved_by_0.1" / "model"
HELD = np.array([False, True, False])


def test_a_record_is_repeated_backwards_and_what_rests_has_rested():
    run = record()
    longer, count, mean = with_past(run, HELD)
    assert count == round(120 / STEP)
    assert longer.time[0] == -120.0
    np.testing.assert_array_equal(longer.values[count:], run.values)
    np.testing.assert_allclose(np.diff(longer.time), STEP)
    np.testing.assert_array_equal(longer["wind"][:count], run["wind"][count:0:-1])
    # Between -1.0 and -0.5 s the value that holds between 0.5 and 1.0 s.
    np.testing.assert_array_equal(longer["stairs"][:count], run["stairs"][count - 1 :: -1])
    assert (longer["set-point"][:count] == 0).all()
    np.testing.assert_allclose(mean, longer.values[:count].mean(axis=0), atol=0.05)


@pytest.mark.parametrize("samples", [2, 3, 30])
def test_short_records_are_repeated_as_far_as_they_go(samples):
    run = record()
    short = replace(run, time=run.time[:samples], values=run.values[:samples])
    longer, count, mean = with_past(short, HELD)
    assert (count, len(longer)) == (samples - 1, 2 * samples - 1)
    assert (np.diff(longer.time) > 0).all()
    assert np.isfinite(mean).all()


def test_slow_samples_count_by_their_number():
    run = record()
    longer, count, _ = with_past(replace(run, time=600.0 * np.arange(len(run))), HELD)
    assert count == 100
    assert longer.time[0] == -60_000.0


def test_slow_states_start_where_they_are_on_average():
    """Each of many cuts of a long record, against what the whole record leads to."""
    time = np.arange(0, 6000.0, STEP)
    noise = np.random.default_rng(0).standard_normal(len(time))
    w = np.convolve(noise, np.ones(4) / 2, mode="same")[:, None]
    slow = Poles(jnp.array([0.03]), jnp.array([0.0]), jnp.array([[1.0 + 0.0j]]), jnp.array([0.0j]))

    def path(h: np.ndarray, v: np.ndarray, rest: np.ndarray) -> np.ndarray:
        return np.asarray(evolve(slow, jnp.asarray(h), jnp.asarray(v), jnp.asarray(rest))).real

    truth = path(np.full(len(time) - 1, STEP), w, np.zeros(1))[:, 0]
    starts, at_rest = [], []
    for first in range(600, 11_000, 400):
        run = Trajectory(time[first:], w[first:], (Channel("w", "-"),))
        longer, count, mean = with_past(run, np.array([False]))
        starts.append(path(np.diff(longer.time[: count + 1]), longer.values[: count + 1], mean)[-1])
        at_rest.append(w[first, 0] / 0.03)
    spread = truth[600:].std()
    assert np.std(starts) < 1.5 * spread
    assert np.abs(starts).max() < np.abs(truth).max()
    # Under the first value, held for ever, they would start far out.
    assert np.std(at_rest) > 3 * spread


def test_what_is_missing_later_in_the_record_spoils_no_start():
    model = load_all(SAVED)["multi-fidelity"]
    rng, time = np.random.default_rng(1), np.arange(0, 200.0, STEP)
    values = np.stack([wander(rng, 0.3, 200.0, 2.0)(time) for _ in range(2)], axis=1)
    run = Trajectory(time, values, tuple(Channel(n, "-") for n in model.signals.driving))
    broken = values.copy()
    broken[100, 0] = np.nan  # at 50 s
    found = latent_state(model, replace(run, values=broken), 0.0)
    np.testing.assert_array_equal(
        found, latent_state(model, replace(run, time=time[:100], values=values[:100]), 0.0)
    )
    with pytest.raises(DfsmError, match="1 NaN or infinite samples, the first at 50 s"):
        latent_state(model, replace(run, values=broken), 60.0)

"""A rotor that stands elsewhere than where the wind is told meets it earlier or later."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.terms.rotor_place import lead_time
from dfsm.models.terms.rotor_term import RotorTerm
from rotors import rotor

UNITS = {
    "Wind": "m/s",
    "Wind_dot": "m/s^2",
    "Speed": "rpm",
    "Pitch": "deg",
    "Lean": "deg",
    "LeanRate": "deg/s",
    "Drift": "m",
    "Gust": "m/s",
    "Beam": "kN",
}
CHANNELS = {name: Channel(name, unit) for name, unit in UNITS.items()}
COLUMNS = {name: i for i, name in enumerate(UNITS)}
PLACE = {
    "hub_height": 150.0,
    "pitch_rate": "LeanRate",
    "overhang": 12.0,
    "wind_rate": "Wind_dot",
    "platform_pitch": "Lean",
    "surge": "Drift",
    "corrections": ("Gust",),
}
RNG = np.random.default_rng(0)


def term(**changes) -> RotorTerm:
    return rotor(**(PLACE | changes)).term(CHANNELS, COLUMNS)


def inputs(count: int) -> np.ndarray:
    low, high = [4, -0.3, 2, 0, -3, -0.5, -10, -1, 0], [25, 0.3, 9, 25, 8, 0.5, 15, 1, 0]
    return RNG.uniform(low, high, (count, len(UNITS)))


def test_the_wind_is_met_where_the_rotor_stands():
    """Of a slow wave of wind that moves past at its mean speed."""
    mean, omega, overhang, lean, drift = 8.0, 2 * np.pi / 120, 12.0, 3.0, 4.0
    time = np.linspace(0, 240, 400)
    wind = mean + 1.2 * np.sin(omega * time)
    rows = np.zeros((len(time), len(UNITS)))
    rows[:, COLUMNS["Wind"]], rows[:, COLUMNS["Speed"]] = wind, 6.0
    rows[:, COLUMNS["Wind_dot"]] = 1.2 * omega * np.cos(omega * time)
    rows[:, COLUMNS["Lean"]], rows[:, COLUMNS["Drift"]] = lean, drift
    one = term()
    at = np.array(one.columns)
    (found, *_) = one.inflow(jnp.asarray(rows[:, at]))
    tau = (overhang - 150 * np.deg2rad(lean) - drift) / mean
    met = mean + 1.2 * np.sin(omega * (time + tau))
    # To second order in ωτ, and as far as the wind is its mean.
    assert np.abs(found - met).max() < 0.2 * np.abs(wind - met).max()


def test_a_lead_is_bounded_and_smooth():
    distance = jnp.linspace(-400, 400, 101)
    calm, strong = lead_time(distance, jnp.zeros(())), lead_time(distance, jnp.asarray(20.0))
    assert np.abs(calm).max() <= 6.0
    near = np.abs(distance) < 20
    assert_allclose(strong[near], distance[near] / 20, rtol=0.02, atol=1e-12)
    slopes = jax.vmap(jax.grad(lambda d: lead_time(d, jnp.asarray(5.0))))(distance)
    assert (np.asarray(slopes) > 0).all()


@pytest.mark.parametrize("without", [(), ("platform_pitch",), ("surge",)])
def test_stages_folders_and_slopes_know_of_it(without):
    one = term(**dict.fromkeys(without))
    again = RotorTerm.restored(one.columns, one.channels, one.arrays(), one.structure())
    signals = jnp.asarray(inputs(40)[:, np.array(one.columns)])
    expected = np.asarray(jax.vmap(one.values)(signals))
    assert_allclose(jax.vmap(again.values)(signals), expected, rtol=0)
    ready = one.staged()
    assert_allclose(jax.vmap(lambda row: ready.of_numbers(list(row)))(signals), expected, rtol=1e-9)

    still = term(overhang=None, wind_rate=None, platform_pitch=None, surge=None)
    rest = jnp.asarray(inputs(40)[:, np.array(still.columns)])
    assert np.abs(np.asarray(jax.vmap(still.values)(rest)) - expected).max() > 1.0

    row, way, h = signals[0], jnp.asarray(RNG.normal(size=signals.shape[1])), 1e-5
    slope = jax.jvp(one.values, (row,), (way,))[1]
    around = (one.values(row + h * way) - one.values(row - h * way)) / (2 * h)
    assert_allclose(slope, around, rtol=1e-5)


def test_a_model_made_before_stands_where_the_wind_is_told():
    one = term(overhang=None, wind_rate=None, platform_pitch=None, surge=None)
    told = one.structure()
    for key in ("overhang", "lean", "drifts"):
        del told["about"][key]
    again = RotorTerm.restored(one.columns, one.channels, one.arrays(), told)
    assert again.about == one.about


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"overhang": float("inf")}, "rotor.overhang is inf, expected a number of m"),
        ({"wind_rate": None}, "rotor.overhang is 12.0 without rotor.wind_rate"),
        ({"overhang": None}, "rotor.wind_rate is Wind_dot without rotor.overhang"),
        (
            {"overhang": None, "wind_rate": None},
            "rotor.platform_pitch is 'Lean' without rotor.overhang and rotor.wind_rate",
        ),
        (
            {"hub_height": None, "pitch_rate": None},
            "rotor.platform_pitch is 'Lean' without rotor.hub_height",
        ),
        ({"wind_rate": "Beam"}, "its wind_rate 'Beam' is in 'kN', expected m/s^2"),
        ({"surge": "Beam"}, "its surge 'Beam' is in 'kN', expected m"),
        ({"platform_pitch": "Beam"}, "its platform_pitch 'Beam' is in 'kN', expected rad or deg"),
    ],
)
def test_places_that_are_refused(changes, message):
    with pytest.raises(DfsmError, match=re.escape(message)):
        term(**changes)

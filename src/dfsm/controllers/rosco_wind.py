"""ROSCO's estimators of the wind: a filtered measurement, immersion and invariance, Kalman filter.

Sources: N. J. Abbas and others, "A reference open-source controller for fixed and floating offshore
wind turbines", Wind Energ. Sci. 7, 2022; R. Ortega and others, "On line estimation of wind speed",
2013; T. Knudsen and others, "Prediction models for wind speed at turbine locations", 2011.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.rosco_blocks import (
    FilterState,
    at_least,
    filtered,
    lookup,
    lookup_2,
    low_pass,
    settled,
)
from dfsm.controllers.rosco_deck import Power

Parameters = Mapping[str, jax.Array]

# Constants of ROSCO: turbulence intensity, variance of the speed's noise (rad/s)², of the model's
# rotor speed, and growth of the mean wind's variance (m/s)² in s.
_INTENSITY, _NOISE, _MODEL, _DRIFT = 0.18, 0.02, 1e-5, 4 / 600
_LEAST_WIND = 3.0


class Kalman(NamedTuple):
    """Rotor speed in rad/s, turbulent and mean wind in m/s; gain; covariance's upper triangle."""

    speed: jax.Array
    turbulent: jax.Array
    mean: jax.Array
    gain: tuple[jax.Array, jax.Array, jax.Array]
    covariance: tuple[jax.Array, ...]


class Estimator(NamedTuple):
    """State of an estimator.

    Attributes
    ----------
    wind
        Estimate in m/s.
    working
        Whether its inputs were within their bounds; otherwise the filtered measurement is taken.
    hub
        Of the filter on the measured wind.
    inner
        Of the estimator itself: `Kalman`, the integral of immersion and invariance, or nothing.
    """

    wind: jax.Array
    working: jax.Array
    hub: FilterState
    inner: Any


class Seen(NamedTuple):
    """Inputs of an estimator: filtered speed of the rotor, pitch, torques, wind; SI units."""

    speed: jax.Array
    pitch: jax.Array
    torque: jax.Array
    torque_filtered: jax.Array
    wind: jax.Array


def started(
    mode: int, p: Parameters, seen: Seen, power: Power | None, interval: float
) -> Estimator:
    """State after ROSCO's start call."""
    hub = low_pass(p["F_WECornerFreq"] / 10, interval)
    inner = None
    wind = seen.wind
    working = _working(p, seen, power) if mode else jnp.asarray(True)
    if mode == 1:
        inner = wind - p["WE_Gamma"] * seen.speed
        moved, found = _immersed(p, inner, wind, seen, power, interval)
        inner = jnp.where(working, moved, inner)
        wind = jnp.where(working, found, wind)
    elif mode == 2:
        inner = _kalman_started(seen, wind)
        wind = jnp.where(working, inner.mean, wind)
    return Estimator(wind, working, settled(hub, seen.wind, seen.wind), inner)


def estimated(
    mode: int, p: Parameters, state: Estimator, seen: Seen, power: Power | None, interval: float
) -> Estimator:
    """State after one step."""
    filter_ = low_pass(p["F_WECornerFreq"] / 10, interval)
    if mode == 0:
        hub, wind = filtered(filter_, state.hub, seen.wind)
        return Estimator(wind, state.working, hub, None)
    working = _working(p, seen, power)
    # Whenever it begins or ends to work, the filter starts from the estimate.
    turned = working != state.working
    anew = settled(filter_, state.wind, state.wind)
    before = jax.tree.map(lambda a, b: jnp.where(turned, a, b), anew, state.hub)
    hub, measured = filtered(filter_, before, seen.wind)
    if mode == 1:
        inner, found = _immersed(p, state.inner, state.wind, seen, power, interval)
    else:
        on = _kalman_moved(p, state, seen, power, interval)
        new = _kalman_started(seen, measured)
        inner = jax.tree.map(lambda a, b: jnp.where(turned, a, b), new, on)
        found = inner.mean + inner.turbulent
    inner = jax.tree.map(lambda a, b: jnp.where(working, a, b), inner, state.inner)
    return Estimator(jnp.where(working, found, measured), working, hub, inner)


def _working(p: Parameters, seen: Seen, power: Power | None) -> jax.Array:
    """Whether pitch, torque and speed are where the rotor's table and the model hold."""
    assert power is not None
    highest = power.pitch[-1] * (np.pi / 180)
    within = (seen.pitch >= p["PC_MinPit"]) & (seen.pitch <= highest)
    slowest = 0.25 * p["VS_MinOMSpd"] / p["WE_GearboxRatio"]
    return within & (seen.torque_filtered >= 1e-4 * p["VS_RtTq"]) & (seen.speed >= slowest)


def _coefficient(p: Parameters, power: Power | None, seen: Seen, wind: jax.Array) -> jax.Array:
    assert power is not None
    ratio = seen.speed * p["WE_BladeRadius"] / wind
    return lookup_2(*power, (ratio, seen.pitch * (180 / np.pi)))


def _immersed(
    p: Parameters,
    integral: jax.Array,
    wind: jax.Array,
    seen: Seen,
    power: Power | None,
    interval: float,
) -> tuple[jax.Array, jax.Array]:
    """Next integral and estimate of immersion and invariance."""
    air = 0.5 * p["WE_RhoAir"] * np.pi * p["WE_BladeRadius"] ** 2
    cp = _coefficient(p, power, seen, wind)
    driving = at_least(air * wind**3 / seen.speed * cp, 0.0)
    rate = p["WE_Gamma"] / p["WE_Jtot"] * (seen.torque * p["WE_GearboxRatio"] - driving)
    integral = integral + rate * interval
    return integral, integral + p["WE_Gamma"] * seen.speed


def _kalman_started(seen: Seen, wind: jax.Array) -> Kalman:
    zero, small = jnp.zeros_like(wind), jnp.full_like(wind, 0.01)
    covariance = (small, zero, zero, small, zero, jnp.ones_like(wind))
    return Kalman(seen.speed, zero, at_least(wind, _LEAST_WIND), (zero, zero, zero), covariance)


def _kalman_moved(
    p: Parameters, state: Estimator, seen: Seen, power: Power | None, interval: float
) -> Kalman:
    """One step: predict by explicit Euler, then correct by the rotor's speed.

    As in ROSCO, the correction compares the measured speed with the estimate before the
    prediction, and the covariance is predicted with the last correction's gain.
    """
    last: Kalman = state.inner
    wind = last.mean + last.turbulent
    length = 6 * p["WE_BladeRadius"]
    inertia = p["WE_Jtot"]
    air = 0.5 * p["WE_RhoAir"] * np.pi * p["WE_BladeRadius"] ** 2
    cp = at_least(_coefficient(p, power, seen, wind), 0.0)
    # Jacobian of (speed, turbulent, mean).
    pole = lookup(p["WE_FOPoles_v"], p["WE_FOPoles"], wind)
    # The speed itself may become negative, what is divided by and compared with it may not.
    turning = at_least(last.speed, np.finfo(float).eps)
    push = air * 3 * cp * wind**2 / (inertia * turning)
    decay, shift = -np.pi * last.mean / (2 * length), -np.pi * last.turbulent / (2 * length)
    p11, p12, p13, p22, p23, p33 = last.covariance
    f11 = pole * p11 + push * (p12 + p13)
    f12 = pole * p12 + push * (p22 + p23)
    f13 = pole * p13 + push * (p23 + p33)
    f21, f22, f23 = decay * p12 + shift * p13, decay * p22 + shift * p23, decay * p23 + shift * p33
    swing = np.pi * last.mean**3 * _INTENSITY**2 / length
    k1, k2, k3 = last.gain
    p11 = p11 + interval * (2 * f11 + _MODEL - _NOISE * k1 * k1)
    p12 = p12 + interval * (f12 + f21 - _NOISE * k1 * k2)
    p13 = p13 + interval * (f13 - _NOISE * k1 * k3)
    p22 = p22 + interval * (2 * f22 + swing - _NOISE * k2 * k2)
    p23 = p23 + interval * (f23 - _NOISE * k2 * k3)
    p33 = p33 + interval * (_DRIFT - _NOISE * k3 * k3)
    driving = at_least(air * wind**3 / seen.speed * cp, 0.0)
    braking = p["WE_GearboxRatio"] * seen.torque_filtered
    speed = last.speed + interval * (driving - braking) / inertia
    turbulent = last.turbulent + interval * decay * last.turbulent
    k1, k2, k3 = (c / (p11 + _NOISE) for c in (p11, p12, p13))
    missed = seen.speed - turning
    covariance = (
        *(p11 - k1 * p11, p12 - k1 * p12, p13 - k1 * p13),
        *(p22 - k2 * p12, p23 - k2 * p13, p33 - k3 * p13),
    )
    speed, turbulent, mean = speed + k1 * missed, turbulent + k2 * missed, last.mean + k3 * missed
    # An estimate that is lost is the measured wind from then on.
    lost = jnp.isnan(turbulent + mean)
    return Kalman(
        jnp.where(lost, seen.speed, speed),
        jnp.where(lost, 0.0, turbulent),
        jnp.where(lost, seen.wind, mean),
        (k1, k2, k3),
        covariance,
    )

"""When the wind reaches a rotor that does not stand where the wind is told.

A field of wind moves past with its mean speed (Taylor's hypothesis), and is told at the tower's
place at rest. The rotor stands upwind of that by its overhang, and downwind by as much as the
platform leans and drifts, so that it meets at time t what is told at

    t + τ,    τ = (overhang - hub_height · platform_pitch - surge) / wind ,

which is t to first order: wind(t + τ) = wind + τ · wind_rate. At 6 m/s and 12 m of overhang that is
two seconds.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

# Towards this time in s the lead levels off, and below this wind in m/s it grows no more: farther
# ahead the rate tells nothing of the wind.
_LONGEST, _CALM = 6.0, 1.0


def lead_time(distance: jax.Array, wind: jax.Array) -> jax.Array:
    """τ in s of a rotor so many m upwind of where the wind in m/s is told."""
    return _LONGEST * jnp.tanh(distance / jnp.sqrt(wind**2 + _CALM**2) / _LONGEST)

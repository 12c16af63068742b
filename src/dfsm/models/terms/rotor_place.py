"""When the wind reaches a rotor that does not stand where the wind is told.

A field of wind moves past with its mean speed (Taylor's hypothesis), and is told at the tower's
place at rest. The rotor stands upwind of that by its overhang, and downwind by as much as the
platform leans and drifts, so that it meets at time t what is told at

    t + τ,    τ = (overhang - hub_height · platform_pitch - surge) / wind .

At 6 m/s and 12 m of overhang that is two seconds. The wind then lies on the line through those now
and some seconds ahead, which adds no roughness to it as its rate would.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

# How many times the seconds ahead the line is followed at most, and the wind in m/s below which the
# time grows no more.
_FARTHEST, _CALM = 3.0, 1.0


def share_ahead(distance: jax.Array, wind: jax.Array, lead: float) -> jax.Array:
    """How far towards the wind ahead the one at the rotor is: τ over the seconds ahead.

    Parameters
    ----------
    distance
        In m, by which the rotor stands upwind of where the wind is told.
    wind
        In m/s.
    lead
        Seconds ahead.
    """
    share = distance / (lead * jnp.sqrt(wind**2 + _CALM**2))
    return _FARTHEST * jnp.tanh(share / _FARTHEST)

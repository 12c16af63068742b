"""Dynamic inflow: the induced velocity of a rotor follows its thrust with two lags.

A table of coefficients holds what a rotor gives when its wake has settled. Blades see the wind less
the induced velocity, which needs the time in which some rotor radii of wind go by to change. With v
the undisturbed wind, W the induced velocity, a(Ct) the induction of momentum theory and Z the part
of W that is slow,

    Ż = (a v - Z) / τ                        τ = c · 1.1 R / (v - 1.3 a v)
    Ẇ = (k a v + (1 - k) Z - W) / (q τ)      k = 0.6, q = 0.25

(Øye 1990, as in Hansen, Aerodynamics of Wind Turbines, Sec. 9.3, q at three quarters of the radius;
c, k and q are learnt). Where there is one state alone, as in models made before there were two,
it is Z, and W = k a v + (1 - k) Z. The table is read at the wind v* at which the settled rotor,
turning as it does now, would have the inflow v - W that its blades have now: (1 - a*) v* = v - W.
To first order

    v* = v + (a v - W) / s        s = ∂/∂v [(1 - a) v]

so that a steady state has exactly the table's forces.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array
from dfsm.models.terms.rotor_surface import Grid, at_knots, interpolating, surface

# a = k1 Ct + k2 Ct² + k3 Ct³, which follows momentum theory where that holds and measured rotors
# beyond (Madsen et al. 2020, Wind Energy Science 5, 1-27, Eq. 3; for |Ct| up to 2.5).
_MADSEN, _LARGEST_CT = (0.251163, 0.054496, 0.089207), 2.5
# Towards this size an induction levels off.
_LARGEST_A = 0.8
# Below this slope the inflow no longer tells the wind.
_LEAST_SLOPE, _BEND = 0.3, 0.1
# Sin of the inflow's angle below which there is less and less induction; tables end above 0.4.
_CALM = 0.15
# Largest |v* - v| and least speed at which a wake moves on, as shares of the wind, and what the
# speed of the tips adds to that wind where it dies away.
_FARTHEST, _SLOWEST, _TIPS = 0.5, 0.35, 0.02
_SMALL = 1e-2  # m/s
# The learnt factor c stays between 1 / this and this, and so does that of q; k at first with one
# state and with two, q at first.
_PACE = np.log(4.0)
_SHARE = {1: 0.4, 2: 0.6}
_QUICK = 0.25


def make_induction(weights: Array, grid: Grid) -> Array:
    """Splines of a and s, shape ``(2, cell + 3, pitch cell + 3)``, from those of the forces.

    Parameters
    ----------
    weights, grid
        See `surface`; the first of the splines is thrust.
    """
    thrust = at_knots(np.asarray(weights)[0])
    angle = np.linspace(-np.pi / 2, np.pi / 2, len(thrust))
    sine = np.maximum(np.sin(angle), 0.0)[:, None]
    share = sine**2 / (sine**4 + _CALM**4)
    coefficient = np.clip(thrust * grid.stretch**2 * share, -_LARGEST_CT, _LARGEST_CT)
    a = sum(k * coefficient ** (n + 1) for n, k in enumerate(_MADSEN))
    a = np.asarray(a / (1 + (np.abs(a) / _LARGEST_A) ** 8) ** (1 / 8))
    turning = (np.sin(angle) * np.cos(angle))[:, None]
    slope = 1 - a - turning * np.gradient(a, angle, axis=0)
    apart = slope - _LEAST_SLOPE
    slope = (slope + _LEAST_SLOPE + np.sqrt(apart**2 + _BEND**2)) / 2
    return np.stack([interpolating(interpolating(v, axis=0), axis=1) for v in (a, slope)])


def settled(
    weights: jax.Array, grid: Grid, wind: jax.Array, tips: jax.Array, pitch: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Induced velocity in m/s of a wake that has settled, and s; see `surface`."""
    a, slope = surface(weights, grid, wind, tips, pitch)
    return a * wind, slope


def wind_of_inflow(
    wind: jax.Array, tips: jax.Array, missing: jax.Array, slope: jax.Array
) -> jax.Array:
    """v* in m/s at which the table is read.

    Parameters
    ----------
    wind, tips
        v and the speed of the tips in m/s.
    missing, slope
        a v - W and s.
    """
    size = _FARTHEST * jnp.sqrt(wind**2 + (_TIPS * tips) ** 2 + _SMALL**2)
    share = missing / slope / size
    return wind + size * share / jnp.sqrt(jnp.sqrt(1 + share**4))


def lag(
    radius: float, wind: jax.Array, tips: jax.Array, induced: jax.Array, pace: jax.Array
) -> jax.Array:
    """τ in s; `induced` is a v, `pace` what is learnt of c, k and q, 0 for their first values."""
    least = (_SLOWEST * wind) ** 4 + (_TIPS * tips) ** 4 + _SMALL**4
    speed = jnp.sqrt(jnp.sqrt((wind - 1.3 * induced) ** 4 + least))
    return 1.1 * radius * jnp.exp(_PACE * jnp.tanh(pace[0])) / speed


def share_at_once(pace: jax.Array, states: int) -> jax.Array:
    """k, with one state or two."""
    first = _SHARE[states]
    return jax.nn.sigmoid(pace[1] + np.log(first / (1 - first)))


def quickness(pace: jax.Array) -> jax.Array:
    """q, of two states."""
    return _QUICK * jnp.exp(_PACE * jnp.tanh(pace[2]))


def moving_wake(
    still: jax.Array, first: jax.Array, states: jax.Array, pace: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """What a v - W is in m/s, and the rates of the states in m/s².

    Parameters
    ----------
    still, first
        a v and τ.
    states
        Z alone, or W and Z, shape ``(state,)``.
    pace
        See `lag`.
    """
    slow, k = states[-1], share_at_once(pace, len(states))
    between = k * still + (1 - k) * slow
    rate = (still - slow) / first
    if len(states) == 1:
        return still - between, rate[None]
    now = states[0]
    return still - now, jnp.stack([(between - now) / (quickness(pace) * first), rate])

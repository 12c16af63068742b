"""Two planar robot arms with two links, whose equations are known.

The one with gravity is the running example of the paper (f₂ in Sec. 3). It is a double pendulum and
chaotic under open-loop torques: use it for derivatives, poles and short rollouts. The one without
gravity stays predictable over its 3 s manoeuvre: use it for long rollouts and optimal control.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Channel
from dfsm.simulators.ode import ODESystem

# Moments of inertia in kg m², gravity in m/s², lengths in m, masses in kg.
_J1, _J2, _GRAVITY, _L1, _L2, _M1, _M2 = 0.12, 0.15, 9.81, 0.6, 0.8, 3.0, 2.5


def two_link_robot_with_gravity(vary_mass: bool = False) -> ODESystem:
    """The paper's arm in a vertical plane (Hendricks 2008, Example 2.10).

    With θ2 counted from the first link, l1 = 0.6 m, l2 = 0.8 m, m1 = 3 kg, m2 = 2.5 kg,
    J1 = 0.12 kg m², J2 = 0.15 kg m², g = 9.81 m/s²:

        M11 = m1 l1²/4 + J1 + m2 (l1² + l2²/4 + l1 l2 cos θ2) + J2
        M12 = m2 (l2²/4 + l1 l2 cos θ2 / 2) + J2            M22 = m2 l2²/4 + J2
        h = m2 l1 l2 sin θ2 / 2        G2 = m2 g l2 cos(θ1 + θ2) / 2
        G1 = m1 g l1 cos θ1 / 2 + m2 g l1 cos θ1 + G2

        M11 θ̈1 + M12 θ̈2 = τ1 + h θ̇2 (2 θ̇1 + θ̇2) − G1
        M12 θ̈1 + M22 θ̈2 = τ2 − h θ̇1² − G2

    At rest for ξ = [0.7854, 0, −0.5236, 0] and u = [26.1239, 9.4757] (to 4e-4), with the poles
    ±4.9329 and ±1.9881 per second; the paper's, ±5.2160 and ±2.6533, belong to this ξ and u = 0.

    Parameters
    ----------
    vary_mass
        Makes the mass of the second link a parameter ``m2`` (kg) instead of 2.5 kg.

    Returns
    -------
    ODESystem
        States ``theta1`` (rad), ``theta1_rate`` (rad/s), ``theta2``, ``theta2_rate``; controls
        ``tau1``, ``tau2`` (N m).
    """
    return ODESystem(
        f=_with_mass if vary_mass else _with_gravity,
        states=(
            Channel("theta1", "rad"),
            Channel("theta1_rate", "rad/s"),
            Channel("theta2", "rad"),
            Channel("theta2_rate", "rad/s"),
        ),
        controls=(Channel("tau1", "N m"), Channel("tau2", "N m")),
        parameters=(Channel("m2", "kg"),) if vary_mass else (),
        name="two-link robot with gravity",
    )


def holding_torques(
    robot: ODESystem, state: Sequence[float] | Array, parameters: Sequence[float] | Array = ()
) -> Array:
    """Torques that hold the arm with gravity where it rests, in N m, shape ``(2,)``.

    Its accelerations are affine in the torques, so that one step from none is exact.

    Parameters
    ----------
    robot
        From `two_link_robot_with_gravity`.
    state
        Its states, the rates zero.
    parameters
        The mass of the second link in kg, if it varies.
    """
    x, p = (np.array(values, dtype=float) for values in (state, parameters))
    point = (x, np.zeros(2), np.zeros(0), p)
    left = np.asarray(robot.f(*point))[[1, 3]]
    return -np.linalg.solve(robot.jacobians(*point)[1][[1, 3]], left)


def _with_gravity(x: jax.Array, u: jax.Array, w: jax.Array, _p: jax.Array) -> jax.Array:
    return _with_mass(x, u, w, jnp.array([_M2]))


def _with_mass(x: jax.Array, u: jax.Array, _w: jax.Array, p: jax.Array) -> jax.Array:
    (theta1, rate1, theta2, rate2), m2 = x, p[0]
    coupling = m2 * _L1 * _L2 * jnp.cos(theta2)
    own = m2 * _L2**2 / 4 + _J2
    M11 = _M1 * _L1**2 / 4 + _J1 + m2 * _L1**2 + own + coupling
    M12 = own + coupling / 2
    M22 = own
    h = m2 * _L1 * _L2 * jnp.sin(theta2) / 2
    G2 = m2 * _GRAVITY * _L2 * jnp.cos(theta1 + theta2) / 2
    G1 = (_M1 / 2 + m2) * _GRAVITY * _L1 * jnp.cos(theta1) + G2
    right1 = u[0] + h * rate2 * (2 * rate1 + rate2) - G1
    right2 = u[1] - h * rate1**2 - G2
    determinant = M11 * M22 - M12**2
    acceleration1 = (M22 * right1 - M12 * right2) / determinant
    acceleration2 = (M11 * right2 - M12 * right1) / determinant
    return jnp.stack([rate1, acceleration1, rate2, acceleration2])


def two_link_robot() -> ODESystem:
    """An arm in a horizontal plane, in dimensionless torques |u| ≤ 1 (Luus 2019, Sec. 12.4.2).

        d = 31/36 + 9/4 sin² θ2
        ω̇1 = ( sin θ2 (9/4 cos θ2 ω1² + 2 ω2²) + 4/3 (u1 − u2) − 3/2 cos θ2 u2 ) / d
        ω̇2 = −( sin θ2 (7/2 ω1² + 9/4 cos θ2 ω2²) − 7/3 u2 + 3/2 cos θ2 (u1 − u2) ) / d
        θ̇2 = ω2 − ω1        θ̇1 = ω1

    ω2 is the speed of the second link in space, θ2 the angle between the links. At rest wherever
    ω = 0 and u = 0, with all four poles at zero. From ξ = (0, 0, 0.5, 0) to (0, 0, 0.5, 0.522) the
    shortest time is 2.98228 s, with torques that switch between their bounds.

    Returns
    -------
    ODESystem
        States ``omega1``, ``omega2`` (rad/s), ``theta2``, ``theta1`` (rad); controls ``tau1``,
        ``tau2``.
    """
    return ODESystem(
        f=_without_gravity,
        states=(
            Channel("omega1", "rad/s"),
            Channel("omega2", "rad/s"),
            Channel("theta2", "rad"),
            Channel("theta1", "rad"),
        ),
        controls=(Channel("tau1", "-"), Channel("tau2", "-")),
        name="two-link robot",
    )


def _without_gravity(x: jax.Array, u: jax.Array, _w: jax.Array, _p: jax.Array) -> jax.Array:
    omega1, omega2, theta2, _ = x
    sine, cosine = jnp.sin(theta2), jnp.cos(theta2)
    d = 31 / 36 + 9 / 4 * sine**2
    push = u[0] - u[1]
    first = sine * (9 / 4 * cosine * omega1**2 + 2 * omega2**2)
    second = sine * (7 / 2 * omega1**2 + 9 / 4 * cosine * omega2**2)
    return jnp.stack(
        [
            (first + 4 / 3 * push - 3 / 2 * cosine * u[1]) / d,
            -(second - 7 / 3 * u[1] + 3 / 2 * cosine * push) / d,
            omega2 - omega1,
            omega1,
        ]
    )

"""A chain of masses between two walls: as many states as wanted, for studies of scaling."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dfsm.core.settings import require
from dfsm.data.trajectory import Channel
from dfsm.simulators.ode import ODESystem

_STIFFNESS = 1.0  # N/m
_HARDENING = 0.5  # N/m³
_DAMPING = 0.1  # N s/m


def mass_chain(masses: int) -> ODESystem:
    """Masses of 1 kg in a row between two walls, with a force on each.

    Each mass is joined to its neighbours (the first and the last to a wall) by a hardening spring
    and has a light damper to the ground:

        q̈ᵢ = uᵢ + S(qᵢ₊₁ − qᵢ) − S(qᵢ − qᵢ₋₁) − 0.1 q̇ᵢ,   S(d) = d + 0.5 d³,   q₀ = qₙ₊₁ = 0

    Parameters
    ----------
    masses
        Number n of masses.

    Returns
    -------
    ODESystem
        States ``q1`` … ``qn`` (m), ``v1`` … ``vn`` (m/s), controls ``u1`` … ``un`` (N). At rest in
        zero, and stable.

    Raises
    ------
    DfsmError
        Fewer than one mass.
    """
    require(masses >= 1, "masses", masses, "at least 1")
    order = range(1, masses + 1)
    return ODESystem(
        f=_derivative,
        states=(
            *(Channel(f"q{i}", "m") for i in order),
            *(Channel(f"v{i}", "m/s") for i in order),
        ),
        controls=tuple(Channel(f"u{i}", "N") for i in order),
        name=f"chain of {masses} masses",
    )


def _derivative(x: jax.Array, u: jax.Array, _w: jax.Array, _p: jax.Array) -> jax.Array:
    q, v = jnp.split(x, 2)
    stretch = jnp.diff(q, prepend=0.0, append=0.0)
    force = _STIFFNESS * stretch + _HARDENING * stretch**3
    return jnp.concatenate([v, u + jnp.diff(force) - _DAMPING * v])

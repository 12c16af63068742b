"""Blade-passing loads: what blades meet that turn in a wind field, as a part of ĝ.

Over a ring of radius r the field is u(α) = Re Σₙ q_n e^{inα} with q_n = Cn - i Sn, q_0 = U. A blade
at α = d ψ, d = ±1 the direction of ψ in α, meets Re Σₙ q_n e^{indψ}, of which yaw and tilt move a
part to neighbours of n; what three blades add up to at the tower has k = 3 and n = 2, 3, 4. So

    y = … + Re Σ_k e^{ikdψ} [ p_k + Σ_n Σ_r p_knr q_n(r) ],      p = a + b ω + c ω s.

A gust changes the lift of a blade element by its speed times the gust, hence the rotor's speed ω;
pitch and the rest change with the schedule s. ψ is the rollout's own: it drifts away from the
recorded azimuth, and what stays is the power in each band.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

import dfsm.core.jax_setup  # noqa: F401
from dfsm.models.signals import Azimuth

# How coefficients may depend on the operating point: not, on ω, on ω s.
FACTORS = 3


@dataclass(frozen=True)
class Harmonic:
    """One complex harmonic: e^{ikdψ}, or with n and a ring q_n e^{ikdψ}.

    Attributes
    ----------
    k
        Multiple of the rotor's speed.
    n
        Harmonic of the field; None for e^{ikdψ} alone.
    ring
        Radius in m.
    """

    k: int
    n: int | None = None
    ring: float | None = None


def harmonics_of(azimuth: Azimuth) -> tuple[Harmonic, ...]:
    """The complex harmonics in the order of `field_harmonics`, real parts first."""
    return tuple(
        Harmonic(k, n, ring)
        for k, tried in azimuth.tried.items()
        for n, ring in ((None, None), *((n, r) for n in tried for r in azimuth.rings))
    )


def field_harmonics(psi: ArrayLike, field: ArrayLike, azimuth: Azimuth) -> jax.Array:
    """Evaluate h(ψ, q): real and imaginary parts of all q_n e^{ikdψ}.

    Parameters
    ----------
    psi
        Azimuth in rad, shape ``(...)``.
    field
        Channels `Azimuth.field` in m/s, shape ``(..., channel)``.
    azimuth
        Which harmonics.

    Returns
    -------
    Array
        Shape ``(..., 2 harmonic)``: the real parts of `harmonics_of`, then the imaginary ones.
    """
    psi, field = jnp.asarray(psi), jnp.asarray(field)
    shape = jnp.broadcast_shapes(psi.shape, field.shape[:-1])
    field = jnp.broadcast_to(field, (*shape, field.shape[-1]))
    orders = sorted({n for tried in azimuth.tried.values() for n in tried})
    # Per n the rings stand together: U, or C and S in turn.
    modes: dict[int | None, jax.Array] = {None: jnp.ones((*shape, 1), dtype=complex)}
    first = 0
    for n in orders:
        last = first + len(azimuth.rings) * (2 if n else 1)
        part = field[..., first:last]
        modes[n] = part[..., ::2] - 1j * part[..., 1::2] if n else part.astype(complex)
        first = last
    columns = []
    for k, tried in azimuth.tried.items():
        turn = jnp.exp(1j * k * azimuth.direction * psi)[..., None]
        columns += [modes[n] * turn for n in (None, *tried)]
    z = jnp.broadcast_to(jnp.concatenate(columns, axis=-1), (*shape, len(harmonics_of(azimuth))))
    return jnp.concatenate([z.real, z.imag], axis=-1)


class Passing(eqx.Module):
    """Coefficients of the harmonics in every output, and how they follow the operating point.

    Attributes
    ----------
    coefficients
        Shape ``(factor, output, 2 harmonic)``: those that are constant, that go with the rotor's
        speed, and that go with its product with the schedule; zero for what was dropped.
    speed
        Speed by which the rotor's is divided, in the state's unit.
    schedule
        Lowest and highest value of the schedule in training, shape ``(2,)``, which become -1 and
        1; beyond them the nearest holds.
    column
        Where the rotor's speed stands in I.
    """

    coefficients: jax.Array
    speed: jax.Array
    schedule: jax.Array
    column: int = eqx.field(static=True)

    def __call__(self, inputs: jax.Array, harmonics: jax.Array, value: jax.Array) -> jax.Array:
        """What is added to the outputs ``(output,)`` at I, h and a value of the schedule."""
        factors = operating_factors(inputs[self.column] / self.speed, value, self.schedule)
        return jnp.tensordot(factors, self.coefficients, 1) @ harmonics


def operating_factors(speed: ArrayLike, value: ArrayLike, ends: ArrayLike) -> jax.Array:
    """The factors 1, ω and ω s, shape ``(..., 3)``.

    Parameters
    ----------
    speed
        Relative speed ω, shape ``(...)``.
    value
        The schedule, shape ``(...)``; anything in a model without.
    ends
        Values that become s = -1 and 1; equal ones make s zero.
    """
    speed, value, ends = (jnp.asarray(a) for a in (speed, value, ends))
    half = (ends[1] - ends[0]) / 2
    s = (jnp.clip(value, ends[0], ends[1]) - ends[0] - half) / jnp.where(half > 0, half, 1.0)
    return jnp.stack([jnp.ones_like(speed), speed, speed * s], axis=-1)

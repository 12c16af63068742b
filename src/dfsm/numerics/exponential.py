"""The exponential function, written out for loops on processors.

Within a compiled loop XLA's own takes half as long again, and where hundreds of Gaussian units are
evaluated at every step, that is most of the step.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

import dfsm.core.jax_setup  # noqa: F401

# ln 2 in two parts, of which the first has zeros enough at its end to be multiplied exactly.
_HIGH, _LOW = float.fromhex("0x1.62e42fefa3800p-1"), float.fromhex("0x1.ef35793c76730p-45")
# Added to a whole number, this leaves it in the last bits; the exponent of 1, and its place.
_SHIFT, _BIAS, _PLACE = 1.5 * 2.0**52, 1023, 52
# Below, the result has no full precision any more.
_LEAST = -708.0
# Of the Taylor series up to the last bit where |r| ≤ ln 2 / 2.
_TAYLOR = tuple(1 / math.factorial(k) for k in range(13))


@jax.custom_jvp
def exp(x: jax.Array) -> jax.Array:
    """``e^x`` to 2 units in the last place, for x up to 700; 0 below -708.

    x is taken apart into n ln 2 + r, with n whole: ``e^x = 2^n e^r``, where 2^n is written into the
    exponent of a number, and e^r is its Taylor series.

    Parameters
    ----------
    x
        Any shape.
    """
    inside = jnp.maximum(x, _LEAST)
    n = jnp.round(inside * math.log2(math.e))
    r = (inside - n * _HIGH) - n * _LOW
    series = jnp.full_like(r, _TAYLOR[-1])
    for coefficient in _TAYLOR[-2::-1]:
        series = series * r + coefficient
    whole = jax.lax.bitcast_convert_type(n + _SHIFT, jnp.int64)
    power = jax.lax.bitcast_convert_type((whole + _BIAS) << _PLACE, jnp.float64)
    return jnp.where(x < _LEAST, 0.0, series * power)


@exp.defjvp
def _slope(at: tuple[jax.Array], along: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    value = exp(*at)
    return value, value * along[0]

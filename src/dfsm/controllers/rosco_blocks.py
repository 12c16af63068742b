"""What ROSCO is built of: discrete filters, PI with limits, rate limits, tables.

Filters are bilinear (Tustin) transforms of their continuous form, as ROSCO's documentation gives
them. A filter is its coefficients; its state is a tuple of as many numbers as its order, in
transposed direct form II.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

FilterState = tuple[jax.Array, ...]


class Coefficients(NamedTuple):
    """y = (b₀ + b₁ z⁻¹ + …) / (1 + a₁ z⁻¹ + …) x; `a` without its leading 1."""

    b: tuple[jax.Array, ...]
    a: tuple[jax.Array, ...]


def low_pass(corner: jax.Array, interval: float) -> Coefficients:
    """ω / (s + ω), with ω the `corner` in rad/s."""
    turn = corner * interval
    gain = turn / (2 + turn)
    return Coefficients((gain, gain), ((turn - 2) / (2 + turn),))


def low_pass_2(corner: jax.Array, damping: jax.Array, interval: float) -> Coefficients:
    """ω² / (s² + 2ζω s + ω²)."""
    square, slope = (corner * interval) ** 2, 4 * damping * corner * interval
    leading = square + 4 + slope
    gain = square / leading
    return Coefficients(
        (gain, 2 * gain, gain), ((2 * square - 8) / leading, (square + 4 - slope) / leading)
    )


def high_pass(corner: jax.Array, interval: float) -> Coefficients:
    """S / (s + ω)."""
    rate = 2 / interval
    gain = rate / (corner + rate)
    return Coefficients((gain, -gain), ((corner - rate) / (corner + rate),))


def notch(
    corner: jax.Array, numerator: jax.Array, denominator: jax.Array, interval: float
) -> Coefficients:
    """(s² + 2ω β₁ s + ω²) / (s² + 2ω β₂ s + ω²), dampings β₁ and β₂."""
    rate = 2 / interval
    squares = rate**2 + corner**2
    above, below = 2 * corner * numerator * rate, 2 * corner * denominator * rate
    leading = squares + below
    middle = 2 * (corner**2 - rate**2) / leading
    return Coefficients(
        ((squares + above) / leading, middle, (squares - above) / leading),
        (middle, (squares - below) / leading),
    )


def filtered(
    coefficients: Coefficients, state: FilterState, value: jax.Array
) -> tuple[FilterState, jax.Array]:
    """Next state, and the output at `value`."""
    b, a = coefficients
    out = b[0] * value + state[0]
    later = (*state[1:], jnp.zeros_like(out))
    parts = zip(b[1:], a, later, strict=True)
    return tuple(bi * value - ai * out + s for bi, ai, s in parts), out


def settled(coefficients: Coefficients, value: jax.Array, out: jax.Array) -> FilterState:
    """State in which the filter has had this input and this output for long."""
    b, a = coefficients
    state: list[jax.Array] = []
    for bi, ai in zip(reversed(b[1:]), reversed(a), strict=True):
        behind = state[0] if state else jnp.zeros_like(out)
        state.insert(0, bi * value - ai * out + behind)
    return tuple(state)


def at_least(value: jax.Array, lowest: jax.Array | float) -> jax.Array:
    """The larger of both, with the slope of one of them.

    `jnp.maximum` has the slope of whatever equals its result. Compilers round the same number in
    two ways, within a multiply-add and alone, and where nothing equals the result it has none.
    """
    return jnp.where(value < lowest, lowest, value)


def at_most(value: jax.Array, highest: jax.Array | float) -> jax.Array:
    """The smaller of both, as `at_least`."""
    return jnp.where(value > highest, highest, value)


def within(value: jax.Array, lowest: jax.Array | float, highest: jax.Array | float) -> jax.Array:
    """The value between both limits, the higher one before the lower, as `at_least`."""
    return at_most(at_least(value, lowest), highest)


def rate_limited(
    value: jax.Array, last: jax.Array, limits: tuple[jax.Array, jax.Array], interval: float
) -> jax.Array:
    """`value`, as far as it can be reached from `last` at rates within `limits`.

    Within them it is `value` to the last digit: a pitch that rounding takes below its minimum
    would switch the wind estimator off.
    """
    return within(value, last + limits[0] * interval, last + limits[1] * interval)


def proportional_integral(
    error: jax.Array,
    integral: jax.Array,
    gains: tuple[jax.Array, jax.Array],
    limits: tuple[jax.Array, jax.Array],
    interval: float,
) -> tuple[jax.Array, jax.Array]:
    """Next integral and output, both within `limits`; at a limit the integral waits there."""
    proportional, integrating = gains
    integral = within(integral + interval * integrating * error, *limits)
    return integral, within(proportional * error + integral, *limits)


def unwound(
    integral: jax.Array,
    moved: jax.Array,
    direct: jax.Array,
    limits: tuple[jax.Array | float, jax.Array | float],
) -> jax.Array:
    """Next integral, which takes ``direct + integral`` up to a limit and no farther.

    Parameters
    ----------
    integral, moved
        Before and after the step.
    direct
        What else makes the command.
    limits
        Lowest and highest command.
    """
    low, high = limits
    wanted, by = direct + moved, moved - integral
    waits = ((wanted > high) & (by > 0)) | ((wanted < low) & (by < 0))
    reached = within(wanted, low, high) - direct
    between = within(reached, jnp.minimum(integral, moved), jnp.maximum(integral, moved))
    return jnp.where(waits, between, moved)


def lookup(points: jax.Array, values: jax.Array, at: jax.Array) -> jax.Array:
    """Linear between the points, constant beyond them."""
    if len(points) == 1:
        return values[0] + jnp.zeros_like(at)
    i, along = _place(points, at)
    return values[i] + along * (values[i + 1] - values[i])


def lookup_2(
    rows: jax.Array, columns: jax.Array, values: jax.Array, at: tuple[jax.Array, jax.Array]
) -> jax.Array:
    """Bilinear between the points of a table of shape ``(row, column)``, constant beyond them."""
    (i, along), (j, across) = _place(rows, at[0]), _place(columns, at[1])
    upper = values[i, j] + across * (values[i, j + 1] - values[i, j])
    lower = values[i + 1, j] + across * (values[i + 1, j + 1] - values[i + 1, j])
    return upper + along * (lower - upper)


def _place(points: jax.Array, at: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Interval of `at`, and where in it, 0 to 1."""
    i = jnp.clip(jnp.sum(points <= at) - 1, 0, len(points) - 2)
    return i, within((at - points[i]) / (points[i + 1] - points[i]), 0.0, 1.0)

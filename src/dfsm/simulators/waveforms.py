"""Signals that are known at every time of their span, in NumPy and inside JAX code."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from numpy.typing import ArrayLike

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array
from dfsm.errors import DfsmError


@dataclass(frozen=True, eq=False)
class Signal:
    """A signal of several channels that is known at every time of its span.

    Called with times in s of shape ``(...)`` it returns ``(..., channel)``: NumPy for NumPy
    times, where one outside the span is an error, and JAX inside JAX code, where the formula goes
    on.

    Attributes
    ----------
    span
        First and last time in s, shape ``(2,)``.
    corners
        Times at which the signal is not smooth, shape ``(corner,)``, increasing. A solver does
        not step across them.
    """

    span: Array
    corners: Array

    def __call__(self, time: ArrayLike) -> Any:
        """Evaluate at times in s."""
        if isinstance(time, jax.Array) or isinstance(self.span, jax.Array):
            return self._at(jnp.asarray(time), jnp)
        time = np.asarray(time, dtype=np.float64)
        start, stop = self.span
        slack = 1e-9 * (stop - start)
        inside = (time >= start - slack) & (time <= stop + slack)
        if not inside.all():
            raise DfsmError(
                f"the signal lasts from {start:g} s to {stop:g} s, it was asked for at "
                f"{time[~inside].ravel()[0]:g} s: draw a longer one or stay inside"
            )
        return self._at(time, np)

    def _at(self, time: Any, xp: Any) -> Any:
        """Evaluate with the array library `xp`."""
        raise NotImplementedError


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class PiecewisePolynomial(Signal):
    """Polynomials between breaks; at a break the one that begins there holds.

    Attributes
    ----------
    breaks
        Where each polynomial begins, shape ``(piece,)``, increasing; the last one goes on.
    coefficients
        Of the powers of time since the break, highest first, ``(piece, power, channel)``.
    """

    breaks: Array
    coefficients: Array

    def _at(self, time: Any, xp: Any) -> Any:
        piece = xp.clip(xp.searchsorted(self.breaks, time, side="right") - 1, 0, None)
        since = (time - xp.asarray(self.breaks)[piece])[..., None]
        coefficients = xp.asarray(self.coefficients)[piece]
        value = coefficients[..., 0, :]
        for power in range(1, self.coefficients.shape[1]):
            value = value * since + coefficients[..., power, :]
        return value


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class SineSum(Signal):
    """Sines of fixed frequency and phase.

    Attributes
    ----------
    middle, amplitude
        Mean, and amplitude of every line, shape ``(channel,)``.
    rate, phase
        In rad/s and rad, shape ``(line, channel)``.
    """

    middle: Array
    amplitude: Array
    rate: Array
    phase: Array

    def _at(self, time: Any, xp: Any) -> Any:
        sines = xp.sin(time[..., None, None] * self.rate + self.phase)
        return self.middle + self.amplitude * sines.sum(axis=-2)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class SweptSine(Signal):
    """A sine of changing frequency.

    Attributes
    ----------
    middle, amplitude, phase
        Mean, amplitude and phase (rad), shape ``(channel,)``.
    frequencies
        In Hz at the start and the end of the span, shape ``(2,)``.
    logarithmic
        Whether the frequency grows by equal factors in equal times.
    """

    middle: Array
    amplitude: Array
    phase: Array
    frequencies: Array
    logarithmic: bool = field(metadata={"static": True})

    def _at(self, time: Any, xp: Any) -> Any:
        first, last = self.frequencies[0], self.frequencies[1]
        since, duration = time - self.span[0], self.span[1] - self.span[0]
        if self.logarithmic:
            growth = xp.log(last / first) / duration
            cycles = first * xp.expm1(growth * since) / growth
        else:
            cycles = first * since + (last - first) * since**2 / (2 * duration)
        return self.middle + self.amplitude * xp.sin(2 * np.pi * cycles[..., None] + self.phase)


def held(time: ArrayLike, values: ArrayLike, stop: float) -> PiecewisePolynomial:
    """Hold each row of values from its time on until the next.

    Parameters
    ----------
    time
        When each value begins, in s, shape ``(value,)``, increasing.
    values
        Shape ``(value, channel)``.
    stop
        End of the signal in s.

    Returns
    -------
    PiecewisePolynomial
    """
    time, values = np.array(time, dtype=np.float64), np.array(values, dtype=np.float64)
    return PiecewisePolynomial(
        *map(fixed, (np.array([time[0], stop]), time[1:], time, values[:, None, :]))
    )


def interpolated(time: ArrayLike, values: ArrayLike) -> PiecewisePolynomial:
    """Join samples by a cubic spline.

    Parameters
    ----------
    time
        In s, shape ``(time,)``, increasing.
    values
        Shape ``(time, channel)``.

    Returns
    -------
    PiecewisePolynomial
        Without corners: a solver that stopped at every sample of a long record would crawl, and
        its error control sees what little the third derivative jumps by.
    """
    time = np.array(time, dtype=np.float64)
    spline = scipy.interpolate.CubicSpline(time, np.asarray(values, dtype=np.float64))
    coefficients = np.moveaxis(spline.c, 0, 1)
    return PiecewisePolynomial(*map(fixed, (time[[0, -1]], np.empty(0), time[:-1], coefficients)))


def fixed(array: Array) -> Array:
    """The array, closed to writing: a signal never changes."""
    array = np.array(array, dtype=np.float64)
    array.flags.writeable = False
    return array

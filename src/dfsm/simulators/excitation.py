"""Input signals that explore the state space (Sec. 3.2: simulations with random inputs).

A settings class says what kind of signal is wanted and `excite` draws one. What is drawn is known
at every time, not only at samples: a solver with adaptive steps sees the same signal as a plot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.errors import DfsmError
from dfsm.simulators.waveforms import (
    PiecewisePolynomial,
    Signal,
    SineSum,
    SweptSine,
    fixed,
    held,
    interpolated,
)

Bound = float | tuple[float, ...]

# Knots and steps are rounded to this many decimals of a second: those of two signals with
# commensurate spacings then coincide, instead of lying one rounding error apart.
_DECIMALS = 9
_FINEST = 1e-6
# Samples per period of the fastest line of a multisine when its peak is sought.
_PER_PERIOD = 32


@settings_class
class RandomKnots:
    """Uniform random values at equidistant knots, joined by a cubic spline (Sec. 3.2).

    Between knots the spline may overshoot `low` to `high`; the knots themselves stay inside.

    Attributes
    ----------
    low, high
        Range of the knots in each channel's unit, one number or one per channel; where both are
        equal the channel is constant.
    spacing
        Time between knots in s.
    """

    kind: Literal["random_knots"] = "random_knots"
    low: Bound
    high: Bound
    spacing: float


@settings_class
class RandomSteps:
    """Random levels, each held for a random time; the channels step independently.

    Attributes
    ----------
    low, high
        Range of the levels, as for `RandomKnots`.
    hold
        Shortest and longest time in s for which a level is held.
    levels
        Number of equidistant levels to choose from; None draws any value of the range.
    """

    kind: Literal["random_steps"] = "random_steps"
    low: Bound
    high: Bound
    hold: tuple[float, float]
    levels: int | None = None


@settings_class
class Multisine:
    """Sum of sines of equal amplitude and random phase.

    The range of frequencies is cut into equal parts and each channel has one line at random in
    each part, so that no two channels share a line and a fit can tell them apart.

    Attributes
    ----------
    low, high
        Range that the signal fills but never leaves, as for `RandomKnots`.
    frequencies
        Lowest and highest frequency in Hz.
    lines
        Number of sines per channel.
    """

    kind: Literal["multisine"] = "multisine"
    low: Bound
    high: Bound
    frequencies: tuple[float, float]
    lines: int = 20


@settings_class
class Chirp:
    """Sine whose frequency sweeps once over the duration, with a random phase per channel.

    At any moment all channels have the same frequency: with more than one, several runs are
    needed to tell their effects apart.

    Attributes
    ----------
    low, high
        Range of the signal, as for `RandomKnots`.
    frequencies
        First and last frequency in Hz; the sweep may go down.
    sweep
        ``"linear"`` in time, or ``"logarithmic"``: equal time per octave.
    """

    kind: Literal["chirp"] = "chirp"
    low: Bound
    high: Bound
    frequencies: tuple[float, float]
    sweep: Literal["linear", "logarithmic"] = "linear"


@settings_class
class Uniform:
    """Values drawn uniformly from a box, for initial states and parameters.

    Attributes
    ----------
    low, high
        Range in each channel's unit, one number or one per channel; equal ends fix a value.
    """

    low: Bound
    high: Bound

    def draw(self, channels: int, seed: int | Sequence[int]) -> Array:
        """Draw one value per channel, shape ``(channel,)``; the same seed gives the same ones."""
        return np.random.default_rng(seed).uniform(*bounds(self, channels))


Excitation = RandomKnots | RandomSteps | Multisine | Chirp


# -- drawing signals ----------------------------------------------------------------------------


def excite(
    signal: Excitation, channels: int, duration: float, seed: int | Sequence[int] = 0
) -> Signal:
    """Draw an input signal.

    Parameters
    ----------
    signal
        What kind: `RandomKnots`, `RandomSteps`, `Multisine` or `Chirp`.
    channels
        Number of channels.
    duration
        In s; the signal begins at 0 s.
    seed
        The same seed gives the same signal.

    Returns
    -------
    Signal
        Called with times in s, shape ``(time,)``, it returns ``(time, channel)``; it works inside
        JAX code too.

    Raises
    ------
    DfsmError
        A setting that makes no sense, or bounds that do not fit the number of channels.
    """
    draws: dict[type, Any] = {
        RandomKnots: _draw_knots,
        RandomSteps: _draw_steps,
        Multisine: _draw_multisine,
        Chirp: _draw_chirp,
    }
    if type(signal) not in draws:
        kinds = ", ".join(kind.__name__ for kind in draws)
        raise DfsmError(f"the signal is a {type(signal).__name__}, expected one of {kinds}")
    require(channels >= 1, "channels", channels, "at least 1")
    require(0 < duration < np.inf, "duration", duration, "a time in s above 0")
    require(np.min(seed) >= 0, "seed", seed, "0 or more")
    low, high = bounds(signal, channels)
    return draws[type(signal)](signal, low, high, duration, np.random.default_rng(seed))


def bounds(excitation: Excitation | Uniform, channels: int) -> tuple[Array, Array]:
    """Lower and upper bound per channel, shapes ``(channel,)``.

    Raises
    ------
    DfsmError
        A wrong number of bounds, one that is not finite, or a lower above its upper one.
    """
    ends = []
    for name in ("low", "high"):
        value = np.asarray(getattr(excitation, name), dtype=np.float64)
        if value.shape not in ((), (channels,)) or not np.isfinite(value).all():
            raise DfsmError(
                f"{name} is {getattr(excitation, name)}, expected one number or one for each of "
                f"the {channels} channels, all finite"
            )
        ends.append(np.broadcast_to(value, (channels,)))
    low, high = ends
    if (low > high).any():
        i = int(np.flatnonzero(low > high)[0])
        raise DfsmError(f"low is {low[i]:g} and high is {high[i]:g}: swap the two")
    return low, high


def _draw_knots(
    signal: RandomKnots, low: Array, high: Array, duration: float, rng: np.random.Generator
) -> Signal:
    require(signal.spacing >= _FINEST, "spacing", signal.spacing, f"at least {_FINEST:g} s")
    count = max(2, int(np.ceil(duration / signal.spacing * (1 - 1e-12))) + 1)
    knots = np.round(signal.spacing * np.arange(count), _DECIMALS)
    spline = interpolated(knots, rng.uniform(low, high, (count, len(low))))
    span = fixed(np.array([0.0, duration]))
    return PiecewisePolynomial(span, spline.breaks[1:], spline.breaks, spline.coefficients)


def _draw_steps(
    signal: RandomSteps, low: Array, high: Array, duration: float, rng: np.random.Generator
) -> Signal:
    shortest, longest = signal.hold
    fits = _FINEST <= shortest <= longest < np.inf
    require(fits, "hold", signal.hold, f"two rising times in s of at least {_FINEST:g}")
    few = signal.levels is not None and signal.levels < 2
    require(not few, "levels", signal.levels, "at least 2, or None for any value")
    # As many as could be needed, so that every draw has arrays of one shape and is compiled once.
    count, channels = int(np.ceil(duration / shortest)) + 1, len(low)
    share = rng.uniform(size=(count, channels))
    if signal.levels is not None:
        share = np.floor(share * signal.levels) / (signal.levels - 1)
    levels = low + share * (high - low)
    holds = rng.uniform(shortest, longest, (count, channels))
    begins = np.round(np.cumsum(holds, axis=0) - holds, _DECIMALS)
    time = np.unique(begins)
    values = [
        level[np.searchsorted(begin, time, side="right") - 1]
        for begin, level in zip(begins.T, levels.T, strict=True)
    ]
    return held(time, np.stack(values, axis=1), duration)


def _draw_multisine(
    signal: Multisine, low: Array, high: Array, duration: float, rng: np.random.Generator
) -> Signal:
    first, last = signal.frequencies
    fits = 0 <= first < last < np.inf
    require(fits, "frequencies", signal.frequencies, "two rising ones in Hz, none negative")
    require(signal.lines >= 1, "lines", signal.lines, "at least 1")
    shape = (signal.lines, len(low))
    part = (np.arange(signal.lines)[:, None] + rng.uniform(size=shape)) / signal.lines
    rate = 2 * np.pi * (first + (last - first) * part)
    phase = rng.uniform(0, 2 * np.pi, shape)
    amplitude = (high - low) / 2 / _peak(rate, phase, duration)
    parts = (np.array([0.0, duration]), np.empty(0), (low + high) / 2, amplitude, rate, phase)
    return SineSum(*map(fixed, parts))


def _peak(rate: Array, phase: Array, duration: float) -> Array:
    """Upper bound of the sum of unit sines over the duration, tight to some percent."""
    count = int(np.ceil(duration * rate.max() / (2 * np.pi) * _PER_PERIOD)) + 2
    time, step = np.linspace(0, duration, count, retstep=True)
    total = np.zeros((count, rate.shape[1]))
    for line_rate, line_phase in zip(rate, phase, strict=True):
        total += np.sin(time[:, None] * line_rate + line_phase)
    # Between two samples a function strays from them by at most step²/8 of its curvature.
    return np.abs(total).max(axis=0) + step**2 / 8 * (rate**2).sum(axis=0)


def _draw_chirp(
    signal: Chirp, low: Array, high: Array, duration: float, rng: np.random.Generator
) -> Signal:
    first, last = signal.frequencies
    fits = 0 < min(first, last) < max(first, last) < np.inf
    require(fits, "frequencies", signal.frequencies, "two different ones in Hz above 0")
    sweeps = ("linear", "logarithmic")
    require(signal.sweep in sweeps, "sweep", signal.sweep, " or ".join(sweeps))
    phase = rng.uniform(0, 2 * np.pi, len(low))
    middle, half, ends = (low + high) / 2, (high - low) / 2, np.array([first, last])
    parts = (np.array([0.0, duration]), np.empty(0), middle, half, phase, ends)
    return SweptSine(*map(fixed, parts), logarithmic=signal.sweep == "logarithmic")

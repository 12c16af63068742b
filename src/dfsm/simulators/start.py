"""What a user gives for a simulation, checked and turned into what a solver needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from dfsm.core.types import Array
from dfsm.data.conversion import in_units_of, tell_converted
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.simulators.excitation import Excitation, Uniform, excite
from dfsm.simulators.waveforms import Signal, held, interpolated


def as_mesh(time: ArrayLike) -> Array:
    """Check the samples of a simulation: in s, shape ``(time,)``.

    Raises
    ------
    DfsmError
        Fewer than two times, or ones that do not increase.
    """
    mesh = _numbers("time", time)
    if mesh.ndim != 1 or len(mesh) < 2 or not np.isfinite(mesh).all():
        raise DfsmError(f"time has shape {mesh.shape}, expected (time,), at least 2 finite times")
    steps = np.diff(mesh)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0))
        raise DfsmError(
            f"time goes from {mesh[row]:g} s to {mesh[row + 1]:g} s at sample {row + 1}, expected "
            "increasing times: sort them and give each once"
        )
    return mesh


def as_vector(what: str, value: ArrayLike, channels: Sequence[Channel]) -> Array:
    """One finite value per channel, shape ``(channel,)``.

    Raises
    ------
    DfsmError
        Another shape, or a value that is not finite; the message begins with `what`.
    """
    vector = _numbers(what, value)
    if vector.shape != (len(channels),):
        raise DfsmError(f"{what}: shape {vector.shape}, expected {_told(channels)}")
    if not np.isfinite(vector).all():
        i = int(np.argmin(np.isfinite(vector)))
        raise DfsmError(f"{what}: '{channels[i].name}' is {vector[i]}, expected a finite number")
    return vector


def as_signal(
    what: str,
    source: Signal | Trajectory | ArrayLike | None,
    channels: Sequence[Channel],
    time: Array,
) -> Signal:
    """A signal from whatever `ODESystem.simulate` takes.

    Parameters
    ----------
    what
        Begins the messages.
    source
        A signal, a run with the channels, samples at `time`, or constants; None for no channels.
    channels
        Expected.
    time
        Samples of the simulation in s, shape ``(time,)``.

    Returns
    -------
    Signal
        Covers the simulation.

    Raises
    ------
    DfsmError
        The shape does not fit, a sample is not finite, or the signal does not cover the time.
    """
    if isinstance(source, Trajectory):
        names, own = [c.name for c in channels], source
        source = in_units_of(own, channels, "the system")
        tell_converted([own], [source])
        source = interpolated(source.time, source.select(names).require_finite().values)
    if isinstance(source, get_args(Excitation)):
        raise DfsmError(f"{what}: a {type(source).__name__}, draw a signal from it with excite")
    if not isinstance(source, Signal):
        if source is None and channels:
            raise DfsmError(f"{what} are missing, expected {_told(channels)}")
        source = _from_samples(what, np.empty(0) if source is None else source, channels, time)
    width = source(source.span[0]).shape[-1]
    if width != len(channels):
        raise DfsmError(f"{what}: a signal of {width} channels, expected {_told(channels)}")
    start, stop = source.span
    slack = 1e-9 * (stop - start)
    if time[0] < start - slack or time[-1] > stop + slack:
        raise DfsmError(
            f"{what} last from {start:g} s to {stop:g} s, the simulation from {time[0]:g} s to "
            f"{time[-1]:g} s: make them longer or simulate less"
        )
    return source


def _from_samples(
    what: str, samples: ArrayLike, channels: Sequence[Channel], time: Array
) -> Signal:
    values = _numbers(what, samples)
    n = len(channels)
    if values.shape not in ((n,), (len(time), n)):
        raise DfsmError(
            f"{what}: shape {values.shape}, expected {_told(channels)}, or one such row for each "
            f"of the {len(time)} times"
        )
    if not np.isfinite(values).all():
        raise DfsmError(f"{what}: a value is not finite, expected numbers")
    if values.ndim == 1:
        return held(time[:1], values[None], time[-1])
    return interpolated(time, values)


def draw_vector(
    what: str,
    excitation: Uniform | ArrayLike,
    channels: Sequence[Channel],
    k: int,
    seed: Sequence[int],
) -> Array:
    """Values of run `k`: drawn, or the next of the rows, shape ``(channel,)``."""
    if isinstance(excitation, Uniform):
        return excitation.draw(len(channels), seed)
    rows = _numbers(what, excitation)
    if len(channels) == 1 and rows.ndim == 1:
        rows = rows[:, None]
    return as_vector(what, rows[k % len(rows)] if rows.ndim == 2 and len(rows) else rows, channels)


def draw_signal(
    what: str,
    excitation: Excitation | None,
    channels: Sequence[Channel],
    duration: float,
    seed: Sequence[int],
) -> Signal:
    """Draw a signal for the channels, which may be none.

    Raises
    ------
    DfsmError
        Channels without a choice, or a choice without channels.
    """
    if excitation is None and channels:
        names = ", ".join(c.name for c in channels)
        raise DfsmError(
            f"no signal for the {what} {names}: say what kind to draw, e.g. RandomKnots"
        )
    if excitation is None:
        return held([0.0], np.empty((1, 0)), duration)
    if not channels:
        raise DfsmError(f"the system has no {what} to excite: leave them out")
    return excite(excitation, len(channels), duration, seed)


def _told(channels: Sequence[Channel]) -> str:
    """The shape of a vector of these channels and their names."""
    return f"({len(channels)},): {', '.join(c.name for c in channels)}" if channels else "(0,)"


def _numbers(what: str, value: ArrayLike) -> Array:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise DfsmError(f"{what}: a {type(value).__name__}, expected numbers") from None

"""What samples show of how a channel was made: angles that wrap, held values, a bad start."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array, IntArray
from dfsm.core.units import factor, known

if TYPE_CHECKING:
    from dfsm.data.trajectory import Trajectory

# Fewer samples than this show nothing.
_FEWEST = 20
# Changes that make a rate, and the share of them that must be equally far apart.
_CHANGES, _REGULAR = 5, 0.9
# Times the usual change from sample to sample that the first one is, where it is a jump.
_JUMP = 10.0
# Standard deviations of the second half within which all of it stays, but not the first tenth.
_FAR = 6.0
# A motion dies away whose third quarter is so much wider than its last, that rests within such a
# share of its range, or whose neighbouring samples at last have no more in common than this.
_WIDER, _RESTS, _ALIKE = 1.5, 0.005, 0.3


@dataclass(frozen=True)
class Wrap:
    """An angle that begins again: its period in the channel's unit, how often, when first in s."""

    period: float
    times: int
    first: float


def wrapping(time: Array, values: Array, unit: str) -> Wrap | None:
    """Whether an angle begins again after a turn.

    Parameters
    ----------
    time, values
        Shape ``(time,)``, in s and in `unit`.
    unit
        Of an angle; without one both degrees and radians are tried.

    Returns
    -------
    Wrap | None
        None where all steps are those of a motion.
    """
    if len(values) < _FEWEST or not np.isfinite(values).all():
        return None
    for period in _turns(unit):
        # A step too many may lie between the last sample before the turn and the first after it.
        if not 0.75 * period < np.ptp(values) <= period * (1 + 1e-6):
            continue
        steps = np.diff(values)
        turns = np.abs(steps) > period / 2
        moved = np.abs(steps[turns] - period * np.round(steps[turns] / period))
        usual = np.quantile(np.abs(steps[~turns]), 0.95) if (~turns).any() else 0.0
        if turns.any() and 0 < usual < period / 4 and moved.max() <= 2 * usual:
            return Wrap(period, int(turns.sum()), float(time[1:][turns][0]))
    return None


def wrap_notes(runs: Sequence[Trajectory], names: Iterable[str]) -> list[str]:
    """Say of which inputs and outputs of a fit wrap, each where it does first."""
    told = []
    for name in dict.fromkeys(names):
        found = ((r, wrapping(r.time, r[name], r.channel(name).unit)) for r in runs)
        if first := next(((run, wrap) for run, wrap in found if wrap), None):
            run, wrap = first
            told.append(
                f"{run.where}: '{name}' wraps at {wrap.period:.4g} ({wrap.times} times, first at "
                f"{wrap.first:g} s), and a fit takes such a jump for motion: unwrap it "
                "(numpy.unwrap), or give its sine and cosine"
            )
    return told


def _turns(unit: str) -> list[float]:
    """One turn in a unit of angles; in both that are usual where nobody knows the unit."""
    if not known(unit):
        return [360.0, 2 * np.pi]
    turn = factor("rev", unit)
    return [] if turn is None else [turn]


def held_interval(time: Array, values: Array) -> float | None:
    """Interval in s at which a channel changes, where it stays as it was in between.

    Returns
    -------
    float or None
        None where it changes at every sample, or at no regular ones.
    """
    every = _held(values)
    return None if every is None else float(np.median(np.diff(time[_changes(values)])))


def changes_regularly(values: Array) -> bool:
    """Whether samples ``(time,)`` stay as they are and change at regular ones."""
    return _held(values) is not None


def moments(values: Array) -> NDArray[np.bool_]:
    """Samples at which a held channel was recorded, ``(time,)``; all of one that is not held."""
    recorded, every = np.ones(len(values), dtype=bool), _held(values)
    if every is not None:
        recorded[:] = False
        recorded[(_changes(values)[0] + 1) % every :: every] = True
    return recorded


def _changes(values: Array) -> IntArray:
    return np.flatnonzero(values[1:] != values[:-1])


def _held(values: Array) -> int | None:
    """Samples from one change to the next; None where these are not regular."""
    if len(values) < _FEWEST or not np.isfinite(values).all():
        return None
    if not _CHANGES <= np.count_nonzero(values[1:] != values[:-1]) <= 0.6 * len(values):
        return None
    changes = _changes(values)
    apart = np.diff(changes)
    usual = int(np.median(apart))
    # A value that happens to be the same twice makes a gap of twice the length.
    if usual < 2 or np.mean(apart == usual) < _REGULAR or (apart % usual).any():
        return None
    return usual


def jumps_at_first(values: Array) -> bool:
    """Whether the first sample has nothing to do with those that follow."""
    if len(values) < _FEWEST or not np.isfinite(values).all():
        return False
    begin = np.abs(np.diff(values[: _FEWEST + 1]))
    near = begin[1:_FEWEST].max()
    if begin[0] <= _JUMP * near:  # as nearly always, and the rest need not be looked at
        return False
    steps = np.abs(np.diff(values))
    usual = np.sqrt(np.mean(steps[1:] ** 2))
    return bool(usual > 0 and steps[0] > _JUMP * max(near, 0.1 * usual) and steps[0] > 2 * usual)


def _dies_away(values: Array, half: int) -> bool:
    """Whether the second half of a channel is the end of what its start began."""
    later = values[half:]
    third, last = np.array_split(later, 2)
    if third.std() > _WIDER * last.std() or later.std() < _RESTS * np.ptp(values):
        return True
    moves = later - later.mean()
    return bool(moves[1:] @ moves[:-1] < _ALIKE * (moves @ moves))


def transient_end(time: Array, values: Array) -> float | None:
    """Time in s until which a channel is far from all that it does later; None for none.

    Something must go on later: a free decay, to rest or to the noise of a sensor, is an experiment.
    """
    half, tenth = len(values) // 2, len(values) // 10
    if tenth < _FEWEST or not np.isfinite(values).all():
        return None
    later = values[half:]
    middle, spread = later.mean(), later.std()
    if not spread > 0 or not (np.abs(values[:tenth] - middle) > _FAR * spread).any():
        return None
    far = np.abs(values - middle) > _FAR * spread
    if far[half:].any() or _dies_away(values, half):
        return None
    # What is far later on is no part of the start.
    return float(time[np.flatnonzero(far[: 2 * tenth])[-1]])

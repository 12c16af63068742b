"""Where a path left the training data, in words: which signals, how far, when first, how long.

A model is right where its runs were. A share of the time says that a path went elsewhere, not what
to do about it: a run with that pitch, a bound on that torque, or both at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Channel
from dfsm.models.region import Region
from dfsm.numerics.hats import hat_weights
from dfsm.numerics.time_mesh import mean_over

# Share of the time outside the training data above which a user is warned.
MUCH_OUTSIDE = 0.05
# Standard deviation of a constant, over its size: rounding.
_CONSTANT = 1e-9
# How many are named in one sentence.
_NAMED = 3
# Samples from which the signals of a combination are named, at most.
_LOOKED_AT = 200
# Signals of a combination: those with this share of what the first adds to the distance.
_ALIKE = 0.3
_TOGETHER = 3


@dataclass(frozen=True)
class Departure:
    """One way in which a path left the training data.

    Attributes
    ----------
    channels
        The signal beyond its range, or those that never occurred together like this.
    what
        How far, as a clause.
    share
        Of the time.
    first
        Time in s.
    constant
        Whether the signal never varied in training, so that the model cannot know its effect.
    """

    channels: tuple[str, ...]
    what: str
    share: float
    first: float
    constant: bool = False

    def __str__(self) -> str:
        return f"{self.what}, {self.share:.1%} of the time, first at {self.first:g} s"


def departures(
    region: Region,
    channels: Sequence[Channel],
    time: Array,
    inputs: Array,
    outside: NDArray[Any],
    weights: Array | None = None,
) -> tuple[Departure, ...]:
    """All ways in which a path left the training data, those that lasted longest first.

    Parameters
    ----------
    region
        Of the model.
    channels
        Of the inputs, in the order of I = [u, w, ξ, p].
    time
        In s, shape ``(time,)``.
    inputs
        I along the path, shape ``(time, input)``.
    outside
        Which samples are outside the training data, shape ``(time,)``, see `Region.outside`.
    weights
        How much of the time each sample stands for, shape ``(time,)``; None where all count alike.
    """
    if not outside.any():
        return ()
    beyond = np.asarray(region.beyond(inputs)) & outside[:, None]
    found = [
        _beyond(region, k, channels[k], inputs[rows, k], (share, first))
        for k in np.flatnonzero(beyond.any(axis=0)).tolist()
        for rows, share, first in [_when(beyond[:, k], time, weights)]
    ]
    together = outside & ~beyond.any(axis=1)
    if together.any():
        rows, share, first = _when(together, time, weights)
        # Of the whole path: its length is common to many runs, and compiled once.
        farthest = float(np.sqrt(np.asarray(region.distance(inputs))[rows].max()))
        found.append(_together(region, channels, inputs[rows], farthest, (share, first)))
    return tuple(sorted(found, key=lambda d: (not d.constant, -d.share)))


def told(found: Sequence[Departure]) -> str:
    """The first few of them, for a sentence; empty without any."""
    more = len(found) - _NAMED
    return "; ".join(map(str, found[:_NAMED])) + (f"; and {more} more" if more > 0 else "")


def _when(
    there: NDArray[np.bool_], time: Array, weights: Array | None
) -> tuple[IntArray, float, float]:
    """Samples, share of the time, and first time in s."""
    rows = np.flatnonzero(there)
    return rows, float(mean_over(there.astype(float), weights)), float(time[rows[0]])


def _beyond(
    region: Region, column: int, channel: Channel, values: Array, when: tuple[float, float]
) -> Departure:
    low, high = float(region.low[column]), float(region.high[column])
    excess = np.maximum(low - values, values - high)
    worst, unit = float(values[int(np.argmax(excess))]), f" {channel.unit}" if channel.unit else ""
    constant = float(region.std[column]) <= _CONSTANT * max(abs(low), abs(high))
    what = f"{channel.name} goes to {worst:.4g}{unit} (trained {low:.4g} to {high:.4g})"
    if constant:
        middle = (low + high) / 2
        what = (
            f"{channel.name} goes to {worst:.4g}{unit}, but was {middle:.4g} in all training runs: "
            "the model cannot know what it does"
        )
    return Departure((channel.name,), what, *when, constant)


def _together(
    region: Region,
    channels: Sequence[Channel],
    inputs: Array,
    farthest: float,
    when: tuple[float, float],
) -> Departure:
    """Signals that make up most of the distance where each is inside its own range."""
    part = inputs[np.linspace(0, len(inputs) - 1, min(len(inputs), _LOOKED_AT)).astype(int)]
    shares = hat_weights(np.asarray(region.grid), part[:, region.schedule or 0])
    W, middles = np.asarray(region.whitening), np.asarray(region.operating)
    apart = part[:, None] - middles
    # What each signal adds to the squared distance; all together make it up.
    back = np.einsum("nkr,kri->nki", np.einsum("nki,kri->nkr", apart, W), W)
    added = np.einsum("nk,nki,nki->ni", shares, apart, back).mean(axis=0)
    order = np.argsort(-added).tolist()
    alike = [k for k in order[:_TOGETHER] if added[k] >= _ALIKE * added[order[0]]]
    names = tuple(channels[k].name for k in (alike if len(alike) > 1 else order[:2]))
    listed = " and ".join([", ".join(names[:-1]), names[-1]] if names[1:] else names)
    what = (
        f"{listed} are each inside their range but go together as in no training run "
        f"({farthest:.2g} times as far out as is usual)"
    )
    if len(channels) == 1:
        what = f"{listed} is {farthest:.2g} times as far out as is usual"
    return Departure(names, what, *when)

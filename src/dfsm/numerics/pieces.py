"""Signals with kinks: values and derivatives piece by piece.

Where an input jumps, the state goes on and its derivative jumps. One spline through all samples
would round that off, and ring beside it; splines between the jumps do not.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dfsm.core.shapes import Series
from dfsm.core.types import IntArray
from dfsm.numerics.smoothing import checked
from dfsm.numerics.time_mesh import same_instant

# Samples of a piece that tell its derivatives by themselves: where there are samples before and
# after each jump, as many as a smoothing spline needs. Elsewhere, means over intervals are nearer
# to the truth until noise covers them: measured on oscillators with 0.01 to 0.1 % of noise.
_LONG, _LONG_WITHOUT = 20, 200

# Values, first and second derivative of samples on a mesh, and the noise where it is known.
Estimate = tuple[Series, Series, Series, float | None]


class Kinked(NamedTuple):
    """A signal with kinks at its samples.

    Attributes
    ----------
    values, first, second
        Signal and its time derivatives, shape ``(time,)``. At a jump of the inputs the derivatives
        are those after it; of two samples at one instant the first has those before.
    noise_std
        Mean over the pieces that tell one, else None.
    direct
        Where the derivatives come from a piece with enough samples, ``(time,)``; elsewhere they are
        central differences.
    """

    values: Series
    first: Series
    second: Series
    noise_std: float | None
    direct: NDArray[np.bool_]


def piecewise(
    time: Series, values: Series, breaks: IntArray, estimate: Callable[[Series, Series], Estimate]
) -> Kinked:
    """Differentiate a signal between the jumps of the inputs.

    Parameters
    ----------
    time
        Strictly increasing, in s; samples at one instant are one.
    values
        Samples, shape ``(time,)``.
    breaks
        First sample after each jump.
    estimate
        What to do with one piece.

    Raises
    ------
    DfsmError
        Too few samples, or values that are not finite.
    """
    of = np.concatenate([[0], np.cumsum(~same_instant(time))])
    t = time[np.flatnonzero(np.diff(of, prepend=-1))]
    y = np.bincount(of, values) / np.bincount(of)
    checked(t, y)
    borders = np.unique(of[breaks])
    borders = borders[(borders > 0) & (borders < len(t) - 1)]
    written_twice = np.isin(borders, of[:-1][of[:-1] == of[1:]]).all()
    least = (_LONG if written_twice else _LONG_WITHOUT) if len(borders) else 0
    rough = np.gradient(y, t)
    start = np.stack([y, rough, np.gradient(rough, t)])
    before, after = start.copy(), start.copy()
    told_before, told_after = np.zeros(len(t), bool), np.zeros(len(t), bool)
    noise: list[float] = []
    for a, b in pairwise([0, *borders, len(t) - 1]):
        if b + 1 - a < least:
            continue
        *parts, std = estimate(t[a : b + 1], y[a : b + 1])
        noise += [] if std is None else [std]
        piece = np.stack(parts)
        after[:, a:b], before[:, a + 1 : b + 1] = piece[:, :-1], piece[:, 1:]
        told_after[a:b], told_before[a + 1 : b + 1] = True, True
    # At the ends there is one side only.
    before[:, 0], after[:, -1] = after[:, 0], before[:, -1]
    told_before[0], told_after[-1] = told_after[0], told_before[-1]
    first = np.flatnonzero(of[:-1] == of[1:])
    late = np.ones(len(time), bool)
    late[first] = False
    found = np.where(late, after[:, of], before[:, of])
    return Kinked(
        values=((before[0] + after[0]) / 2)[of],
        first=found[1],
        second=found[2],
        noise_std=float(np.mean(noise)) if noise else None,
        direct=np.where(late, told_after[of], told_before[of]),
    )

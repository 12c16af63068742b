"""Inputs of a rollout at any time, as pieces of polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.data.between import Between, polynomials
from dfsm.data.trajectory import Trajectory
from dfsm.numerics.time_mesh import same_instant

# Share of a channel's range by which inputs may leave a polynomial without a bend: rounding.
_STRAIGHT = 1e-9


@dataclass(frozen=True)
class Pieces:
    """Inputs at every time, as a polynomial between each two samples of a run.

    Attributes
    ----------
    time
        The run's samples in s, ``(sample,)``.
    values
        Inputs there, ``(sample, exogenous)``.
    starts
        Where each polynomial begins, in s, ``(piece,)``: at all samples but the last, and but the
        first of two at one instant.
    coefficients
        Of the powers three to none of the time since then, ``(4, piece, exogenous)``.
    bends, after
        Samples at which one polynomial does not go on as the other, in s, ``(bend,)``; the second
        of two at one instant in `after`, else the same.
    """

    time: Array
    values: Array
    starts: Array
    coefficients: Array
    bends: Array
    after: Array


def pieces_of(driven: Trajectory, between: Between | Sequence[Between]) -> Pieces:
    """Interpolate the inputs between samples.

    Parameters
    ----------
    driven
        The exogenous channels of one run.
    between
        What inputs do between samples: one kind for all, or one each.
    """
    time, values, kinds = driven.time, driven.values, each(driven, between)
    apart = np.flatnonzero(~same_instant(time))
    c = polynomials(time, values, kinds)[:, apart]
    steps = np.diff(time)[apart, None]
    degree = np.array([{"hold": 0, "linear": 1, "cubic": 3}[kind] for kind in kinds], dtype=int)
    leading = np.take_along_axis(c, 3 - degree[None, None], axis=0)[0]
    # How far the one polynomial, carried on over the next interval, misses the other.
    missed = np.abs(np.diff(leading, axis=0)) * np.maximum(steps[1:], steps[:-1]) ** degree
    reached = c[3] + steps * (c[2] + steps * (c[1] + steps * c[0]))
    jumped = np.abs(c[3][1:] - reached[:-1])
    least = _STRAIGHT * np.ptp(values, axis=0) + 8 * np.spacing(np.abs(values).max(axis=0))
    bend = (np.maximum(missed, jumped) > least).any(axis=1)
    before, after = time[apart[:-1] + 1][bend], time[apart[1:]][bend]
    return Pieces(time, values, time[apart], c, before, after)


def each(driven: Trajectory, between: Between | Sequence[Between]) -> tuple[Between, ...]:
    """What each input does: `between` may be one for all."""
    if isinstance(between, str):
        return (between,) * len(driven.channels)
    return tuple(between)

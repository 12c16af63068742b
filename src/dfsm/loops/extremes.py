"""Largest values in a life of load cases, extrapolated from the maxima of blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.loops.load_cases import LoadCases
from dfsm.numerics.extremes import block_maxima, extrapolated, fit_gumbel


@dataclass(frozen=True)
class Extreme:
    """A largest value, extrapolated.

    Attributes
    ----------
    value, error
        What is exceeded once in the time asked for, and its standard error, in the channel's unit.
    blocks
        Maxima from which it comes.
    """

    value: float
    error: float
    blocks: int


def channel_maxima(run: Trajectory, channels: Sequence[str], block: float) -> dict[str, Array]:
    """Largest values of blocks of a length in s, by channel, of those that the run holds.

    Raises
    ------
    DfsmError
        There are fewer than five whole blocks.
    """
    found = {}
    for name in channels:
        if name in run:
            try:
                found[name] = block_maxima(run.time, run[name], block)
            except DfsmError as error:
                raise DfsmError(f"extremes of {name}: {error}") from None
    return found


def long_term_extremes(
    channels: Sequence[str],
    maxima: Sequence[Mapping[str, Array]],
    cases: LoadCases,
    blocks: float,
) -> dict[str, Extreme]:
    """What is exceeded once in so many blocks, by channel, of those that all runs hold.

    Parameters
    ----------
    channels
        Names.
    maxima
        Of every run, see `channel_maxima`.
    cases
        Which runs are of one condition: one distribution is fitted to the maxima of all of them.
        Fitted each for itself, the one with the largest scale by chance would decide alone.
    blocks
        Number of blocks, more than 1.
    """
    found = {}
    for name in channels:
        if all(name in of_run for of_run in maxima):
            fits = [fit_gumbel(values) for values in cases.pooled([m[name] for m in maxima])]
            value, error = extrapolated(fits, cases.shares, blocks)
            found[name] = Extreme(value, error, sum(f.maxima for f in fits))
    return found

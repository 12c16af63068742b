"""Samples that stay the same in the middle of a record: a sensor or a logger that stood still.

A channel that stops in mid-motion, or jumps to a value, keeps it for a while, and jumps away from
it was not recorded there. What rests or is at a limit comes to it and leaves it smoothly; what is
held stays and jumps all the time. Neither is told.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory

if TYPE_CHECKING:
    from dfsm.data.readers.long_run import LongRun

# Fewest intervals without a change, and their number relative to the longest that is usual.
_FEWEST, _LONGER = 8, 3
# A channel that stays for more than this share of its intervals is made so.
_STAYS = 0.5
# What is a jump, in usual changes from sample to sample and in those of so many samples after it,
# and what is motion.
_JUMP, _BESIDE, _MOTION = 3.0, 4, 0.3
# Share of the channels that vary which must stand still together to be called all of them.
_ALMOST_ALL = 0.7


@dataclass(frozen=True)
class Stuck:
    """Channels that stand still together.

    Attributes
    ----------
    names
        The channels.
    begin, end
        First and last time in s at which they are the same.
    zero
        Whether they are all zero there.
    """

    names: tuple[str, ...]
    begin: float
    end: float
    zero: bool

    def told(self, everything: bool) -> str:
        """One sentence, which names them or says that it is (almost) every channel."""
        which = "almost every channel" if everything else ", ".join(f"'{n}'" for n in self.names)
        what = "zero" if self.zero else "the same"
        return (
            f"{which} {'is' if everything or len(self.names) == 1 else 'are'} {what} from "
            f"{self.begin:g} to {self.end:g} s, between a stop in mid-motion and a jump, as where "
            "nothing was recorded: cut the run there, or give the two parts as runs"
        )


def stuck_in(run: Trajectory | LongRun, names: Iterable[str] | None = None) -> list[Stuck]:
    """Find where channels stand still in the middle of a run, in the order of time.

    Parameters
    ----------
    run
        The record.
    names
        Channels to look at; None takes all.
    """
    looked = list(run.names if names is None else names)
    spans = {span for name in looked for span in stuck_spans(run[name])}
    if not spans:
        return []
    moving = [n for n in looked if np.mean(np.diff(run[n]) != 0) >= 1 - _STAYS]
    found = []
    for first, last in sorted(spans):
        # One that comes back to where it stood does not jump.
        still = [n for n in moving if (run[n][first : last + 1] == run[n][first]).all()]
        zero = all(run[n][first] == 0 for n in still)
        found.append(Stuck(tuple(still), float(run.time[first]), float(run.time[last]), zero))
    return found


def stuck_notes(run: Trajectory | LongRun, names: Sequence[str] | None = None) -> list[str]:
    """The same in sentences."""
    looked, found = run.names if names is None else names, stuck_in(run, names)
    if not found:
        return []
    varying = sum(bool(np.ptp(run[n]) > 0) for n in looked)
    several = varying > 2
    return [s.told(several and len(s.names) >= _ALMOST_ALL * varying) for s in found]


def stuck_spans(values: Array) -> list[tuple[int, int]]:
    """First and last sample of every span in which samples ``(time,)`` stand still."""
    if not np.isfinite(values).all():
        return []
    still = values[1:] == values[:-1]
    for apart in (1, 2, 4):  # as long as _FEWEST: most records have no such span at all
        still = still[:-apart] & still[apart:]
    if not still.any():
        return []
    steps = np.diff(values)
    moves = np.abs(steps[steps != 0])
    if len(moves) < 2 or len(moves) < (1 - _STAYS) * len(steps):
        return []
    usual = float(np.median(moves))
    at = np.flatnonzero(steps)
    stays = np.diff(at) - 1
    long = stays >= max(_FEWEST, _LONGER * float(np.median(stays)))
    enters, leaves = np.abs(steps[at[:-1]]), np.abs(steps[at[1:]])
    stuck = long & (enters > _MOTION * usual) & (leaves > _JUMP * usual)
    for k in np.flatnonzero(stuck):
        # What leaves a limit goes on as fast as it left.
        after = steps[at[k + 1] + 1 : at[k + 1] + 1 + _BESIDE]
        stuck[k] = leaves[k] > _JUMP * np.sqrt(np.mean(after**2)) if len(after) else True
    return [(int(at[k]) + 1, int(at[k + 1])) for k in np.flatnonzero(stuck)]

"""Runs too long to be held: time and channels as they are, samples channel by channel on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.columns import INDEX
from dfsm.data.trajectory import Channel
from dfsm.numerics.time_mesh import time_step, without_rounding

# Bytes of all samples from which a file is looked at channel by channel.
LONG = 2**27
# Equal rows at an end, from which it may be that they were not recorded.
_ENDS = 3


@dataclass(frozen=True, eq=False)
class LongRun:
    """What `describe` asks of a run, with one channel's samples in memory at a time.

    Attributes
    ----------
    time, channels, name, source, wall_time, notes
        As of a `Trajectory`.
    samples
        Reads the samples ``(time,)`` of a channel, by its place.
    """

    time: Array
    channels: tuple[Channel, ...]
    name: str
    source: str
    samples: Callable[[int], Array]
    wall_time: float | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time)

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names in column order."""
        return tuple(c.name for c in self.channels)

    @cached_property
    def time_step(self) -> float | None:
        """As of a `Trajectory`."""
        return time_step(self.time)

    def channel(self, name: str) -> Channel:
        """Return the description of one channel."""
        return self.channels[self.names.index(name)]

    def __getitem__(self, name: str) -> Array:
        return self.samples(self.names.index(name))


def long_run(
    path: Path,
    time: Array,
    channels: tuple[Channel, ...],
    samples: Callable[[int], Array],
    *,
    name: str | None = None,
    wall_time: float | None = None,
    notes: tuple[str, ...] = (),
) -> LongRun | None:
    """A run as `assemble` makes it, where that changes neither channels nor rows; else None."""
    names = [c.name for c in channels]
    odd = any("invalid" in (c.name.lower(), c.unit.lower()) for c in channels)
    odd = odd or any(n.lower() == "time" or INDEX.fullmatch(n) for n in names)
    if odd or not names or len(set(names)) < len(names) or len(time) < 2 * _ENDS:
        return None
    ends = [(v[:_ENDS].copy(), v[-_ENDS:].copy()) for v in map(samples, range(len(names)))]
    if any(all((end[k] == end[k][0]).all() for end in ends) for k in (0, 1)):
        return None
    time = without_rounding(time)
    if not np.isfinite(time).all() or (time[1:] <= time[:-1]).any():
        return None
    return LongRun(
        time, channels, name or path.stem, str(path), samples, wall_time=wall_time, notes=notes
    )

"""What the inputs of a record were before it begins, for states that remember them.

Nobody knows. What moves at random from the first sample on, wind and waves, moved so before, too:
it is taken to have run backwards. So each latent state starts among the values that it takes later,
however long it remembers; under a mean over some seconds, held for ever, it may start far outside
them. What rests at the first samples rested before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.numerics.time_mesh import mean_over, weights_over_time

# So much of a record's beginning is repeated backwards: seconds or samples, whatever is longer.
_SECONDS, _SAMPLES = 120.0, 100
# A channel that is the same at so many first samples rests.
_STILL = 3


def repeated_until(time: Array) -> int:
    """Index of the last sample that is repeated before the record; times in s, ``(time,)``."""
    inside = int(np.searchsorted(time, time[0] + _SECONDS, side="right")) - 1
    return min(max(inside, _SAMPLES), len(time) - 1)


def with_past(run: Trajectory, held: NDArray[np.bool_]) -> tuple[Trajectory, int, Array]:
    """A record with its beginning backwards in front of it.

    Parameters
    ----------
    run
        Inputs alone, of two samples at least.
    held
        Which of them are held between samples, ``(input,)``.

    Returns
    -------
    tuple
        The longer record, the number of samples in front, and the inputs' mean over these,
        ``(input,)``.
    """
    last, v = repeated_until(run.time), run.values
    time = 2 * run.time[0] - run.time[last:0:-1]
    # The value that is held over an interval stands at its beginning, backwards as forwards.
    before = np.where(held, v[last - 1 :: -1], v[last:0:-1])
    before = np.where((v[:_STILL] == v[0]).all(axis=0), v[0], before)
    mean = mean_over(before, weights_over_time([time])) if last > 1 else before[0]
    longer = replace(run, time=np.concatenate([time, run.time]), values=np.concatenate([before, v]))
    return longer, last, mean

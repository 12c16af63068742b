"""Whether inputs repeat themselves: then no part of a record is new to who has seen another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory

# Mean squared difference between inputs and what they were a period before, relative to that of
# unrelated ones, and the least share of a record that must be there again.
_SAME, _AGAIN = 0.02, 1 / 3


def period(run: Trajectory, names: Sequence[str]) -> float | None:
    """Time in s after which channels do the same again; None where they do not.

    Parameters
    ----------
    run
        With even samples.
    names
        Channels, all of which must repeat; those that rest do.
    """
    table = np.stack([run[n] for n in names], axis=1) if names else np.zeros((0, 0))
    spread = table.std(axis=0) if len(table) else np.zeros(0)
    if len(table) < 2 or not (spread > 0).any():
        return None
    differences = _differences((table - table.mean(axis=0))[:, spread > 0] / spread[spread > 0])
    apart = np.flatnonzero(differences.max(axis=1) > 1)
    if not len(apart):
        return None
    last = round(len(table) * (1 - _AGAIN))
    same = np.flatnonzero(differences[apart[0] : last].max(axis=1) <= 2 * _SAME)
    return None if not len(same) else float(run.time[apart[0] + same[0]] - run.time[0])


def _differences(values: Array) -> Array:
    """Mean squared difference to the values k samples before, ``(k, channel)``."""
    n = len(values)
    each = [scipy.signal.correlate(v, v, mode="full", method="fft")[n - 1 :] for v in values.T]
    products = np.stack(each, axis=1)
    squares = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values**2, axis=0)])
    k = np.arange(n)
    ends = squares[n - k] + squares[n] - squares[k]
    return (ends - 2 * products) / (n - k)[:, None]

"""Limits of an optimal control problem: numbers, functions of time, or channels of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeGuard

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError

# A number, None for no limit, a function of time (array in, array out), or a run with the channel.
Level = float | None | Callable[[Array], Any] | Trajectory
Interval = tuple[Level, Level]
Constraint = tuple[Callable[..., Any], Level, Level]


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is one number, and not a pair."""
    return isinstance(value, int | float | np.number)


def level(limit: Level, name: str, time: Array, default: float) -> Array:
    """Evaluate a limit at times in s.

    Parameters
    ----------
    limit
        See `OptimalControlProblem.bounds`.
    name
        Channel to take from a run.
    time
        Shape ``(time,)``.
    default
        Stands for None.

    Returns
    -------
    ndarray
        Shape ``(time,)``.

    Raises
    ------
    DfsmError
        The limit gives another number of values.
    """
    if limit is None:
        return np.full(len(time), default)
    if isinstance(limit, Trajectory):
        return limit.select([name]).resample(time).values[:, 0]
    value = np.asarray(limit(time) if callable(limit) else limit, dtype=np.float64)
    if value.shape not in ((), np.shape(time)):
        raise DfsmError(
            f"a limit of '{name}' has shape {value.shape} at {len(time)} times: a function of time "
            "takes an array and returns one number or one per time"
        )
    return np.broadcast_to(value, np.shape(time)).copy()

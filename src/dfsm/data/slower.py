"""Channels with fewer samples than their table: two loggers' rates merged into one.

Between its samples such a channel is empty. Whether it stays as it was (a command that a digital
controller holds) or goes on in straight lines (a slow sensor) no table tells, so it is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from dfsm.core.types import Array
from dfsm.data.signs import moments
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, missing
from dfsm.numerics.time_mesh import own_interval

Way = Literal["hold", "linear"]
# What one channel does, or each of several.
Slower = Way | Mapping[str, Way] | None


def fill_slower(run: Trajectory, between: Slower) -> Trajectory:
    """Fill the channels of a run that have fewer samples than its table.

    Parameters
    ----------
    run
        Any run.
    between
        What such channels do between their samples, ``"hold"`` or ``"linear"``: all of them, or
        by name. None leaves the run as it is. A channel named ``"linear"`` that the file holds
        from sample to sample at a regular interval counts as one that is empty in between.

    Returns
    -------
    Trajectory
        Cut to the time that all filled channels cover; a held one covers the interval behind its
        last sample. Notes tell the intervals. The run itself where nothing is to be filled.

    Raises
    ------
    DfsmError
        An unknown channel or way, or a channel whose samples are not regular.
    """
    if between is None:
        return run
    ways = {n: between for n in run.names} if isinstance(between, str) else dict(between)
    if lost := [n for n in ways if n not in run]:
        raise DfsmError(f"{run.where}: slower: {missing(lost, run.names)}")
    values, notes = run.values.copy(), []
    start, stop = run.time[0], run.time[-1]
    for name, way in ways.items():
        if way not in ("hold", "linear"):
            raise DfsmError(f"slower is '{way}' for '{name}', expected hold or linear")
        column = run.column(name)
        present = np.isfinite(values[:, column])
        if way == "linear" and not isinstance(between, str) and present.all():
            present = moments(values[:, column])
        interval = own_interval(run.time, present)
        if interval is None:
            if not isinstance(between, str) and not present.all():
                raise DfsmError(
                    f"{run.where}: channel '{name}' is no slower channel, its samples are not "
                    "regular: leave the channel or that part of the run out"
                )
            continue
        mesh = run.time[present]
        values[:, column] = _filled(run.time, mesh, values[present, column], way)
        start = max(start, mesh[0])
        stop = min(stop, mesh[-1] + interval * (1 + 1e-6) if way == "hold" else mesh[-1])
        doing = "held" if way == "hold" else "joined by straight lines"
        notes.append(f"'{name}' has one sample every {interval:g} s, {doing} in between")
    if not notes:
        return run
    filled = replace(run, values=values, notes=(*run.notes, *notes))
    return filled.window(start, stop)


def _filled(time: Array, mesh: Array, samples: Array, way: Way) -> Array:
    if way == "linear":
        return np.interp(time, mesh, samples)
    return samples[np.maximum(np.searchsorted(mesh, time, side="right") - 1, 0)]


def slower_warning(time: Array, values: Array, name: str) -> str | None:
    """Say that a channel has fewer samples ``(time,)`` than its table, if it has.

    Returns
    -------
    str | None
        One sentence that does not name the run; None where its gaps are of another kind.
    """
    interval = own_interval(time, np.isfinite(values))
    if interval is None:
        return None
    return (
        f"channel '{name}' has one sample every {interval:g} s only: say what it does in between "
        f"with data.slower: {{{name}: hold}} or linear"
    )

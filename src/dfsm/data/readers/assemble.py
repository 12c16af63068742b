"""What every reader shares: the file must exist, and channel names must be usable afterwards."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.ends import recorded_rows
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.numerics.time_mesh import without_rounding


def assemble(
    path: Path,
    time: Array,
    values: Array,
    channels: Sequence[Channel],
    *,
    name: str | None = None,
    wall_time: float | None = None,
    notes: Iterable[str] = (),
) -> Trajectory:
    """Build a trajectory from what a file holds, with every channel name usable once.

    Channels that OpenFAST calls `Invalid` are left out. Where a name stands twice, the later
    channel is left out if its data are the same and called ``Name#2`` if they differ. Rows at
    either end that were not recorded are left out. Times that are equidistant but for the rounding
    of their file are equidistant. Each change is told in `Trajectory.notes`.

    Parameters
    ----------
    path
        The file; its stem is the run's name unless there is a `name`.
    time
        Time mesh in s, shape ``(time,)``.
    values
        Samples, shape ``(time, channel)``, in the channels' units.
    channels
        One per column, as in the file.
    name, wall_time, notes
        See `Trajectory`.

    Raises
    ------
    DfsmError
        No channel is left, or the time mesh does not increase.
    """
    told = list(notes)
    valid = [i for i, c in enumerate(channels) if "invalid" not in (c.name.lower(), c.unit.lower())]
    if dropped := len(channels) - len(valid):
        which = ", ".join(str(i + 1) for i in range(len(channels)) if i not in set(valid))
        told.append(
            f"{dropped} channel{'s' * (dropped > 1)} marked Invalid left out (number {which}): "
            "the simulator did not know the name that was asked for"
        )
    keep, named = _name_once(values, channels, valid, told)
    if not keep:
        raise DfsmError(f"{path}: no channel besides time, at least one is needed")
    values = values[:, keep]
    if len(values) > 1:
        rows, lost = recorded_rows(time, values)
        time, values = without_rounding(time[rows]), values[rows]
        told += lost
    return Trajectory(
        time,
        values,
        tuple(named),
        name=name or path.stem,
        source=str(path),
        wall_time=wall_time,
        notes=tuple(told),
    )


def _name_once(
    values: Array, channels: Sequence[Channel], valid: list[int], notes: list[str]
) -> tuple[list[int], list[Channel]]:
    """Columns to keep and their channels under unique names; what changes is added to `notes`."""
    taken = {channels[i].name for i in valid}
    first: dict[str, int] = {}
    keep: list[int] = []
    named: list[Channel] = []
    for i in valid:
        channel = channels[i]
        if channel.name in first:
            if np.array_equal(values[:, i], values[:, first[channel.name]], equal_nan=True):
                notes.append(f"channel '{channel.name}' stands twice with the same data: kept once")
                continue
            channel = replace(channel, name=_free_name(channel.name, taken))
            taken.add(channel.name)
            notes.append(
                f"channel '{channels[i].name}' stands twice with different data: the later one is "
                f"called '{channel.name}'"
            )
        else:
            first[channel.name] = i
        keep.append(i)
        named.append(channel)
    return keep, named


def _free_name(name: str, taken: set[str]) -> str:
    number = 2
    while f"{name}#{number}" in taken:
        number += 1
    return f"{name}#{number}"

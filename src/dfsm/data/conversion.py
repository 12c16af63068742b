"""A run in the units of others: a model's, a solution's, those of other runs."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace

from dfsm.core.units import agree, conversion, factor, known
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning, printable

_NOTE = "units converted: "


def in_one_unit(runs: Sequence[Trajectory], names: Iterable[str]) -> list[Trajectory]:
    """Convert channels to the unit that most of some runs have, where one can.

    Parameters
    ----------
    runs
        In any order.
    names
        Channels; runs that lack one are passed over.

    Returns
    -------
    list of Trajectory
        Units of other dimensions stay as they are: which one is wrong nobody knows.

    Warns
    -----
    DfsmWarning
        What was converted, which stands in the runs' notes, too.
    """
    wanted = []
    for name in dict.fromkeys(names):
        units = [run.channel(name).unit for run in runs if name in run]
        units = [unit for unit in units if known(unit)]
        if not units or all(agree(units[0], unit) for unit in units):
            continue
        # In the order of their spelling, for the order of files must not matter.
        usual = max(sorted(set(units)), key=lambda u: sum(agree(u, other) for other in units))
        if all(factor(unit, usual) is not None for unit in units):
            wanted.append(Channel(name, usual))
    if not wanted:
        return list(runs)
    alike = [in_units_of(run, wanted, "the other runs") for run in runs]
    tell_converted(runs, alike)
    return alike


def in_units_of(
    run: Trajectory, channels: Iterable[Channel], whose: str = "the model"
) -> Trajectory:
    """Convert channels of a run to the units that other channels of their names have.

    Parameters
    ----------
    run
        The run.
    channels
        Names and units wanted; those that the run lacks are passed over.
    whose
        Who has these channels, for messages.

    Returns
    -------
    Trajectory
        The run itself where nothing differs. What was converted stands in its notes, and its
        quantisation steps are converted, too. A channel whose unit nobody knows, here or there,
        and one whose unit is only spelled in another way, stay as they are.

    Raises
    ------
    DfsmError
        A unit is of another dimension, or in no table.
    """
    values, described, told = None, list(run.channels), list[str]()
    for wanted in channels:
        if wanted.name not in run or agree(run.channel(wanted.name).unit, wanted.unit):
            continue
        column = run.column(wanted.name)
        own = described[column]
        change = conversion(own.unit, wanted.unit)
        if change is None:
            raise DfsmError(
                f"{run.where}: '{own.name}' is in '{own.unit}', in {whose} in '{wanted.unit}', and "
                "one cannot be converted into the other: name the right channel, or correct the "
                "unit"
            )
        scale, zero = change
        values = run.values.copy() if values is None else values
        values[:, column] = values[:, column] * scale + zero
        step = None if own.step is None else own.step * scale
        described[column] = replace(own, unit=wanted.unit, step=step)
        told.append(f"'{own.name}' from {own.unit} to {wanted.unit}")
    if values is None:
        return run
    note = f"{_NOTE}{', '.join(dict.fromkeys(told))}, as in {whose}"
    # Features are computed, and converted, each time that a run is completed.
    notes = run.notes if note in run.notes else (*run.notes, note)
    return replace(run, values=values, channels=tuple(described), notes=notes)


def converted(before: Sequence[Trajectory], after: Sequence[Trajectory]) -> list[str]:
    """What was converted in some runs, one sentence for those of which the same is to be said."""
    where: dict[str, list[str]] = {}
    for old, new in zip(before, after, strict=True):
        for note in new.notes[len(old.notes) :]:
            if note.startswith(_NOTE):
                where.setdefault(note, []).append(new.where)
    return [
        printable(f"{runs[0]}" + f" and {len(runs) - 1} more" * (len(runs) > 1) + f": {note}")
        for note, runs in where.items()
    ]


def tell_converted(before: Sequence[Trajectory], after: Sequence[Trajectory]) -> None:
    """Warn of what was converted, see `converted`."""
    for text in converted(before, after):
        warnings.warn(text, DfsmWarning, stacklevel=3)

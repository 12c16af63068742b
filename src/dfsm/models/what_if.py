"""Other inputs for a recorded run: channels changed by constants, or taken from another table."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence

import numpy as np

from dfsm.core.units import known
from dfsm.data.conversion import in_units_of, tell_converted
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning, near_matches, printable
from dfsm.models.completion import read_by
from dfsm.models.signals import SignalTable

_CHANGE = re.compile(r"\s*(?P<name>.+?)\s*(?P<sign>[-+*]?=)\s*(?P<value>[^\s=]+)\s*")


def with_changes(run: Trajectory, changes: Sequence[str], signals: SignalTable) -> Trajectory:
    """A run with constants set, added, taken off or multiplied.

    Parameters
    ----------
    run
        As recorded; what a model computes from its channels is computed later.
    changes
        ``"BldPitch1 += 1"``, or with ``=``, ``-=``, ``*=``, one after the other, in the units of
        the run; ``=`` adds a channel that the run lacks, in the unit of the model.
    signals
        The model's: it says which channels have an effect.

    Raises
    ------
    DfsmError
        No such form or number, a channel that the run lacks, that the model does not take or that
        it computes from others.
    """
    taken = {c.name: c for c in _taken(signals)}
    for text in changes:
        what = f"--set '{printable(text)}'"
        match = _CHANGE.fullmatch(text)
        if match is None:
            raise DfsmError(
                f"{what} is no change of a channel: write NAME = NUMBER, or +=, -= or *= for ="
            )
        name, sign = match["name"], match["sign"]
        value = _number(what, match["value"])
        _check_taken(what, name, taken, signals)
        if sign == "=":
            channel = name if name in run else Channel(name, taken[name].unit)
            run = run.with_channels(channel, value, replace=True)
            continue
        if name not in run:
            raise DfsmError(f"{what}: {run.where} has no channel '{name}': set it with = first")
        old = run[name]
        new = old * value if sign == "*=" else old + (value if sign == "+=" else -value)
        run = run.with_channels(name, new, replace=True)
    return run


def with_inputs(
    run: Trajectory,
    source: Trajectory,
    signals: SignalTable,
    start: float | None = None,
    stop: float | None = None,
) -> Trajectory:
    """A run whose inputs are those of another table, as far as that one holds them.

    Parameters
    ----------
    run
        As recorded.
    source
        Table with some of the model's inputs; linear between its samples. Before it begins, the
        run's own samples stay.
    signals
        The model's.
    start, stop
        Time window in s of the simulation, which `source` has to cover; None is an end of the run.

    Raises
    ------
    DfsmError
        No column is an input of the model, the table does not cover the window, or a unit is of
        another dimension than the model's.

    Warns
    -----
    DfsmWarning
        Columns that are no inputs, and samples closer than the run's.
    """
    inputs = {c.name for c in _taken(signals)} - set(signals.measured)
    names = [n for n in source.names if n in inputs]
    if not names:
        raise DfsmError(
            f"{source.where}: none of its columns is an input of the model, which takes "
            f"{', '.join(sorted(inputs))}: {near_matches(source.names[0], sorted(inputs))}"
        )
    first = run.time[0] if start is None else start
    last = run.time[-1] if stop is None else stop
    slack = 1e-9 * run.duration
    if source.time[0] > first + slack or source.time[-1] < last - slack:
        raise DfsmError(
            f"{source.where}: its inputs last from {source.time[0]:g} s to {source.time[-1]:g} s, "
            f"the simulation from {first:g} s to {last:g} s: give a longer table, or --start and "
            "--stop"
        )
    _tell(source, names, run)
    chosen = source.select(names).require_finite()
    source = in_units_of(chosen, read_by(signals))
    tell_converted([chosen], [source])
    inside = (run.time >= source.time[0] - slack) & (run.time <= source.time[-1] + slack)
    for channel in source.channels:
        values = np.interp(run.time, source.time, source[channel.name])
        if channel.name in run:
            own = in_units_of(run.select([channel.name]), [channel], "the inputs")
            values = np.where(inside, values, own[channel.name])
            if not known(channel.unit):
                channel = own.channels[0]
        run = run.with_channels(channel, values, replace=True)
    return run


def _taken(signals: SignalTable) -> list[Channel]:
    """Channels whose samples a simulation depends on; measured states for where it starts."""
    units = {c.name: c for c in read_by(signals)}
    computed = {f.name for f in signals.features}
    sources = [n for f in signals.features for n in f.sources]
    if signals.hub_height is not None:
        sources += ["RtVAvgxh", "PtfmRVyt"]
    names = (*signals.exogenous, *signals.names("field"), *sources, *signals.measured)
    return [units.get(n, Channel(n)) for n in dict.fromkeys(names) if n not in computed]


def _check_taken(what: str, name: str, taken: dict[str, Channel], signals: SignalTable) -> None:
    if name in taken:
        return
    for feature in signals.features:
        if feature.name == name:
            raise DfsmError(
                f"{what}: '{name}' is computed from {' and '.join(feature.sources)}: change that"
            )
    raise DfsmError(
        f"{what} would have no effect, the model takes no '{name}' from a run; "
        f"{near_matches(name, taken)}"
    )


def _number(what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise DfsmError(f"{what}: '{printable(text)}' is no finite number: write one, as in 0.5")
    return value


def _tell(source: Trajectory, names: Sequence[str], run: Trajectory) -> None:
    ignored = [n for n in source.names if n not in names]
    if ignored:
        warnings.warn(
            f"{source.where}: {', '.join(ignored[:6])}{', …' if ignored[6:] else ''} "
            f"{'are' if ignored[1:] else 'is'} no input of the model and not used",
            DfsmWarning,
            stacklevel=3,
        )
    steps = [float(np.median(np.diff(r.time))) for r in (source, run)]
    if steps[0] < 0.99 * steps[1]:
        warnings.warn(
            f"{source.where}: samples every {steps[0]:.3g} s, but {run.where} every "
            f"{steps[1]:.3g} s: what lies between those is not seen, resample the run first",
            DfsmWarning,
            stacklevel=3,
        )

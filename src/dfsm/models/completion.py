"""Runs as a model takes them: in its units, with the channels that are computed from others.

All that meets recorded runs with a model comes through here: simulation, initial states,
validation, intervals, refinement, and the disturbances of optimal control.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dfsm.data.conversion import in_units_of, tell_converted
from dfsm.data.derivatives import per_second
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.models.signals import SignalTable, with_computed


def completed(run: Trajectory, signals: SignalTable, *, compute: bool = True) -> Trajectory:
    """Take a run to the units of a model, and add what the model computes from its channels.

    Parameters
    ----------
    run
        The whole record.
    signals
        The model's. A channel without a unit, in the run or in the model, passes as it is.
    compute
        Whether to compute channels; without, the run is taken to hold them.

    Returns
    -------
    Trajectory
        As recorded where nothing is to be done; completing it again changes nothing.

    Raises
    ------
    DfsmError
        A channel is of another dimension than in the model, or as `with_computed`.

    Warns
    -----
    DfsmWarning
        Which channels were converted.
    """
    return all_completed([run], signals, compute=compute)[0]


def all_completed(
    runs: Sequence[Trajectory], signals: SignalTable, *, compute: bool = True
) -> list[Trajectory]:
    """Complete several runs, with one warning for all of them; see `completed`."""
    channels = list(read_by(signals))
    results = []
    for run in runs:
        result = in_units_of(run, channels)
        if compute:
            result = with_computed(result, signals.hub_height, signals.features)
            # A feature has the unit of its source, which need not be a channel of the model.
            result = in_units_of(result, channels)
        results.append(result)
    tell_converted(runs, results)
    return results


def read_by(signals: SignalTable) -> Iterator[Channel]:
    """Channels that a model takes from a run or is compared with there, in its units."""
    yield from (*signals.inputs, *signals.outputs, *signals.field)
    units = {c.name: c.unit for c in signals.states}
    for spec in signals.specs:
        first = per_second(units[spec.name])
        if spec.rate is not None:
            yield Channel(spec.rate, first)
        if spec.acceleration is not None:
            yield Channel(spec.acceleration, per_second(first))
    if signals.azimuth is not None and signals.azimuth.angle is not None:
        yield Channel(signals.azimuth.angle, "deg")

"""What rollouts over runs that were left out are off by, begun at several times of each run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dfsm.data.trajectory import Trajectory
from dfsm.errors import hushed
from dfsm.models.dfsm import DFSM
from dfsm.models.recorded import recorded_states
from dfsm.simulation.simulate import Simulation, SimulationSettings, Status, simulate
from dfsm.validation.growth import RolloutErrors
from dfsm.validation.intervals import schedule_along
from dfsm.validation.validate import recorded_channels

# Where rollouts begin, as shares of the window: the first is the one that is promised about, the
# others tell how errors grow apart from what happens when in a run.
_BEGINNINGS = (0.0, 0.25, 0.5, 0.75)
# Rollouts that begin late are judged if they have this many samples.
_FEWEST_SAMPLES = 20


def rollout_errors(
    model: DFSM,
    runs: Sequence[Trajectory],
    groups: Sequence[str],
    *,
    start: float | None = None,
    stop: float | None = None,
    settings: SimulationSettings | None = None,
) -> tuple[list[RolloutErrors], list[Simulation]]:
    """Simulate runs from several beginnings and compare with the record.

    Parameters
    ----------
    model
        Trained without the runs.
    runs
        With all channels of the model, in its units.
    groups
        Per run the group that is left out with it.
    start, stop
        Window in s.
    settings
        How the model is simulated.

    Returns
    -------
    tuple
        One entry per rollout, and the rollouts that ended early, which have none beyond.
    """
    windows = [run.window(start, stop) for run in runs]
    truths = []
    for run, window in zip(runs, windows, strict=True):
        seen = recorded_states(model, run, start).trajectory.window(start, stop)
        truths.append(recorded_channels(model, window, seen))
    parts, ended = list[RolloutErrors](), list[Simulation]()
    for share in _BEGINNINGS:
        begins = [float(w.time[0] + share * w.duration) for w in windows]
        for begin in sorted(set(begins)):
            rows = [k for k, b in enumerate(begins) if b == begin]
            if share:
                rows = [k for k in rows if (windows[k].time >= begin).sum() >= _FEWEST_SAMPLES]
            if not rows:
                continue
            rollouts = _simulated(model, [runs[k] for k in rows], (begin, stop), settings)
            for k, rollout in zip(rows, rollouts, strict=True):
                if rollout.status is Status.COMPLETED:
                    parts.append(_compared(model, runs[k], rollout, truths[k], groups[k]))
                else:
                    ended.append(rollout)
    return parts, ended


def _simulated(
    model: DFSM,
    runs: Sequence[Trajectory],
    window: tuple[float, float | None],
    settings: SimulationSettings | None,
) -> list[Simulation]:
    with hushed():
        return simulate(model, runs, start=window[0], stop=window[1], settings=settings)


def _compared(
    model: DFSM, run: Trajectory, rollout: Simulation, truth: Trajectory, group: str
) -> RolloutErrors:
    simulated = rollout.trajectory
    recorded = truth.window(float(simulated.time[0]), None)
    names = recorded.names
    return RolloutErrors(
        group=group,
        lag=simulated.time - simulated.time[0],
        schedule=schedule_along(model.schedule, run, simulated),
        distance=np.asarray(rollout.distance),
        errors=simulated.select(names).values - recorded.values[: len(simulated)],
    )

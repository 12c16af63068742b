"""A controller on a model: closed loops along recorded runs, driven by wind and waves only.

The run gives disturbances, the state at the start, and controls that the controller does not set.
From the start on nothing else of the record enters: what follows is the model's and the
controller's own.
"""

from __future__ import annotations

import enum
import os
import time as clock
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from typing import TypeVar, overload

import numpy as np

from dfsm.controllers.controller import Controller
from dfsm.controllers.traced import as_arrays, is_compiled
from dfsm.core.host import from_host
from dfsm.core.progress import track
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmWarning, printable
from dfsm.models.departures import MUCH_OUTSIDE, Departure, departures, told
from dfsm.models.dfsm import DFSM
from dfsm.models.staged import staged
from dfsm.numerics.time_mesh import mean_over, weights_over_time
from dfsm.simulation.drawn_run import DrawnRun
from dfsm.simulation.loop import Drive, HostLoop, Path, outside_along, roll_compiled
from dfsm.simulation.loop_cases import (
    ClosedLoopSettings,
    LoopCase,
    checked_loops,
    enough_calls,
    padded,
    prepared_cases,
)
from dfsm.simulation.outcome import ESCAPE
from dfsm.simulation.own_loop import own_to_a_loop
from dfsm.simulation.wires import Wires, connect, not_commanded

# What is kept of a closed loop.
Reduced = TypeVar("Reduced")
# Places of a loop's run and controller.
Task = tuple[int, int]


class LoopStatus(enum.Enum):
    """How a closed loop ended; the value says what it means and what to do."""

    COMPLETED = "completed"
    UNSTABLE = (
        "the loop is unstable: a state left the training range by a factor of ten; take smaller "
        "gains or a shorter interval, and see with dfsm validate whether the model is good there"
    )
    CONTROLLER_FAILED = "the controller set no number: look at its gains, filters and tables"


@dataclass(frozen=True)
class ClosedLoopRun(DrawnRun):
    """A closed loop along one run.

    Attributes
    ----------
    trajectory
        States, controls and outputs on the run's time mesh from the end of the start-up to where
        the loop ended; roles are set. All of the loop, if it ended before.
    status
        How it ended.
    ended
        Last time in s.
    reason
        For a loop that did not complete, the signal and where; else "".
    outside
        Share of the time with any input of the model outside its training range; not a number
        where nobody asked.
    departures
        Where it left the training range, those that lasted longest first.
    wall_time
        Seconds it took (of the whole batch divided by its runs), without compilation when warm.
    """

    trajectory: Trajectory
    status: LoopStatus
    ended: float
    reason: str
    outside: float
    wall_time: float = 0.0
    departures: tuple[Departure, ...] = ()

    def __repr__(self) -> str:
        run, outcome = self.trajectory, self.status.name.lower().replace("_", " ")
        return (
            f"<ClosedLoopRun of {printable(run.name)}: {outcome}, {run.time[0]:g} to "
            f"{self.ended:g} s, {len(run)} samples; {printable(self.message)}>"
        )

    @property
    def message(self) -> str:
        """One sentence on the outcome."""
        if self.status is LoopStatus.COMPLETED:
            where = f": {told(self.departures)}" if self.departures else ""
            return f"{self.outside:.1%} of the time outside the training range{where}"
        return f"{self.reason}; {self.status.value}"


@overload
def closed_loop(
    model: DFSM,
    runs: Trajectory,
    controller: Controller,
    *,
    start: float | None = None,
    stop: float | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
) -> ClosedLoopRun: ...
@overload
def closed_loop(
    model: DFSM,
    runs: Sequence[Trajectory],
    controller: Controller,
    *,
    start: float | None = None,
    stop: float | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
) -> list[ClosedLoopRun]: ...
def closed_loop(
    model: DFSM,
    runs: Trajectory | Sequence[Trajectory],
    controller: Controller,
    *,
    start: float | None = None,
    stop: float | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
) -> ClosedLoopRun | list[ClosedLoopRun]:
    """Close the loop between a model and a controller along one run, or many.

    Parameters
    ----------
    model
        The surrogate.
    runs
        Trajectories that hold the model's controls, disturbances and parameters, and its measured
        states. After the loop has begun only disturbances and parameters are read, and controls
        that the controller does not set.
    controller
        Steps at its interval and holds its commands in between. An equinox module is compiled with
        the plant; any other `Controller`, a `BladedLibrary` say, is called on the host. One that
        can change is copied for every loop, so that nothing of one run enters another.
    start, stop
        Time window in s that is scored; None leaves that end open.
    measurements
        Signal of the model by measurement of the controller, where names differ:
        ``{"NcIMURAys": "PtfmPitch_dot_dot"}`` takes the derivative of the state PtfmPitch_dot.
    settings
        Start-up and plant steps.

    Returns
    -------
    ClosedLoopRun or list of ClosedLoopRun
        In the order of `runs`.

    Raises
    ------
    DfsmError
        What was given is no model, run, controller or settings; the model lacks what the controller
        reads or sets, a channel is missing or not finite, a run is not longer than the start-up, or
        a library refuses.

    Warns
    -----
    DfsmWarning
        A control stays as recorded, a loop ended early, or was outside the training range for part
        of the time.
    """
    batch = checked_loops(model, runs, [controller], measurements, settings)
    if kept := not_commanded(model, controller):
        warnings.warn(
            f"the controller does not set {', '.join(kept)}: recorded values are taken",
            DfsmWarning,
            stacklevel=2,
        )
    (results,) = closed_loops(
        model,
        batch,
        [controller],
        window=(start, stop),
        measurements=measurements,
        settings=settings,
    )
    _warn(results)
    return results[0] if isinstance(runs, Trajectory) else results


def closed_loops(
    model: DFSM,
    runs: Sequence[Trajectory],
    controllers: Sequence[Controller],
    *,
    window: tuple[float | None, float | None] = (None, None),
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
) -> list[list[ClosedLoopRun]]:
    """Close the loop with each of several controllers over each of several runs.

    Compiled controllers that differ in numbers only share one compilation.

    Parameters
    ----------
    model, runs, measurements, settings
        As for `closed_loop`.
    controllers
        Any number.
    window
        Start and stop of what is scored in s.

    Returns
    -------
    list of list of ClosedLoopRun
        Per controller, in the order of `runs`.

    Raises
    ------
    DfsmError
        As `closed_loop`.
    """
    begin = clock.perf_counter()
    batch = _Batch(model, runs, controllers, measurements, window, settings)
    results = batch.each(lambda run, _: run, watched=True)
    wall = (clock.perf_counter() - begin) / max(1, sum(map(len, results)))
    return [[replace(run, wall_time=wall) for run in of_one] for of_one in results]


def reduced_loops(
    model: DFSM,
    runs: Sequence[Trajectory],
    controllers: Sequence[Controller],
    reduce: Callable[[ClosedLoopRun, Task], Reduced],
    *,
    window: tuple[float | None, float | None] = (None, None),
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
    known: Mapping[Task, Reduced] | None = None,
) -> list[list[Reduced]]:
    """As `closed_loops`, of which only what `reduce` makes of each loop is kept.

    Parameters
    ----------
    model, runs, controllers, window, measurements, settings
        As for `closed_loops`.
    reduce
        Called in threads as soon as a loop is closed, with its run's and its controller's place.
        How long it is outside the training range is not a number.
    known
        What is known already, by both places: these loops are not closed.
    """
    batch = _Batch(model, runs, controllers, measurements, window, settings)
    return batch.each(reduce, known=known)


@dataclass(frozen=True)
class _Batch:
    """Closed loops of several controllers over several runs."""

    model: DFSM
    runs: Sequence[Trajectory]
    controllers: Sequence[Controller]
    measurements: Mapping[str, str] | None
    window: tuple[float | None, float | None]
    settings: ClosedLoopSettings | None

    def each(
        self,
        reduce: Callable[[ClosedLoopRun, Task], Reduced],
        watched: bool = False,
        known: Mapping[Task, Reduced] | None = None,
    ) -> list[list[Reduced]]:
        """What `reduce` makes of every loop, per controller in the order of the runs."""
        model, controllers = self.model, self.controllers
        runs = checked_loops(model, self.runs, controllers, self.measurements, self.settings)
        count = len(runs)
        settings = self.settings or ClosedLoopSettings()
        wires = [connect(model, controller, self.measurements) for controller in controllers]
        intervals = [float(c.interval) for c in controllers]
        cases = {i: prepared_cases(model, runs, i, self.window, settings) for i in set(intervals)}
        ready, cores = staged(model), os.cpu_count() or 1
        pairs = zip(wires, controllers, strict=True)
        rollers = [_roller(ready, its, controller, watched) for its, controller in pairs]

        @lru_cache(maxsize=2 * cores)
        def drive(interval: float, run: int) -> Drive:
            case = cases[interval][run]
            return padded(case, enough_calls(case))

        def closed(task: Task) -> Reduced:
            run, i = task
            case = cases[intervals[i]][run]
            path = rollers[i](case, partial(drive, intervals[i], run))
            return reduce(result_of(model, wires[i], controllers[i], case, path), task)

        # All controllers of a run after one another, so that its drive is made once and not kept.
        # XLA keeps a loop on one core, and one that holds several controllers side by side costs
        # more than these in turn; libraries wait in processes of their own.
        found = dict(known or {})
        tasks = [t for t in product(range(count), range(len(controllers))) if t not in found]
        with ThreadPoolExecutor(cores) as pool:
            done = track(pool.map(closed, tasks), "closed loops", len(tasks))
            found |= dict(zip(tasks, done, strict=True))
        return [[found[run, i] for run in range(count)] for i in range(len(controllers))]


def _roller(
    model: DFSM, wires: Wires, controller: Controller, watched: bool
) -> Callable[[LoopCase, Callable[[], Drive]], Path]:
    """What closes the loop over one case, or over its drive that is padded for all controllers."""
    if not is_compiled(controller):
        host, low, high = HostLoop(model, wires), *_bounds(model)

        def gone(x: Array) -> bool:
            return not bool(((x >= low) & (x <= high)).all())

        def stepped(case: LoopCase, _: Callable[[], Drive]) -> Path:
            with own_to_a_loop(controller) as law:
                return host.roll(law, padded(case, len(case.drive.time) + 1), gone)

        return stepped
    numbers = as_arrays(controller)

    def compiled(_: LoopCase, padded_drive: Callable[[], Drive]) -> Path:
        drive = padded_drive()
        path = roll_compiled(model, wires, numbers, drive)
        return path._replace(outside=outside_along(model, drive, path)) if watched else path

    return compiled


# -- judging the outcome ------------------------------------------------------------------------


def _bounds(model: DFSM) -> tuple[Array, Array]:
    """Lowest and highest states before a loop counts as unstable."""
    columns = model.signals.state_columns
    low, high = np.asarray(model.region.low)[columns], np.asarray(model.region.high)[columns]
    middle, half = (low + high) / 2, (high - low) / 2
    return middle - ESCAPE * half, middle + ESCAPE * half


def result_of(
    model: DFSM, wires: Wires, controller: Controller, case: LoopCase, path: Path
) -> ClosedLoopRun:
    """Judge how a closed loop ended, and sample it as the run."""
    s, steps = model.signals, case.rows
    states, controls, outputs = (
        np.asarray(a)[:steps] for a in (path.states, path.controls, path.outputs)
    )
    time = float(case.drive.time[0]) + float(case.drive.h[0]) * np.arange(steps)
    low, high = _bounds(model)
    escaped = ~((states >= low) & (states <= high))
    status, reason, end = LoopStatus.COMPLETED, "", steps
    if rows := np.flatnonzero(escaped.any(axis=1)).tolist():
        end = rows[0]
        column = int(np.flatnonzero(escaped[end])[0])
        state, value = s.states[column], states[end, column]
        status = LoopStatus.UNSTABLE
        reason = f"{state.name} reached {value:.4g} {state.unit} at {time[end]:g} s"
    commanded = controls[:, list(wires.commanded)]
    failed = np.flatnonzero(~np.isfinite(commanded[:end]).all(axis=1))
    if len(failed):
        end = int(failed[0])
        status = LoopStatus.CONTROLLER_FAILED
        reason = _failure(controller, path, commanded[end], (end // case.per_call, time[end]))
    channels = tuple(
        replace(c, role=role)
        for group, role in (("states", "state"), ("controls", "control"), ("outputs", "output"))
        for c in getattr(s, group)
    )
    values = case.sampled(np.concatenate([states, controls, outputs], axis=1))
    outside = np.full(len(values), np.nan)
    if path.outside is not None:
        outside = case.sampled(np.asarray(path.outside)[:steps, None].astype(float))[:, 0]
    result = _cut(case, (values, outside), channels, (status, reason, time[min(end, steps - 1)]))
    if not (result.outside > 0 and status is LoopStatus.COMPLETED):
        return result
    exogenous = from_host(np.asarray(case.drive.inputs)[::2][:steps])
    _, w, p = s.order.split_exogenous(exogenous)
    inputs = case.sampled(np.asarray(model.join(states, controls, w, p)))
    kept = slice(len(inputs) - len(result.trajectory), None)
    found = departures(
        model.region, s.inputs, result.trajectory.time, inputs[kept], outside[kept] > 0
    )
    return replace(result, departures=found)


def _failure(controller: Controller, path: Path, commanded: Array, at: tuple[int, float]) -> str:
    """Which command is no number, and whether a measurement was one."""
    call, time = at
    seen = np.asarray(path.measurements)[call]
    if not np.isfinite(seen).all():
        name = controller.measurements[int(np.flatnonzero(~np.isfinite(seen))[0])]
        return f"the measurement {name} is {seen[~np.isfinite(seen)][0]} at {time:g} s"
    column = int(np.flatnonzero(~np.isfinite(commanded))[0])
    return f"{controller.commands[column]} is {commanded[column]} at {time:g} s"


def _cut(
    case: LoopCase,
    sampled: tuple[Array, Array],
    channels: Sequence[Channel],
    ending: tuple[LoopStatus, str, float],
) -> ClosedLoopRun:
    """The result up to where the loop ended, without the start-up where something is left."""
    (values, outside), (status, reason, ended), run = sampled, ending, case.run
    rows = len(run)
    if status is not LoopStatus.COMPLETED:
        rows = int(np.searchsorted(run.time, ended, side="right"))
    first = case.scored if rows >= case.scored + 2 else 0
    kept = slice(first, max(rows, first + 2))
    part = Trajectory(
        run.time[kept], values[kept], tuple(channels), name=run.name, source=run.source
    )
    share = float(mean_over(outside[kept], weights_over_time([part.time])))
    return ClosedLoopRun(part, status, float(ended), reason, share)


def _warn(results: Sequence[ClosedLoopRun]) -> None:
    for r in results:
        if r.status is not LoopStatus.COMPLETED:
            warnings.warn(f"{r.trajectory.name}: {r.message}", DfsmWarning, stacklevel=3)
    done = [r for r in results if r.status is LoopStatus.COMPLETED]
    outside = [r for r in done if r.outside > MUCH_OUTSIDE]
    if outside:
        worst = max(outside, key=lambda r: r.outside)
        warnings.warn(
            f"{len(outside)} of {len(results)} closed loops spend more than {MUCH_OUTSIDE:.0%} of "
            f"the time outside the training range, {worst.trajectory.name} most "
            f"({worst.outside:.1%}): {told(worst.departures)}",
            DfsmWarning,
            stacklevel=3,
        )

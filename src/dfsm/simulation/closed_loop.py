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
from fractions import Fraction
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.controller import Controller
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning, printable
from dfsm.models.dfsm import DFSM
from dfsm.models.signals import require_constant, require_field, with_computed
from dfsm.simulation.loop import Drive, HostLoop, Path, roll, roll_compiled
from dfsm.simulation.simulate import ESCAPE, MUCH_OUTSIDE, initial_azimuth, initial_state
from dfsm.simulation.wires import Wires, connect, not_commanded

# Calls are padded to a multiple of this, so that runs of similar length share a compilation.
_PAD = 400
# Ratios of intervals with denominators up to this are met exactly.
_MOST_PARTS = 20


@settings_class
class ClosedLoopSettings:
    """How a loop is closed.

    Attributes
    ----------
    start_up
        Seconds before the time window in which the loop already runs, so that what is scored holds
        nothing of how filters and estimators begin. Where the record does not begin so early, the
        window begins later.
    step
        Largest RK4 step of the plant in s; None takes the run's samples, or the controller's
        interval where that is shorter.
    """

    start_up: float = 60.0
    step: float | None = None

    def __post_init__(self) -> None:
        require(self.start_up >= 0, "start_up", self.start_up, "seconds, at least 0")
        require(self.step is None or self.step > 0, "step", self.step, "seconds, more than 0")


class LoopStatus(enum.Enum):
    """How a closed loop ended; the value says what it means and what to do."""

    COMPLETED = "completed"
    UNSTABLE = (
        "the loop is unstable: a state left the training range by a factor of ten; take smaller "
        "gains or a shorter interval, and see with dfsm validate whether the model is good there"
    )
    CONTROLLER_FAILED = "the controller set no number: look at its gains, filters and tables"


@dataclass(frozen=True)
class ClosedLoopRun:
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
        Share of the samples with any input of the model outside its training range.
    wall_time
        Seconds it took (of the whole batch divided by its runs), without compilation when warm.
    """

    trajectory: Trajectory
    status: LoopStatus
    ended: float
    reason: str
    outside: float
    wall_time: float = 0.0

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
            return f"{self.outside:.1%} of the time outside the training range"
        return f"{self.reason}; {self.status.value}"


@dataclass(frozen=True)
class _Case:
    """A run prepared for the loop: its drive, and where its samples lie on the plant's steps.

    Attributes
    ----------
    run
        The samples from the loop's beginning on.
    drive
        With NumPy arrays, not padded.
    per_call
        Plant steps per call.
    scored
        First sample after the start-up.
    """

    run: Trajectory
    drive: Drive
    per_call: int
    scored: int

    @property
    def rows(self) -> int:
        """Ends of plant steps within the run."""
        return (len(self.drive.inputs) + 1) // 2

    def sampled(self, values: Array) -> Array:
        """Rows at the run's samples of ``(step + 1, n)``."""
        h = float(self.drive.h[0])
        at = (self.run.time - self.run.time[0]) / h
        rows = np.rint(at).astype(int)
        if np.abs(at - rows).max() < 1e-4:
            return values[rows]
        mesh = np.arange(len(values))
        return np.stack([np.interp(at, mesh, column) for column in values.T], axis=1)


class ClosedLoop(eqx.Module):
    """Closed loops over some runs as a pure function of the controller: `prepare_loop` makes it.

    Attributes
    ----------
    model
        The surrogate.
    drives
        Starts and inputs of all runs, padded to one length, with a leading axis ``(run, ...)``.
    scored
        Weight of every plant step's end in means over time: 1 after the start-up and within the
        run, else 0, ``(run, step + 1)``.
    wires
        How controllers are connected.
    """

    model: DFSM
    drives: Drive
    scored: jax.Array
    wires: Wires = eqx.field(static=True)

    def __call__(self, controller: Any) -> Path:
        """Close the loop over all runs; JAX can follow it, in the controller's numbers too.

        Parameters
        ----------
        controller
            An equinox module with the channels and interval that the loop was prepared for.

        Returns
        -------
        Path
            With a leading axis ``(run, ...)``.
        """
        model = self.model.prepared()
        return jax.vmap(lambda drive: roll(model, self.wires, controller, drive))(self.drives)

    def mean(self, values: jax.Array) -> jax.Array:
        """Mean over the scored time of ``(run, step + 1)``, per run."""
        return (values * self.scored).sum(axis=-1) / self.scored.sum(axis=-1)


def prepare_loop(
    model: DFSM,
    runs: Sequence[Trajectory],
    controller: Controller,
    *,
    start: float | None = None,
    stop: float | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
) -> ClosedLoop:
    """Closed loops as a pure function of the controller, to differentiate and to map over gains.

    Parameters
    ----------
    model, runs, controller, start, stop, measurements, settings
        As for `closed_loop`; of the controller only channels, units and interval matter.

    Returns
    -------
    ClosedLoop

    Raises
    ------
    DfsmError
        As `closed_loop`; or the runs differ in their sampling.
    """
    settings = settings or ClosedLoopSettings()
    wires = connect(model, controller, measurements)
    cases = _cases(model, runs, controller.interval, (start, stop), settings)
    if len({c.per_call for c in cases}) > 1:
        raise DfsmError(
            "the runs are sampled at different intervals: resample them, or set a step that is "
            "shorter than all of these"
        )
    calls = max(len(c.drive.time) for c in cases) + 1
    drives = [_padded(c, calls) for c in cases]
    scored = np.zeros((len(cases), calls * cases[0].per_call + 1))
    for i, c in enumerate(cases):
        begins = c.run.time[c.scored] - c.run.time[0]
        first = round(begins / float(c.drive.h[0]))
        scored[i, first : c.rows] = 1.0
    stacked = jax.tree.map(lambda *parts: jnp.stack(parts), *drives)
    return ClosedLoop(model, stacked, jnp.asarray(scored), wires)


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
        the plant; any other `Controller`, a `BladedLibrary` say, is called on the host.
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
        The model lacks what the controller reads or sets, a channel is missing or not finite, a
        run is not longer than the start-up, or a library refuses.

    Warns
    -----
    DfsmWarning
        A control stays as recorded, a loop ended early, or was outside the training range for part
        of the time.
    """
    settings = settings or ClosedLoopSettings()
    batch = [runs] if isinstance(runs, Trajectory) else list(runs)
    wires = connect(model, controller, measurements)
    if kept := not_commanded(model, controller):
        warnings.warn(
            f"the controller does not set {', '.join(kept)}: recorded values are taken",
            DfsmWarning,
            stacklevel=2,
        )
    cases = _cases(model, batch, controller.interval, (start, stop), settings)
    begin = clock.perf_counter()
    rolled = _roller(model, wires, controller)
    # XLA keeps a loop on one core; libraries wait in processes of their own.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        paths = list(pool.map(rolled, cases))
    results = [
        result_of(model, wires, controller, c, p) for c, p in zip(cases, paths, strict=True)
    ]
    wall = (clock.perf_counter() - begin) / len(batch)
    results = [replace(r, wall_time=wall) for r in results]
    _warn(results)
    return results[0] if isinstance(runs, Trajectory) else results


def _roller(model: DFSM, wires: Wires, controller: Controller) -> Callable[[_Case], Path]:
    """What closes the loop over one case."""
    if isinstance(controller, eqx.Module):

        def compiled(case: _Case) -> Path:
            calls = -(-(len(case.drive.time) + 1) // _PAD) * _PAD
            return roll_compiled(model, wires, controller, _padded(case, calls))

        return compiled
    host, low, high = HostLoop(model, wires), *_bounds(model)

    def gone(x: Array) -> bool:
        return not bool(((x >= low) & (x <= high)).all())

    return lambda case: host.roll(controller, _padded(case, len(case.drive.time) + 1), gone)


# -- preparing runs -----------------------------------------------------------------------------


def _cases(
    model: DFSM,
    runs: Sequence[Trajectory],
    interval: float,
    window: tuple[float | None, float | None],
    settings: ClosedLoopSettings,
) -> list[_Case]:
    if not runs:
        raise DfsmError("no runs were given to close the loop over")
    s = model.signals
    cases = []
    for run in runs:
        run = with_computed(run, s.hub_height, s.features)
        run.columns((*s.exogenous, *s.measured))
        require_field(run, s.azimuth)
        cases.append(_case(model, run, interval, window, settings))
    return cases


def _case(
    model: DFSM,
    run: Trajectory,
    interval: float,
    window: tuple[float | None, float | None],
    settings: ClosedLoopSettings,
) -> _Case:
    s, (start, stop) = model.signals, window
    first = float(run.time[0]) if start is None else start - settings.start_up
    part = run.window(first, stop)
    begins, ends = float(part.time[0]), float(part.time[-1])
    calls = int(np.floor((ends - begins) / interval * (1 + 1e-9)))
    scored = begins + settings.start_up
    after = np.flatnonzero(part.time >= scored - 1e-9 * part.duration)
    if calls < 1 or len(after) < 2:
        raise DfsmError(
            f"{run.where}: lasts from {begins:g} to {ends:g} s, not longer than the start-up of "
            f"{settings.start_up:g} s and an interval of {interval:g} s: take a longer run, or a "
            "shorter start-up"
        )
    sampling = run.time_step or float(np.median(np.diff(run.time)))
    per_call = _steps_per_call(interval, sampling, settings.step)
    h = interval / per_call
    driven = part.select(s.exogenous).require_finite()
    require_constant(driven, s.names("parameters"))
    mesh = begins + h / 2 * np.arange(2 * calls * per_call + 1)
    fields = part.select(s.names("field")).require_finite()
    drive = Drive(
        x0=initial_state(model, run, begins),  # pyright: ignore[reportArgumentType]
        psi0=initial_azimuth(model, run, begins),  # pyright: ignore[reportArgumentType]
        time=begins + interval * np.arange(calls),  # pyright: ignore[reportArgumentType]
        h=np.full(calls, h),  # pyright: ignore[reportArgumentType]
        inputs=_interpolated(driven, mesh),  # pyright: ignore[reportArgumentType]
        field=_interpolated(fields, mesh[::2]),  # pyright: ignore[reportArgumentType]
    )
    inside = part.time <= mesh[-1] + 1e-6 * h
    part = replace(part, time=part.time[inside], values=part.values[inside])
    return _Case(part, drive, per_call, int(after[0]))


def _steps_per_call(interval: float, sampling: float, step: float | None) -> int:
    """Plant steps per call, such that the run's samples lie on steps where that is possible."""
    ratio = Fraction(sampling / interval).limit_denominator(_MOST_PARTS)
    met = ratio > 0 and abs(float(ratio) * interval - sampling) < 1e-6 * sampling
    parts = ratio.denominator if met else 1
    longest = min(sampling, interval) if step is None else step
    return parts * max(1, int(np.ceil(interval / parts / longest * (1 - 1e-9))))


def _interpolated(run: Trajectory, mesh: Array) -> Array:
    if not run.channels:
        return np.zeros((len(mesh), 0))
    return np.stack([np.interp(mesh, run.time, column) for column in run.values.T], axis=1)


def _padded(case: _Case, calls: int) -> Drive:
    """The drive with further calls in which nothing moves, the first at the end of the run."""
    d, more = case.drive, calls - len(case.drive.time)
    interval = float(d.h[0]) * case.per_call
    steps = more * case.per_call

    def held(values: Array, rows: int) -> Array:
        return np.concatenate([values, np.repeat(values[-1:], rows, axis=0)])

    time = np.concatenate([d.time, d.time[-1] + interval * np.arange(1, more + 1)])
    h = np.concatenate([d.h, np.zeros(more)])
    inputs, field = held(np.asarray(d.inputs), 2 * steps), held(np.asarray(d.field), steps)
    return Drive(*map(jnp.asarray, (d.x0, d.psi0, time, h, inputs, field)))


# -- judging the outcome ------------------------------------------------------------------------


def _bounds(model: DFSM) -> tuple[Array, Array]:
    """Lowest and highest states before a loop counts as unstable."""
    columns = model.signals.state_columns
    low, high = np.asarray(model.region.low)[columns], np.asarray(model.region.high)[columns]
    middle, half = (low + high) / 2, (high - low) / 2
    return middle - ESCAPE * half, middle + ESCAPE * half


def result_of(
    model: DFSM, wires: Wires, controller: Controller, case: _Case, path: Path
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
    outside = case.sampled(np.asarray(path.outside)[:steps, None].astype(float))[:, 0]
    return _cut(case, (values, outside), channels, (status, reason, time[min(end, steps - 1)]))


def _failure(
    controller: Controller, path: Path, commanded: Array, at: tuple[int, float]
) -> str:
    """Which command is no number, and whether a measurement was one."""
    call, time = at
    seen = np.asarray(path.measurements)[call]
    if not np.isfinite(seen).all():
        name = controller.measurements[int(np.flatnonzero(~np.isfinite(seen))[0])]
        return f"the measurement {name} is {seen[~np.isfinite(seen)][0]} at {time:g} s"
    column = int(np.flatnonzero(~np.isfinite(commanded))[0])
    return f"{controller.commands[column]} is {commanded[column]} at {time:g} s"


def _cut(
    case: _Case,
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
    return ClosedLoopRun(part, status, float(ended), reason, float(outside[kept].mean()))


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
            f"({worst.outside:.1%})",
            DfsmWarning,
            stacklevel=3,
        )

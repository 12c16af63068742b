"""Runs prepared for closed loops: when the controller steps, and what drives the plant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import scipy

from dfsm.controllers.controller import require_controller
from dfsm.core.host import from_host
from dfsm.core.settings import require_kind, require_number, settings_class, shown
from dfsm.core.types import Array
from dfsm.data.between import Between
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.completion import all_completed
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.signals import require_constant, require_field
from dfsm.simulation.loop import Drive
from dfsm.simulation.simulate import initial_azimuth, initial_state

# Ratios of intervals with denominators up to this are met exactly.
_MOST_PARTS = 20
# Steps of one loop: an hour at intervals of 1.2 ms.
_MOST_STEPS = 3_000_000
# Calls are padded to a multiple of this.
_PAD = 400


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
        require_number("start_up", self.start_up, "seconds, at least 0", least=0)
        require_number("step", self.step, "seconds, more than 0", above=0, optional=True)


@dataclass(frozen=True)
class LoopCase:
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
    record
        The whole run as the model takes it.
    """

    run: Trajectory
    drive: Drive
    per_call: int
    scored: int
    record: Trajectory

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


def checked_loops(
    model: Any,
    runs: Any,
    controllers: Sequence[Any] | Mapping[str, Any],
    measurements: Any = None,
    settings: Any = None,
) -> list[Trajectory]:
    """Refuse what no loops can be closed with, before anything is computed.

    Parameters
    ----------
    model, runs, measurements, settings
        As for `closed_loop`; one run alone will do.
    controllers
        Any number, by name if they have some.

    Returns
    -------
    list of Trajectory
        The runs.

    Raises
    ------
    DfsmError
        One of them is not what it should be, or there are no runs.
    """
    require_model(model)
    of_runs = "runs: dfsm.read reads one, dfsm.read_all several"
    if isinstance(runs, str | Mapping):
        require_kind("runs", runs, Trajectory, of_runs)
    require_kind("runs", runs, Trajectory | Iterable, of_runs)
    batch: list[Any] = [runs] if isinstance(runs, Trajectory) else list(runs)
    if not batch:
        raise DfsmError("no runs were given to close the loop over")
    for run in batch:
        require_kind("one of the runs", run, Trajectory, of_runs)
    by_name = controllers if isinstance(controllers, Mapping) else None
    for one in controllers:
        if by_name is None:
            require_controller(one)
        else:
            require_controller(by_name[one], f"controller {shown(one)}")
    stand_ins = "names of the model's signals by the names of measurements"
    require_kind("measurements", measurements, Mapping | None, stand_ins)
    for name, signal in (measurements or {}).items():
        require_kind("a name among measurements", name, str, "a text")
        require_kind(f"measurements: {name}", signal, str, "the name of a signal of the model")
    require_kind("settings", settings, ClosedLoopSettings | None, "dfsm.ClosedLoopSettings(…)")
    return batch


def prepared_cases(
    model: DFSM,
    runs: Sequence[Trajectory],
    interval: float,
    window: tuple[float | None, float | None],
    settings: ClosedLoopSettings,
) -> list[LoopCase]:
    """Prepare runs for a controller that steps at an interval in s.

    Raises
    ------
    DfsmError
        A channel that is missing or not finite, a window that holds nothing of a run, a run not
        longer than the start-up, or more steps than can be waited for.
    """
    for name, end in zip(("start", "stop"), window, strict=True):
        require_number(name, end, "seconds, or None for that end of the run", optional=True)
    start, stop = window
    if start is not None and stop is not None and start >= stop:
        raise DfsmError(f"the time window goes from {start:g} s to {stop:g} s: swap the two")
    s = model.signals
    cases = []
    for run in all_completed(list(runs), s):
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
) -> LoopCase:
    s, (start, stop) = model.signals, window
    first, last = float(run.time[0]), float(run.time[-1])
    for name, end, outside in (
        ("start", start, start is not None and start >= last),
        ("stop", stop, stop is not None and stop <= first),
    ):
        if outside:
            raise DfsmError(
                f"{run.where}: {name} is {end:g} s, expected a time within the run, from {first:g} "
                f"to {last:g} s: choose another, or leave the run out"
            )
    if start is not None:
        first = start - settings.start_up
    part = run.window(first, stop)
    begins, ends = float(part.time[0]), float(part.time[-1])
    _require_few_steps(run, ends - begins, interval, settings.step)
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
        x0=initial_state(model, run, begins, complete=False),  # pyright: ignore[reportArgumentType]
        psi0=initial_azimuth(model, run, begins),  # pyright: ignore[reportArgumentType]
        time=begins + interval * np.arange(calls),  # pyright: ignore[reportArgumentType]
        h=np.full(calls, h),  # pyright: ignore[reportArgumentType]
        inputs=_interpolated(driven, mesh, s.between_samples()),  # pyright: ignore[reportArgumentType]
        field=_interpolated(fields, mesh[::2], ["linear"] * len(fields.channels)),  # pyright: ignore[reportArgumentType]
    )
    inside = part.time <= mesh[-1] + 1e-6 * h
    part = replace(part, time=part.time[inside], values=part.values[inside])
    return LoopCase(part, drive, per_call, int(after[0]), run)


def _require_few_steps(
    run: Trajectory, duration: float, interval: float, step: float | None
) -> None:
    """Refuse so short an interval or step that inputs along all of it would fill the memory."""
    plant = step is not None and step < interval
    shortest = step if step is not None and plant else interval
    with np.errstate(over="ignore"):
        steps = float(np.float64(duration) / shortest)
    if steps > _MOST_STEPS:
        what = "a plant step" if plant else "a controller's interval"
        raise DfsmError(
            f"{run.where}: {what} of {shortest:g} s makes {steps:.3g} steps over {duration:g} s, "
            f"at most {_MOST_STEPS:,} are allowed: choose one of at least "
            f"{1.01 * duration / _MOST_STEPS:.3g} s, or a shorter time window"
        )


def _steps_per_call(interval: float, sampling: float, step: float | None) -> int:
    """Plant steps per call, such that the run's samples lie on steps where that is possible."""
    ratio = Fraction(sampling / interval).limit_denominator(_MOST_PARTS)
    met = ratio > 0 and abs(float(ratio) * interval - sampling) < 1e-6 * sampling
    parts = ratio.denominator if met else 1
    longest = min(sampling, interval) if step is None else step
    return parts * max(1, int(np.ceil(interval / parts / longest * (1 - 1e-9))))


def _interpolated(run: Trajectory, mesh: Array, kinds: Sequence[Between]) -> Array:
    """Channels at any times, ``(time, channel)``, by what each does between samples."""
    inputs = np.zeros((len(mesh), len(run.channels)))
    # A mesh point that rounding puts before its sample has the sample's value.
    before = np.searchsorted(run.time, mesh + 1e-9 * run.duration, side="right") - 1
    for i, kind in enumerate(kinds):
        values = run.values[:, i]
        if kind == "hold":
            inputs[:, i] = values[before]
        elif kind == "cubic":
            inputs[:, i] = scipy.interpolate.CubicSpline(run.time, values)(mesh)
        else:
            inputs[:, i] = np.interp(mesh, run.time, values)
    return inputs


def enough_calls(*cases: LoopCase) -> int:
    """Calls to which all cases are padded, such that runs of similar length share a compilation."""
    longest = max(len(case.drive.time) for case in cases) + 1
    return -(-longest // _PAD) * _PAD


def padded(case: LoopCase, calls: int) -> Drive:
    """The drive with further calls in which nothing moves, the first at the end of the run."""
    d, more = case.drive, calls - len(case.drive.time)
    interval = float(d.h[0]) * case.per_call
    steps = more * case.per_call

    def held(values: Array, rows: int) -> Array:
        return np.concatenate([values, np.repeat(values[-1:], rows, axis=0)])

    time = np.concatenate([d.time, d.time[-1] + interval * np.arange(1, more + 1)])
    h = np.concatenate([d.h, np.zeros(more)])
    inputs, field = held(np.asarray(d.inputs), 2 * steps), held(np.asarray(d.field), steps)
    return Drive(*map(from_host, (d.x0, d.psi0, time, h, inputs, field)))

"""How a rollout ended, what it gives, and where it was outside the training range."""

from __future__ import annotations

import enum
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmWarning, printable
from dfsm.models.departures import MUCH_OUTSIDE, Departure, departures, told
from dfsm.models.dfsm import DFSM
from dfsm.models.region import Region
from dfsm.models.signals import SignalTable
from dfsm.numerics.time_mesh import mean_over, weights_over_time
from dfsm.simulation.drawn_run import DrawnRun
from dfsm.simulation.integrate import Rollout

# A rollout ends where a state is this many times its training half-range from the middle.
ESCAPE = 10.0
# An input this share of its training range outside of it may be why.
_FAR_INPUT = 0.5


class Status(enum.Enum):
    """How a simulation ended; the value says what it means and what to do."""

    COMPLETED = "completed"
    LEFT_REGION = (
        "stopped where a state left the training range by a factor of ten: train on runs that "
        "cover this case; where no input explains it, the model is unstable there: look at its "
        "eigenvalues"
    )
    NOT_FINITE = (
        "stopped where a state was no longer finite: use a smaller step or a stiff method, and "
        "look at the model's eigenvalues"
    )
    SOLVER_FAILED = (
        "the adaptive solver gave up: loosen rtol and atol, use kvaerno5 for a stiff model, or rk4"
    )


@dataclass(frozen=True, eq=False)
class StrayedPath:
    """A path that left the training range; how takes ten times as long to say as that it did.

    Attributes
    ----------
    region, signals
        Of the model.
    driven
        Its inputs.
    states
        At the first of their samples, ``(time, state)``.
    outside
        Which of these samples are outside the training range, ``(time,)``.
    """

    region: Region
    signals: SignalTable
    driven: Trajectory
    states: Array
    outside: NDArray[Any]

    def departures(self) -> tuple[Departure, ...]:
        """Where it left the training range, those that lasted longest first."""
        s, end = self.signals, len(self.states)
        exogenous = s.order.split_exogenous(from_host(self.driven.values[:end]))
        inputs = np.asarray(s.order.join(from_host(self.states), *exogenous))
        time = self.driven.time[:end]
        return departures(self.region, s.inputs, time, inputs, self.outside, _weights(time))


@dataclass(frozen=True)
class Simulation(DrawnRun):
    """A rollout.

    Attributes
    ----------
    trajectory
        States and outputs on the run's time mesh, up to where the rollout ended; roles are set.
    status
        How it ended.
    ended
        Last time in s.
    reason
        For a rollout that did not complete, the state that left the range and where; else "".
    outside
        Share of the time with any input outside its training range.
    wall_time
        Seconds it took (of the whole batch divided by its runs), without compilation when warm.
    note
        What was done otherwise than asked for: shorter steps, or another method; else "".
    guessed
        Seconds at its start and its end for which delayed and leading inputs were not recorded:
        they hold the first and the last value there.
    distance
        From the training data at every sample, ``(time,)``: 1 is as far as is usual.
    strayed
        The path by which it left the training range; None where it did not.
    """

    trajectory: Trajectory
    status: Status
    ended: float
    reason: str
    outside: float
    wall_time: float = 0.0
    note: str = ""
    guessed: tuple[float, float] = (0.0, 0.0)
    distance: Array = field(default_factory=lambda: np.empty(0), repr=False, compare=False)
    strayed: StrayedPath | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        run, outcome = self.trajectory, self.status.name.lower().replace("_", " ")
        return (
            f"<Simulation of {printable(run.name)}: {outcome}, {run.time[0]:g} to "
            f"{self.ended:g} s, {len(run)} samples; {printable(self.message)}>"
        )

    @cached_property
    def departures(self) -> tuple[Departure, ...]:
        """Where it left the training range, those that lasted longest first."""
        return () if self.strayed is None else self.strayed.departures()

    @property
    def message(self) -> str:
        """One sentence on the outcome."""
        first, last = self.guessed
        more = f"; {self.note}" if self.note else ""
        if first:
            more += f"; delayed inputs hold their first value for the first {first:.3g} s"
        if last:
            more += f"; leading inputs hold their last value for the last {last:.3g} s"
        if self.status is Status.COMPLETED:
            where = f": {told(self.departures)}" if self.departures else ""
            return f"{self.outside:.1%} of the time outside the training range{where}{more}"
        return f"{self.reason}; {self.status.value}{more}"


def judge(model: DFSM, run: Trajectory, driven: Trajectory, rollout: Rollout) -> Simulation:
    """Judge how a rollout ended, and where it was outside the training range.

    Parameters
    ----------
    model
        The surrogate.
    run
        What drove it, for its name.
    driven
        The exogenous channels in the window.
    rollout
        At their samples.
    """
    s = model.signals
    columns = s.state_columns
    low, high = np.asarray(model.region.low)[columns], np.asarray(model.region.high)[columns]
    middle, half = (low + high) / 2, (high - low) / 2
    x = rollout.states
    finite = np.isfinite(x)
    escaped = ~finite | (np.abs(np.where(finite, x, 0.0) - middle) > ESCAPE * half)
    rows = np.flatnonzero(escaped.any(axis=1))
    end = int(rows[0]) if len(rows) else len(x)
    status, reason = Status.COMPLETED, ""
    # An adaptive solver that gives up leaves the samples beyond without a value.
    if not rollout.solved and (end == len(x) or not finite[end].all()):
        status, reason = Status.SOLVER_FAILED, f"no solution beyond {driven.time[end - 1]:g} s"
    elif len(rows):
        column = int(np.flatnonzero(escaped[end])[0])
        status = Status.LEFT_REGION if finite[end].all() else Status.NOT_FINITE
        reason = (
            f"{s.states[column].name} reached {x[end, column]:.4g} {s.states[column].unit} at "
            f"{driven.time[end]:g} s (training range {low[column]:.4g} to {high[column]:.4g})"
        )
        if status is Status.LEFT_REGION:
            reason += _driven_there(model, driven.values[: end + 1])
        # The sample where it left shows which way the model went.
        end += status is Status.LEFT_REGION
    values = np.concatenate([x, rollout.outputs], axis=1)[: max(2, end)]
    values[end:] = np.nan  # a trajectory has two samples, even if the first step failed
    channels = (*s.states, *s.outputs)
    trajectory = Trajectory(
        driven.time[: len(values)], values, channels, name=run.name, source=run.source
    )
    left, strayed = rollout.outside[:end], None
    if left.any():
        # Copies, or what the trajectory holds: the rollout's arrays may be parts of larger ones.
        states = trajectory.values[:end, : len(s.states)]
        strayed = StrayedPath(model.region, s, driven, states, left.copy())
    return Simulation(
        trajectory=trajectory,
        status=status,
        ended=float(driven.time[end - 1]),
        reason=reason,
        outside=float(mean_over(left, _weights(driven.time[:end]))),
        strayed=strayed,
        distance=np.sqrt(rollout.distance[: len(values)]),
    )


def _driven_there(model: DFSM, values: Array) -> str:
    """The exogenous input that was farthest outside its training range, if by half of that or more.

    `values` are exogenous inputs along the rollout, ``(time, exogenous)``.
    """
    s, region = model.signals, model.region
    columns = [[c.name for c in s.inputs].index(name) for name in s.exogenous]
    low, high = np.asarray(region.low)[columns], np.asarray(region.high)[columns]
    share = np.maximum(values - high, low - values) / np.maximum(high - low, np.finfo(float).tiny)
    if not share.size or share.max() < _FAR_INPUT:
        return ""
    at, k = np.unravel_index(int(np.argmax(share)), share.shape)
    return (
        f", while its input {s.exogenous[k]} was at {values[at, k]:.4g} "
        f"(training range {low[k]:.4g} to {high[k]:.4g})"
    )


def _weights(time: Array) -> Array | None:
    return None if len(time) < 2 else weights_over_time([time])


def tell(results: Sequence[Simulation]) -> None:
    """Warn of rollouts that ended early, took other steps or were outside the training range."""
    ended = [r for r in results if r.status is not Status.COMPLETED]
    for r in ended:
        warnings.warn(f"{r.trajectory.name}: {r.message}", DfsmWarning, stacklevel=4)
    cut = [r for r in results if r.note and r.status is Status.COMPLETED]
    if cut:
        more = f" ({len(cut)} of the {len(results)} rollouts alike)" if len(cut) > 1 else ""
        warnings.warn(f"{cut[0].trajectory.name}: {cut[0].note}{more}", DfsmWarning, stacklevel=4)
    outside = [r for r in results if r.status is Status.COMPLETED and r.outside > MUCH_OUTSIDE]
    if outside:
        worst = max(outside, key=lambda r: r.outside)
        warnings.warn(
            f"{len(outside)} of {len(results)} rollouts spend more than {MUCH_OUTSIDE:.0%} of the "
            f"time outside the training range, {worst.trajectory.name} most ({worst.outside:.1%}): "
            f"{told(worst.departures)}",
            DfsmWarning,
            stacklevel=4,
        )

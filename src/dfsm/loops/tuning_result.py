"""What a tuning gives: the best values, how it ended, before and after, and all on the way."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dfsm.controllers.discon import Value
from dfsm.core.drawing import DrawnByRun
from dfsm.core.files import json_value
from dfsm.core.types import Array
from dfsm.errors import printable
from dfsm.loops.tuning_problem import TuningProblem
from dfsm.models.departures import MUCH_OUTSIDE, told
from dfsm.simulation.closed_loop import ClosedLoopRun

# Share of a parameter's bounds within which it is at one of them.
_AT_BOUND = 1e-3


class TuneStatus(enum.Enum):
    """How a tuning ended; the value says what it means and what to do."""

    SOLVED = "no better values are near these"
    LIMIT = "the most iterations were used: raise iterations, or start again with more starts"
    STALLED = (
        "no better values were reached, and not all conditions of an optimum hold: extremes and "
        "cycles jump; try more starts, or round them"
    )
    INFEASIBLE = "no values meet all constraints: loosen the worst, or widen the bounds"
    UNSTABLE = (
        "no start has loops that all come to their end: begin with a controller that is stable on "
        "the model, or narrow the bounds"
    )
    INTERRUPTED = "interrupted: these are the best values so far; the same command goes on"


@dataclass(frozen=True)
class Start:
    """Where one start led.

    Attributes
    ----------
    first, last
        Values of the parameters, in their order.
    objective
        At the end; None where no loop was stable or no values met the constraints.
    status
        How it ended.
    iterations
        Steps of the optimizer.
    """

    first: tuple[float, ...]
    last: tuple[float, ...]
    objective: float | None
    status: TuneStatus
    iterations: int


@dataclass(frozen=True)
class FrontPoint:
    """One point of a Pareto front: the weight of the first term, values, and both measures."""

    weight: float
    values: Mapping[str, float]
    measures: tuple[float, float]


@dataclass(frozen=True, eq=False)
class TuningResult(DrawnByRun):
    """Result of `tune`.

    Attributes
    ----------
    problem
        What was asked.
    controller
        Tuned.
    values, before
        Parameters by name, tuned and as they were.
    figures, before_figures
        Of all measures over all runs, objective first, then constraints; not a number where the
        controller as it was has no stable loop.
    objective, before_objective
        Σ weight · measure / scale.
    violation
        Largest excess over a limit, as a share of it; 0 or less where all hold.
    status
        How it ended.
    starts
        Where each start led.
    front
        Pareto front of two terms, if one was asked for.
    loops, before_loops
        Closed loops over all runs.
    changes
        Keys of the DISCON.IN that changed, with their values; empty for other controllers.
    evaluations, gradients
        How often all runs were simulated, and of these with slopes.
    seconds
        Time it took.
    """

    problem: TuningProblem
    controller: Any
    values: Mapping[str, float]
    before: Mapping[str, float]
    figures: Array
    before_figures: Array
    objective: float
    before_objective: float
    violation: float
    status: TuneStatus
    starts: tuple[Start, ...]
    front: tuple[FrontPoint, ...]
    loops: tuple[ClosedLoopRun, ...]
    before_loops: tuple[ClosedLoopRun, ...]
    changes: Mapping[str, Value]
    evaluations: int
    gradients: int
    seconds: float

    def __repr__(self) -> str:
        found = ", ".join(f"{name} = {value:.4g}" for name, value in self.values.items())
        return (
            f"<TuningResult: {printable(found)}; objective {self.objective:.5g}, before "
            f"{self.before_objective:.5g}; {self.message}>"
        )

    @property
    def at_bounds(self) -> list[str]:
        """Parameters that stand at a bound: a wider one would give more."""
        found = []
        for name, (low, high) in self.problem.parameters.items():
            room = _AT_BOUND * (high - low)
            if not low + room < self.values[name] < high - room:
                found.append(name)
        return found

    @property
    def message(self) -> str:
        """One sentence on the outcome."""
        text = self.status.value
        if self.status is TuneStatus.SOLVED and self.values == dict(self.before):
            text = "the controller as it is has no better values near it"
        if worst := self._worst():
            text += f"; {worst}"
        if names := self.at_bounds:
            text += f"; {', '.join(names)} at a bound: widen it if more is wanted"
        if where := self._outside():
            text += f"; {where}"
        return text

    def _outside(self) -> str:
        """Where the tuned loops leave the training range more than a little; empty if none does."""
        worst = max(self.loops, key=lambda loop: loop.outside, default=None)
        if worst is None or worst.outside <= MUCH_OUTSIDE:
            return ""
        return (
            f"the tuned loops are outside the training range for up to {worst.outside:.1%} of the "
            f"time ({worst.trajectory.name}): {told(worst.departures)}"
        )

    def _worst(self) -> str:
        if not self.violation > 0:
            return ""
        limits = self.problem.constraints
        values = self.figures[len(self.problem.objective) :]
        k = int(np.argmax([float(c.excess(v)) for c, v in zip(limits, values, strict=True)]))
        return f"{limits[k].label} is {values[k]:.4g}, its limit {limits[k].bound:g}"

    def summary(self) -> str:
        """Parameters and measures, before and after, a line each."""
        lines = [f"{self.status.name.lower()}: {self.message}"]
        lines += [f"  {n}: {self.before[n]:.6g} → {v:.6g}" for n, v in self.values.items()]
        rows = zip(self.problem.measures, self.before_figures, self.figures, strict=True)
        lines += [f"  {m.label}: {b:.5g} → {a:.5g}" for m, b, a in rows]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """JSON values: parameters, measures, status, starts, front."""
        rows = zip(self.problem.measures, self.before_figures, self.figures, strict=True)
        values = {
            "format": 1,
            "status": self.status.name.lower(),
            "message": self.message,
            "parameters": {
                n: {"before": self.before[n], "after": v, "bounds": list(bounds)}
                for (n, bounds), v in zip(
                    self.problem.parameters.items(), self.values.values(), strict=True
                )
            },
            "measures": [
                {"measure": m.label, "before": float(b), "after": float(a)} for m, b, a in rows
            ],
            "objective": {"before": self.before_objective, "after": self.objective},
            "violation": self.violation,
            "starts": [{**vars(s), "status": s.status.name.lower()} for s in self.starts],
            "front": [vars(p) for p in self.front],
            "changes": {k: np.atleast_1d(np.asarray(v)).tolist() for k, v in self.changes.items()},
            "evaluations": self.evaluations,
            "gradients": self.gradients,
            "seconds": self.seconds,
        }
        return dict(json_value(values))

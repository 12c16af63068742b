"""Tuning confirmed by the truth: few flights correct the surrogate's figures where it counts.

In each round the surrogate's figures, corrected so that they agree with the truth where it was
flown, are made better within a trust region; the truth is flown at what comes out; the correction
learns from it, and the region grows or shrinks with how well the gain was predicted (Alexandrov and
others, "Approximation and model management in aerodynamic optimization", J. Aircraft 38, 2001).
A correction is additive and multiplicative, weighted by which of both would have predicted the
last flight; its slope is the smallest that all flights admit, so that with each flight one more
direction is of first order.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dfsm.core.progress import track
from dfsm.core.settings import require, require_kind, require_number, settings_class, shown
from dfsm.core.types import Array
from dfsm.data.conversion import in_units_of
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, missing
from dfsm.loops.truth import FlownRuns, Truth, TruthCase, TruthEndedError
from dfsm.loops.tuning import TuningTask
from dfsm.loops.tuning_evaluate import Evaluator, Figured
from dfsm.loops.tuning_search import FEASIBLE, Judged, Search

# Gain of the truth over that predicted below which the region shrinks, above which it grows.
_POOR, _GOOD = 0.25, 0.75
# Objective that one unit of violation is worth.
_PENALTY = 10.0


class Confirmation(enum.Enum):
    """How a confirmed tuning ended; the value says what it means and what to do."""

    AGREED = "truth and prediction agree, and nothing better is predicted near"
    LIMIT = (
        "all flights are used, this is the best of them: allow more, or fit the surrogate on runs "
        "around these values"
    )
    UNSTABLE = "the true system has no stable loop with the controller as it is: begin elsewhere"


@settings_class
class TrustSettings:
    """When to stop.

    Attributes
    ----------
    flights
        Most evaluations of the truth, each of all runs, the controller as it is included.
    tolerance
        Difference of objectives, as a share, up to which truth and prediction agree.
    radius
        Of the first trust region, as a share of the bounds.
    """

    flights: int = 5
    tolerance: float = 0.005
    radius: float = 0.5

    def __post_init__(self) -> None:
        require_number("flights", self.flights, "a whole number, at least 2", least=2, whole=True)
        require_number("tolerance", self.tolerance, "between 0 and 1", above=0)
        require(self.tolerance < 1, "tolerance", self.tolerance, "between 0 and 1")
        require_number("radius", self.radius, "above 0, up to 1", above=0, most=1)


@dataclass(frozen=True)
class Flight:
    """One evaluation of the truth.

    Attributes
    ----------
    values
        Parameters by name.
    predicted
        Objective as the corrected surrogate had it; None for the first.
    surrogate
        As the surrogate alone has it.
    true
        As it was; None where the true system did not come to its end.
    violation
        Of the limits in truth, as a share.
    radius
        Of the trust region that it came from.
    """

    values: dict[str, float]
    predicted: float | None
    surrogate: float | None
    true: float | None
    violation: float | None
    radius: float


@dataclass(frozen=True, eq=False)
class ConfirmedTuning:
    """Result of `tune_with_truth`.

    Attributes
    ----------
    status
        How it ended.
    flights
        All evaluations of the truth, in order.
    best
        Index of the best.
    controller
        As it was flown then.
    """

    status: Confirmation
    flights: tuple[Flight, ...]
    best: int
    controller: Any

    def __repr__(self) -> str:
        return (
            f"<ConfirmedTuning: best of {len(self.flights)} flights is number {self.best + 1}; "
            f"{self.status.value}>"
        )

    @property
    def values(self) -> dict[str, float]:
        """Parameters of the best flight."""
        return self.flights[self.best].values

    def summary(self) -> str:
        """Describe the flights in a line each."""
        lines = [f"{self.status.value}; {len(self.flights)} flights"]
        for k, flight in enumerate(self.flights):
            told = ", ".join(f"{n} = {v:.5g}" for n, v in flight.values.items())
            true = "ended early" if flight.true is None else f"{flight.true:.5g}"
            if flight.predicted is not None:
                true += f", predicted {flight.predicted:.5g}"
            if flight.violation is not None and flight.violation > FEASIBLE:
                true += f", a limit passed by {flight.violation:.2%}"
            lines.append(f"  flight {k + 1}: {told}: {true}" + (" (best)" * (k == self.best)))
        return "\n".join(lines)


@dataclass
class CorrectedFigures:
    """The surrogate's figures, corrected so that they are the truth's at every flight.

    Attributes
    ----------
    evaluator
        Of the surrogate.
    points, true, base
        Values of the parameters that were flown, and figures there: of the truth, of the surrogate.
    center
        Which of them the correction is written around.
    """

    evaluator: Evaluator
    points: list[Array]
    true: list[Array]
    base: list[Array]
    center: int = 0

    def __call__(self, theta: Array, slopes: bool = False) -> Figured:
        """Figures at a point, and their slopes if asked for."""
        own = self.evaluator(theta, slopes)
        if not own.stable or not self.points:
            return own
        add, times, share = self._correction()
        step = theta - self.points[self.center]
        plus = add[0] + add[1] @ step
        by = times[0] + times[1] @ step
        figures = share * (own.figures + plus) + (1 - share) * own.figures * by
        bent = None
        if own.slopes is not None:
            bent = share[..., None] * (own.slopes + add[1])
            bent = bent + (1 - share)[..., None] * (
                own.slopes * by[..., None] + own.figures[..., None] * times[1]
            )
        return Figured(own.theta, figures, bent, ())

    def _correction(self) -> tuple[tuple[Array, Array], tuple[Array, Array], Array]:
        """Additive and multiplicative: value at the center and slope; share of the additive."""
        k = self.center
        safe = [np.where(b == 0, 1.0, b) for b in self.base]
        gaps = [t - b for t, b in zip(self.true, self.base, strict=True)]
        ratios = [t / b for t, b in zip(self.true, safe, strict=True)]
        others = [j for j in range(len(self.points)) if j != k]
        shape = (*gaps[k].shape, len(self.points[k]))
        if not others:
            flat = np.zeros(shape)
            return (gaps[k], flat), (ratios[k], flat), np.full(gaps[k].shape, 0.5)
        steps = np.stack([self.points[j] - self.points[k] for j in others])
        back = np.linalg.pinv(steps, rcond=1e-6)

        def slope(values: Sequence[Array]) -> Array:
            rises = np.stack([values[j] - values[k] for j in others], axis=-1)
            return rises @ back.T

        last = others[-1]
        one, two = self.base[last] + gaps[k], self.base[last] * ratios[k]
        apart = one - two
        share = np.where(
            np.abs(apart) > 1e-12 * np.abs(two),
            (self.true[last] - two) / np.where(apart == 0, 1.0, apart),
            0.5,
        )
        return (
            (gaps[k], slope(gaps)),
            (ratios[k], slope(ratios)),
            np.clip(share, 0.0, 1.0),
        )


def tune_with_truth(
    task: TuningTask, truth: Truth, settings: TrustSettings | None = None
) -> ConfirmedTuning:
    """Tune on a surrogate until the truth does what is predicted.

    Parameters
    ----------
    task
        What is tuned, on which surrogate, see `tune`.
    truth
        Flies runs.
    settings
        When to stop.

    Returns
    -------
    ConfirmedTuning

    Raises
    ------
    DfsmError
        As `tune`; or a run of the truth lacks a channel or a part of the scored time.
    """
    require_kind("task", task, TuningTask, "dfsm.TuningTask(…)")
    require_kind("settings", settings, TrustSettings | None, "dfsm.TrustSettings(…)")
    what = "a truth, which has a method run(case), as dfsm.SystemTruth and dfsm.FlownRuns have"
    flies = callable(getattr(truth, "run", None)) and not isinstance(truth, type)
    require(flies, "truth", shown(truth), what)
    if isinstance(truth, FlownRuns):
        truth.check(task.runs)
    settings = settings or TrustSettings()
    low, high = task.problem.bounds
    first = np.clip(task.tuned.start, low, high)
    corrected = CorrectedFigures(task.evaluator, [], [], [])
    search = task.search(task.evaluator(task.tuned.start), corrected)
    at, radius = first, settings.radius
    flights: list[Flight] = []
    judged: list[Judged | None] = []
    best, status = 0, Confirmation.LIMIT
    predicted: Judged | None = None
    for number in track(range(settings.flights), "flights"):
        found = flown(task, truth, number + 1, at)
        own = task.evaluator(at)
        judged.append(None if found is None else search.judged(found))
        flights.append(_flight(task, search, at, (predicted, own, judged[-1]), radius))
        if found is None and not number:
            return _result(task, Confirmation.UNSTABLE, flights, 0)
        if found is not None and own.stable:
            corrected.points.append(at)
            corrected.true.append(found.figures)
            corrected.base.append(own.figures)
        agreed = number and _agrees(predicted, judged[-1], settings.tolerance)
        if number:
            radius = _resized(radius, judged[best], judged[-1], predicted, at, flights[best], task)
            if _merit(judged[-1]) < _merit(judged[best]):
                best = number
        corrected.center = _center(corrected, flights[best])
        at = np.array(list(flights[best].values.values()))
        following, predicted = _next(task, search, at, radius)
        gain = _merit(judged[best]) - _merit(predicted)
        enough = settings.tolerance * max(abs(_merit(judged[best])), 1e-12)
        if agreed and gain <= enough:
            status = Confirmation.AGREED
            break
        if np.allclose(following, at):
            status = Confirmation.AGREED
            break
        at = following
    return _result(task, status, flights, best)


def _next(
    task: TuningTask, search: Search, at: Array, radius: float
) -> tuple[Array, Judged | None]:
    """The best point of the corrected surrogate in the trust region, and how it is judged."""
    low, high = task.problem.bounds
    reach = radius * (high - low)
    bounds = (np.maximum(low, at - reach), np.minimum(high, at + reach))
    own = replace(search, best=None)
    task.from_point(own, at, bounds)
    return (at, None) if own.best is None else own.best


def flown(task: TuningTask, truth: Truth, number: int, at: Array) -> Figured | None:
    """Figures of the truth at a point; None where it did not come to its end.

    Parameters
    ----------
    task
        Says which runs, and what is measured.
    truth
        Flies them.
    number
        Of the evaluation, from 1.
    at
        Values of the parameters.

    Raises
    ------
    DfsmError
        A run of the truth lacks a channel or a part of the scored time.
    """
    values = dict(zip(task.tuned.names, at.tolist(), strict=True))
    controller = task.tuned.at(at)
    deck = None if task.discon is None else task.deck(at)
    cases = [TruthCase(number, run, controller, values, deck) for run in task.evaluator.runs]
    prepare = getattr(truth, "prepare", None)
    if prepare is not None:
        prepare(cases)
    columns = list[list[float]]()
    for k, case in enumerate(track(cases, f"flight {number}")):
        try:
            run = truth.run(case)
        except TruthEndedError:
            return None
        columns.append(_measured(task, k, run))
    return Figured(at, np.array(columns).T, None, ())


def _measured(task: TuningTask, k: int, run: Any) -> list[float]:
    case, s = task.evaluator.cases[k], task.model.signals
    require_kind("what the truth's run returned", run, Trajectory, "a Trajectory")
    names = list(dict.fromkeys(m.channel for m in task.problem.measures))
    if lost := [n for n in names if n not in run]:
        raise DfsmError(f"{run.where}: the truth has {missing(lost, run.names)}")
    begins, ends = float(case.run.time[case.scored]), float(case.run.time[-1])
    slack = 0.01 * (ends - begins)
    if run.time[0] > begins + slack or run.time[-1] < ends - slack:
        raise DfsmError(
            f"{run.where}: lasts from {run.time[0]:g} to {run.time[-1]:g} s, and {begins:g} to "
            f"{ends:g} s are scored: fly it longer, or score less with start and stop"
        )
    known = {c.name: c for c in (*s.observed, *s.controls, *s.outputs)}
    part = in_units_of(run.select(names), [known[n] for n in names]).window(begins, ends)
    held = task.evaluator.held
    return [m.along(part.time, part[m.channel], held(m.channel))[0] for m in task.problem.measures]


def _flight(
    task: TuningTask,
    search: Search,
    at: Array,
    seen: tuple[Judged | None, Figured, Judged | None],
    radius: float,
) -> Flight:
    predicted, own, true = seen
    return Flight(
        values=dict(zip(task.tuned.names, at.tolist(), strict=True)),
        predicted=None if predicted is None else predicted.objective,
        surrogate=search.judged(own).objective if own.stable else None,
        true=None if true is None else true.objective,
        violation=None if true is None else true.violation,
        radius=radius,
    )


def _merit(judged: Judged | None) -> float:
    """Objective, and what is violated."""
    if judged is None:
        return float("inf")
    beyond = judged.violation if judged.violation > FEASIBLE else 0.0
    return judged.objective + _PENALTY * beyond


def _agrees(predicted: Judged | None, true: Judged | None, tolerance: float) -> bool:
    if predicted is None or true is None:
        return False
    size = max(abs(true.objective), 1e-12)
    return abs(_merit(predicted) - _merit(true)) <= tolerance * size


def _resized(
    radius: float,
    old: Judged | None,
    new: Judged | None,
    predicted: Judged | None,
    at: Array,
    center: Flight,
    task: TuningTask,
) -> float:
    """The next trust region: by the gain of the truth over that predicted."""
    low, high = task.problem.bounds
    step = float(np.abs((at - np.array(list(center.values.values()))) / (high - low)).max())
    hoped = _merit(old) - _merit(predicted)
    ratio = (_merit(old) - _merit(new)) / hoped if hoped > 0 else 0.0
    if ratio < _POOR:
        return 0.5 * step if step > 0 else 0.5 * radius
    if ratio > _GOOD and step > 0.99 * radius:
        return min(1.0, 2 * radius)
    return radius


def _center(corrected: CorrectedFigures, best: Flight) -> int:
    """Which point of the correction is the best flight; the last where the surrogate had none."""
    theta = np.array(list(best.values.values()))
    at = [k for k, p in enumerate(corrected.points) if np.array_equal(p, theta)]
    return at[-1] if at else len(corrected.points) - 1


def _result(
    task: TuningTask, status: Confirmation, flights: Sequence[Flight], best: int
) -> ConfirmedTuning:
    theta = np.array(list(flights[best].values.values()))
    return ConfirmedTuning(status, tuple(flights), best, task.tuned.at(theta))

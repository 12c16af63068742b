"""Gains by exact gradients: closed loops on a model over load cases, made better within limits.

Each evaluation closes the loop over every run; its slopes with the parameters march beside it, and
measures are differentiated sample by sample (damage through its turning points at fixed cycles).
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dfsm.controllers.discon import Discon
from dfsm.controllers.rosco import ROSCO
from dfsm.controllers.tunable import Tunable, tunable
from dfsm.core.progress import track
from dfsm.core.settings import require_kind, require_number
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.loops.tuning_evaluate import Evaluator, Figured
from dfsm.loops.tuning_problem import TuneSettings, TuningProblem, check_problem
from dfsm.loops.tuning_result import FrontPoint, Start, TuneStatus, TuningResult
from dfsm.loops.tuning_search import FEASIBLE, Figures, Search, search_from, weighted
from dfsm.models.dfsm import DFSM
from dfsm.simulation.loop_cases import checked_loops

# Shares of the first weight at the ends of a Pareto front: 0 and 1 would leave one term out.
_LEAST_SHARE = 0.02


def tune(
    model: DFSM,
    runs: Sequence[Trajectory],
    controller: Any,
    problem: TuningProblem,
    *,
    discon: Discon | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: TuneSettings | None = None,
) -> TuningResult:
    """Tune a controller on a model.

    Parameters
    ----------
    model, runs, measurements
        As for `closed_loop`.
    controller
        ROSCO in JAX, or an equinox module.
    problem
        Parameters with bounds, objective, constraints.
    discon
        The DISCON.IN that ROSCO was read from: needed for omega_pc, zeta_pc, omega_vs, zeta_vs and
        ps_percent.
    settings
        Time window, starts, and when to stop.

    Returns
    -------
    TuningResult
        Also where nothing better was reached: look at its `status`, or print its `summary()`.

    Raises
    ------
    DfsmError
        As `closed_loop`; there is no such parameter or channel, or the controller as it is has
        no stable loop and a term of the objective no scale.
    """
    return TuningTask(model, runs, controller, problem, discon, measurements, settings).tune()


@dataclass
class TuningTask:
    """A tuning before it is done: what `tune` takes, prepared when it is first asked for.

    Attributes
    ----------
    model, runs, controller, problem, discon, measurements, settings
        As for `tune`.
    """

    model: DFSM
    runs: Sequence[Trajectory]
    controller: Any
    problem: TuningProblem
    discon: Discon | None = None
    measurements: Mapping[str, str] | None = None
    settings: TuneSettings | None = None

    def __post_init__(self) -> None:
        require_kind("problem", self.problem, TuningProblem, "dfsm.TuningProblem(…)")
        require_kind("settings", self.settings, TuneSettings | None, "dfsm.TuneSettings(…)")
        require_kind("discon", self.discon, Discon | None, "a deck, as dfsm.read_discon reads it")
        self.settings = self.settings or TuneSettings()
        self.runs = checked_loops(self.model, self.runs, [self.controller], self.measurements)
        check_problem(self.problem, self.model, len(self.runs), self.settings)
        self.tuned: Tunable = tunable(self.controller, self.problem.parameters, self.discon)
        self.evaluator = Evaluator(
            self.model,
            self.runs,
            self.tuned,
            self.problem.measures,
            window=(self.settings.start, self.settings.stop),
            loop=self.settings.loop,
            measurements=self.measurements,
        )

    # -- how it is done ---------------------------------------------------------------------------

    def tune(self) -> TuningResult:
        """Do it; see `tune`."""
        assert self.settings is not None
        begin = clock.perf_counter()
        starts: list[Start] = []
        front: list[FrontPoint] = []
        before = self.evaluator(self.tuned.start)
        search = self.search(before)
        interrupted = False
        try:
            for first in track(self.first_points(), "starts"):
                starts.append(self.from_point(search, first))
            if self.settings.pareto:
                front = self._front(search)
        except KeyboardInterrupt:
            interrupted = True
        return self.result(search, before, starts, front, interrupted, begin)

    def given(self, values: Mapping[str, float]) -> TuningResult:
        """What values that were reached in another way give on the model.

        Parameters
        ----------
        values
            Of the parameters, by name.

        Raises
        ------
        DfsmError
            One is missing.
        """
        for name in self.tuned.names:
            require_number(f"value of {name}", values.get(name), "a number")
        before = self.evaluator(self.tuned.start)
        search = self.search(before)
        theta = np.array([values[name] for name in self.tuned.names])
        judged = search.at(theta)
        ends = (tuple(self.tuned.start), tuple(theta))
        cost = None if judged is None else judged.objective
        starts = [Start(*ends, cost, TuneStatus.SOLVED, 0)]
        return self.result(search, before, starts, (), False, clock.perf_counter())

    def from_point(
        self, search: Search, first: Array, bounds: tuple[Array, Array] | None = None
    ) -> Start:
        """Go downhill from a point."""
        assert self.settings is not None
        return search_from(
            search,
            first,
            bounds=bounds or self.problem.bounds,
            iterations=self.settings.iterations,
            tolerance=self.settings.tolerance,
        )

    def search(self, before: Figured, figures: Figures | None = None) -> Search:
        """The problem as an optimizer sees it.

        Parameters
        ----------
        before
            Figures with the controller as it is, which scale the objective.
        figures
            What gives figures; None takes the loops on the model.

        Raises
        ------
        DfsmError
            The controller as it is has no stable loop, and a term has no scale.
        """
        scales = []
        for k, goal in enumerate(self.problem.objective):
            if goal.scale is None and not before.stable:
                raise DfsmError(
                    "the controller as it is gives no stable loop to compare with "
                    f"({before.endings[0]}): give {goal.label} a scale, or another controller to "
                    "begin with"
                )
            value = goal.scale or abs(goal.over(before.figures[k], self._weights(before))[0])
            scales.append(value or 1.0)
        return Search(self.problem, figures or self.evaluator, np.array(scales))

    def _weights(self, at: Figured) -> Sequence[float]:
        return self.problem.weights or [1.0] * at.figures.shape[1]

    def first_points(self) -> list[Array]:
        """The controller as it is, and points spread over the bounds."""
        assert self.settings is not None
        low, high = self.problem.bounds
        points = [np.clip(self.tuned.start, low, high)]
        if self.settings.starts > 1:
            # Takes a second to load, which one start does not need.
            from scipy.stats import qmc

            drawn = qmc.LatinHypercube(len(low), rng=self.settings.seed)
            shares = drawn.random(self.settings.starts - 1)
            points += list(low + (high - low) * shares)
        return points

    def _front(self, search: Search) -> list[FrontPoint]:
        """Weights from the one term to the other, each from the best point of the last."""
        assert self.settings is not None
        found: list[FrontPoint] = []
        at = self.tuned.start if search.best is None else search.best[0]
        for share in track(
            np.linspace(1 - _LEAST_SHARE, _LEAST_SHARE, self.settings.pareto).tolist(), "front"
        ):
            own = replace(search, problem=weighted(self.problem, share), best=None)
            self.from_point(own, at)
            if own.best is None or own.best[1].violation > FEASIBLE:
                continue
            at = own.best[0]
            first, second = own.over_runs(self.evaluator(at))[:2]
            values = dict(zip(self.tuned.names, at.tolist(), strict=True))
            found.append(FrontPoint(share, values, (float(first), float(second))))
        return _undominated(found, [g.weight for g in self.problem.objective])

    def deck(self, theta: Array) -> Discon:
        """The DISCON.IN with the lines changed that some values change, and no other."""
        assert self.discon is not None
        return self.discon.changed(self.tuned.changes(theta))

    # -- what comes of it -------------------------------------------------------------------------

    def result(
        self,
        search: Search,
        before: Figured,
        starts: Sequence[Start],
        front: Sequence[FrontPoint],
        interrupted: bool,
        begin: float,
    ) -> TuningResult:
        """Put together what the search ended with."""
        theta = self.tuned.start if search.best is None else search.best[0]
        at = self.evaluator(theta)
        nothing = np.full(len(self.problem.measures), np.nan)
        judged = search.judged(at) if at.stable else None
        rosco = isinstance(self.controller, ROSCO)
        return TuningResult(
            problem=self.problem,
            controller=self.tuned.at(theta),
            values=dict(zip(self.tuned.names, theta.tolist(), strict=True)),
            before=dict(zip(self.tuned.names, self.tuned.start.tolist(), strict=True)),
            figures=search.over_runs(at) if at.stable else nothing,
            before_figures=search.over_runs(before) if before.stable else nothing,
            objective=judged.objective if judged else np.nan,
            before_objective=search.judged(before).objective if before.stable else np.nan,
            violation=judged.violation if judged else np.nan,
            status=_status(search, starts, interrupted),
            starts=tuple(starts),
            front=tuple(front),
            loops=tuple(self.evaluator.loops(theta)),
            before_loops=tuple(self.evaluator.loops(self.tuned.start)),
            changes=self.tuned.changes(theta) if rosco else {},
            evaluations=self.evaluator.evaluations,
            gradients=self.evaluator.gradients,
            seconds=clock.perf_counter() - begin,
        )


def _status(search: Search, starts: Sequence[Start], interrupted: bool) -> TuneStatus:
    """How the best of the starts ended."""
    if interrupted:
        return TuneStatus.INTERRUPTED
    if search.best is None:
        return TuneStatus.UNSTABLE
    if search.best[1].violation > FEASIBLE:
        return TuneStatus.INFEASIBLE
    done = [s for s in starts if s.objective is not None]
    return min(done, key=lambda s: s.objective or 0.0).status if done else TuneStatus.STALLED


def _undominated(points: Sequence[FrontPoint], weights: Sequence[float]) -> list[FrontPoint]:
    """Points that no other beats in both terms, smaller or larger as their weights say."""
    signed = np.array([p.measures for p in points]).reshape(-1, 2) * np.sign(weights)
    kept = []
    for k, mine in enumerate(signed):
        others = np.delete(signed, k, axis=0)
        beaten = ((others <= mine).all(axis=1) & (others < mine).any(axis=1)).any()
        twice = (signed[:k] == mine).all(axis=1).any()
        if not beaten and not twice:
            kept.append(points[k])
    return kept

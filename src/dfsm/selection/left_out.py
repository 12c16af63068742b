"""Prediction intervals from the training runs alone: models that were fitted without some of them.

What a model does not know of a new run, it does not know of a run that it was not trained with.
Some runs are left out as they come, which tells how far off rollouts are where the data are; then
all runs of an operating point, or those that lie farthest from the others, which tells how errors
grow with the distance from the data.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dfsm.core.progress import track
from dfsm.core.settings import require
from dfsm.data.dataset import Dataset
from dfsm.data.hold_out import operating_points
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV
from dfsm.fitting.settings import FitSettings
from dfsm.models.completion import all_completed
from dfsm.models.dfsm import DFSM
from dfsm.refinement.settings import RefineSettings
from dfsm.simulation.simulate import SimulationSettings, Status, simulate
from dfsm.validation.calibrate import intervals_of
from dfsm.validation.growth import RolloutErrors
from dfsm.validation.intervals import Intervals
from dfsm.validation.rollout_errors import rollout_errors
from dfsm.validation.validate import of_the_fit

# How often runs are left out as they come, and at most how many operating points one by one.
_SPLITS, _POINTS = 3, 4
# With fewer runs each is cut into pieces, until there are so many.
_FEWEST = 6
# Samples that a piece has at least.
_PIECE = 200
# Share of the runs that are the farthest.
_FARTHEST = 1 / 3


def cross_calibrate(
    model: DFSM,
    runs: Iterable[Trajectory],
    settings: FitSettings,
    refinement: RefineSettings | None = None,
    *,
    level: float = 0.9,
    simulation: SimulationSettings | None = None,
) -> Intervals:
    """Intervals of a model from its own training runs, some of which are left out at a time.

    Takes as long as about six fits.

    Parameters
    ----------
    model
        What `fit` made of all runs with the same settings.
    runs
        The training runs. Few runs are cut into pieces.
    settings, refinement
        As for `fit`.
    level
        Share of the time that the record of a new run is expected inside.
    simulation
        How models are simulated.

    Returns
    -------
    Intervals
        Their half-widths grow along a rollout and with the distance from the training data.

    Raises
    ------
    DfsmError
        Too short a record, a level outside (0, 1), or no model that could be fitted without some
        of the runs.
    """
    require(0 < level < 1, "level", level, "a share between 0 and 1")
    found = left_out_errors(model, runs, settings, refinement, simulation)
    return intervals_of(model, found.parts, found.runs, level=level, warnings=found.notes)


def check_is_of(model: DFSM, runs: Sequence[Trajectory], where: Path) -> None:
    """Refuse a model that was fitted to other runs than a configuration names.

    Raises
    ------
    DfsmError
        Says how many of the runs the model knows.
    """
    known = of_the_fit(model, runs)
    if len(known) < len(runs) or len(runs) != len(model.provenance.record.get("data", runs)):
        raise DfsmError(
            f"the model was not fitted to the runs of {where}: it knows {len(known)} of these "
            f"{len(runs)}; fit it again with dfsm fit {where}, or give new runs instead of --config"
        )


@dataclass(frozen=True)
class LeftOut:
    """What models that were fitted without some of the runs make of these.

    Attributes
    ----------
    parts
        Errors of rollouts, in groups that were left out together.
    runs
        The training runs, or pieces of few, in the model's units.
    notes
        What a reader should know.
    """

    parts: tuple[RolloutErrors, ...]
    runs: tuple[Trajectory, ...]
    notes: tuple[str, ...]


def left_out_errors(
    model: DFSM,
    runs: Iterable[Trajectory],
    settings: FitSettings,
    refinement: RefineSettings | None = None,
    simulation: SimulationSettings | None = None,
) -> LeftOut:
    """Fit without some of the runs, and simulate these; parameters as of `cross_calibrate`."""
    pieces, settings = _pieces(list(runs), replace(settings, nonlinear_only=False))
    parts, notes, ended = list[RolloutErrors](), list[str](), 0
    plan = list(_left_out(pieces, model, settings))
    for group, held in track(plan, "models without some runs"):
        training = [run for k, run in enumerate(pieces) if k not in held]
        try:
            without = _fitted(training, settings, refinement)
        except DfsmError as error:
            notes.append(f"no model could be fitted without {group} ({error})")
            continue
        with hushed():
            tested = all_completed([pieces[k] for k in held], without.signals)
        found, early = rollout_errors(
            without,
            tested,
            [group] * len(tested),
            start=settings.start,
            stop=settings.stop,
            settings=simulation,
        )
        parts, ended = [*parts, *found], ended + len(early)
    if len({part.group for part in parts}) < 2:
        ways = ["rollouts over runs that were left out ended early"] if ended else []
        why = "; ".join([*notes, *ways])
        raise DfsmError(f"{why}: calibrate on runs that had no part in the fit")
    if ended:
        notes.append(
            f"{ended} rollouts over runs that were left out ended early and have no part in the "
            "intervals, which may be too narrow"
        )
    with hushed():
        completed = all_completed(pieces, model.signals)
    return LeftOut(tuple(parts), tuple(completed), tuple(notes))


def _fitted(
    runs: Sequence[Trajectory], settings: FitSettings, refinement: RefineSettings | None
) -> DFSM:
    """A model of some of the runs; with fewer schedule points where these leave a gap."""
    with hushed():
        try:
            return fit(runs, settings, refinement).model
        except DfsmError:
            linear = settings.linear
            if not isinstance(linear, LPV) or linear.points <= 2:
                raise
            fewer = replace(linear, points=max(2, linear.points // 2))
            return _fitted(runs, replace(settings, linear=fewer), refinement)


def _pieces(runs: list[Trajectory], settings: FitSettings) -> tuple[list[Trajectory], FitSettings]:
    """The runs, or pieces of few; these lie inside the time window of the fit."""
    if len(runs) >= _FEWEST:
        return runs, settings
    inside = [run.window(settings.start, settings.stop) for run in runs]
    pieces = list[Trajectory]()
    for run in inside:
        count = max(1, min(-(-_FEWEST // len(runs)), len(run) // _PIECE))
        edges = np.linspace(0, len(run), count + 1).astype(int)
        for k, (first, last) in enumerate(pairwise(edges)):
            part = slice(first, last)
            name = f"{run.name}, part {k + 1}" if count > 1 else run.name
            pieces.append(replace(run, time=run.time[part], values=run.values[part], name=name))
    if len(pieces) < _SPLITS:
        raise DfsmError(
            f"{len(runs)} runs of {', '.join(str(len(r)) for r in inside)} samples are too few to "
            "leave some out: calibrate on runs that had no part in the fit"
        )
    return pieces, replace(settings, start=None, stop=None)


def _left_out(
    runs: Sequence[Trajectory], model: DFSM, settings: FitSettings
) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Name and runs of everything that is left out once."""
    with hushed():
        rollouts = simulate(model, runs, start=settings.start, stop=settings.stop)
    far = np.array([np.sqrt(np.mean(r.distance**2)) for r in rollouts])
    far[[r.status is not Status.COMPLETED for r in rollouts]] = np.inf
    # Dealt out in turn, so that all parts are alike.
    along, order, points = far, np.argsort(far, kind="stable"), list[tuple[int, ...]]()
    if model.schedule is not None:
        with hushed():
            known = all_completed(runs, model.signals)
        if all(model.schedule in run for run in known):
            inside = [run.window(settings.start, settings.stop) for run in known]
            along = np.array([run[model.schedule].mean() for run in inside])
            order, points = np.argsort(along, kind="stable"), _points(inside, model.schedule)
    for k in range(_SPLITS):
        yield f"run {k + 1} of every {_SPLITS}", tuple(sorted(order[k::_SPLITS].tolist()))
    for point in points:
        yield f"the runs around {along[list(point)].mean():.4g}", point
    if not points:
        farthest = np.argsort(-far, kind="stable")[: max(1, round(_FARTHEST * len(runs)))]
        yield "the runs farthest from the others", tuple(sorted(farthest.tolist()))


def _points(runs: Sequence[Trajectory], schedule: str) -> list[tuple[int, ...]]:
    """Runs of some operating points along the schedule, none where there are no such points."""
    ordered = Dataset(runs)
    try:
        points = operating_points(ordered, schedule)
    except DfsmError:
        return []
    places = {run.digest: k for k, run in enumerate(runs)}
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _POINTS)).round())
    return [tuple(sorted(places[ordered[i].digest] for i in points[k])) for k in map(int, chosen)]

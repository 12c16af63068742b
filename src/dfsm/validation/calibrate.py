"""Prediction intervals calibrated on runs that the model never saw.

A law tells the root mean square error that is to be expected at an operating point, so long after
the start and so far from the training data (`growth`). Half-widths are a multiple of it: the
quantile of the errors of each group of runs relative to what the law of the others expects, so that
no run is judged by a law that it made (conformal prediction with groups left out; Barber et al.
2021).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from dfsm.core.renamed import renamed
from dfsm.core.settings import require
from dfsm.core.types import Array
from dfsm.data.dataset import Dataset
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.completion import all_completed
from dfsm.models.dfsm import DFSM, require_model
from dfsm.simulation.simulate import SimulationSettings
from dfsm.validation.growth import RolloutErrors, law_of
from dfsm.validation.intervals import Intervals
from dfsm.validation.rollout_errors import rollout_errors
from dfsm.validation.validate import listed, of_the_fit

# Calibration runs below which a quantile over runs means nothing.
_FEWEST = 3
# Groups of which the extremes are left out.
_MANY_GROUPS = 6
# A law for each run left out takes long with many, and says the same.
_MOST_GROUPS = 8


@renamed(options="settings")
def calibrate(
    model: DFSM,
    runs: Iterable[Trajectory],
    *,
    level: float = 0.9,
    start: float | None = None,
    stop: float | None = None,
    settings: SimulationSettings | None = None,
) -> Intervals:
    """Intervals that hold the record of a new run for a share of the time.

    Parameters
    ----------
    model
        The surrogate.
    runs
        Runs that had no part in its fit, with all its channels; at least three. Those that had are
        named in the warnings of the result.
    level
        Share of the time.
    start, stop
        Window in s, as for `validate`.
    settings
        How the model is simulated.

    Returns
    -------
    Intervals

    Raises
    ------
    DfsmError
        Too few runs, one that occurs twice, a rollout that ended early, or a level outside (0, 1).
    """
    require_model(model)
    require(0 < level < 1, "level", level, "a share between 0 and 1")
    s = model.signals
    runs = all_completed(list(runs), s)
    if len(runs) < _FEWEST:
        raise DfsmError(
            f"intervals are calibrated on at least {_FEWEST} runs, {len(runs)} were given"
        )
    Dataset(runs)  # refuses a run that occurs twice
    groups = [f"{k % _MOST_GROUPS}" for k in range(len(runs))]
    parts, ended = rollout_errors(model, runs, groups, start=start, stop=stop, settings=settings)
    for rollout in ended:
        where = next(r.where for r in runs if r.name == rollout.trajectory.name)
        raise DfsmError(f"{where}: {rollout.message}; no interval holds such a rollout")
    return intervals_of(model, parts, runs, level=level, warnings=_leaks(model, runs))


def intervals_of(
    model: DFSM,
    parts: Sequence[RolloutErrors],
    runs: Sequence[Trajectory],
    *,
    level: float,
    warnings: Sequence[str] = (),
) -> Intervals:
    """Intervals of a model from rollouts over runs that were left out.

    Parameters
    ----------
    model
        The surrogate, or one of several that were trained without some of the runs.
    parts
        Errors of rollouts, in at least two groups.
    runs
        That they are of, in the model's units.
    level
        Share of the time.
    warnings
        What a reader should know.
    """
    s, grid = model.signals, np.asarray(model.region.grid)
    scores = list[Array]()
    for group in dict.fromkeys(part.group for part in parts):
        law = law_of([p for p in parts if p.group != group], grid)
        mine = [np.abs(p.errors) / law.at(p) for p in parts if p.group == group]
        scores.append(np.concatenate(mine))
    law = law_of(parts, grid)
    # Few runs may all have been easy: the new one counts as a run that nothing is known of.
    multiple = _multiple(scores, level + (1 - level) / (1 + len(runs)))
    channels = (*s.observed, *s.outputs)
    return Intervals(
        channels=tuple(c.name for c in channels),
        units=tuple(c.unit for c in channels),
        schedule=model.schedule,
        grid=grid,
        half_width=multiple * law.scale,
        level=level,
        runs=tuple(r.name for r in runs),
        digests=tuple(r.select(s.recorded).digest for r in runs),
        warnings=tuple(warnings),
        schedule_unit=next((c.unit for c in s.inputs if c.name == model.schedule), ""),
        growth=law.growth,
    )


def _multiple(scores: Sequence[Array], level: float) -> Array:
    """What errors over what is expected of them are below for a share of the time, ``(channel,)``.

    The share is the mean over groups of runs. Of many groups the ones with the largest and the
    smallest errors are left out: where a model without some runs fails altogether, that is no
    measure for the one with all.
    """
    few = len(scores) < _MANY_GROUPS
    found = []
    for column in range(scores[0].shape[1]):
        ordered = [np.sort(s[:, column]) for s in scores]
        tried = np.unique(np.concatenate(ordered))
        inside = [np.searchsorted(s, tried, side="right") / len(s) for s in ordered]
        shares = np.sort(np.stack(inside), axis=0)
        share = (shares if few else shares[1:-1]).mean(axis=0)
        found.append(tried[min(int(np.searchsorted(share, level)), len(tried) - 1)])
    return np.array(found)


def _leaks(model: DFSM, runs: Sequence[Trajectory]) -> list[str]:
    """Calibration runs that were in the training data."""
    fitted = of_the_fit(model, runs)
    if not fitted:
        return []
    return [
        f"{len(fitted)} of the {len(runs)} calibration runs were used in training "
        f"({listed(fitted)}): new runs will lie inside less often than promised"
    ]

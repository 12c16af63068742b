"""Prediction intervals calibrated on runs that the model never saw.

At every operating point half-widths are a multiple of the root mean square error there; the
multiple is the quantile of the errors of each calibration run relative to what the other runs
give, so that no run is judged by a scale that it set itself (conformal prediction with one run
left out; Barber et al. 2021).
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
from dfsm.models.dfsm import DFSM
from dfsm.simulation.simulate import SimulationSettings, Status
from dfsm.validation.intervals import Intervals, interpolated, schedule_along
from dfsm.validation.validate import listed, of_the_fit, validate

# Calibration runs below which a quantile over runs means nothing.
_FEWEST = 3


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
    require(0 < level < 1, "level", level, "a share between 0 and 1")
    s = model.signals
    runs = all_completed(list(runs), s)
    if len(runs) < _FEWEST:
        raise DfsmError(
            f"intervals are calibrated on at least {_FEWEST} runs, {len(runs)} were given"
        )
    Dataset(runs)  # refuses a run that occurs twice
    validation = validate({"model": model}, runs, start=start, stop=stop, settings=settings)
    errors, schedules = [], []
    for run, compared in zip(runs, validation.runs, strict=True):
        rollout = compared.models["model"].simulation
        if rollout.status is not Status.COMPLETED:
            raise DfsmError(f"{run.where}: {rollout.message}; no interval holds such a rollout")
        names = [c.name for c in validation.channels]
        truth = compared.recorded.select(names).values
        errors.append(rollout.trajectory.select(names).values - truth)
        schedules.append(schedule_along(model.schedule, run, rollout.trajectory))
    grid = np.asarray(model.region.grid)
    squares = [_sums(grid, at, e**2) for at, e in zip(schedules, errors, strict=True)]
    scores = []
    for k, (at, e) in enumerate(zip(schedules, errors, strict=True)):
        scale = _scale([q for j, q in enumerate(squares) if j != k])
        scores.append(np.abs(e) / interpolated(grid, scale, at))
    multiple = np.quantile(np.concatenate(scores), level, axis=0)
    return Intervals(
        channels=tuple(c.name for c in validation.channels),
        units=tuple(c.unit for c in validation.channels),
        schedule=model.schedule,
        grid=grid,
        half_width=multiple * _scale(squares),
        level=level,
        runs=tuple(r.name for r in runs),
        digests=tuple(r.select(s.recorded).digest for r in runs),
        warnings=tuple(_leaks(model, runs)),
        schedule_unit=next((c.unit for c in s.inputs if c.name == model.schedule), ""),
    )


def _leaks(model: DFSM, runs: Sequence[Trajectory]) -> list[str]:
    """Calibration runs that were in the training data."""
    fitted = of_the_fit(model, runs)
    if not fitted:
        return []
    return [
        f"{len(fitted)} of the {len(runs)} calibration runs were used in training "
        f"({listed(fitted)}): new runs will lie inside less often than promised"
    ]


def _sums(grid: Array, schedule: Array, squares: Array) -> tuple[Array, Array]:
    """Weight ``(point,)`` and weighted sum of squared errors ``(point, channel)`` of one run."""
    hats = np.stack([np.interp(schedule, grid, row) for row in np.eye(len(grid))])
    return hats.sum(axis=1), hats @ squares


def _scale(sums: Sequence[tuple[Array, Array]]) -> Array:
    """Root mean square error at every point; that of all where no run has been."""
    weight, total = (np.sum([s[k] for s in sums], axis=0) for k in (0, 1))
    overall = total.sum(axis=0) / weight.sum()
    # As good as a sample of the overall error: a point that was hardly visited leans on the rest.
    spread = np.sqrt((total + overall) / (weight + 1)[:, None])
    # A channel that is always zero has no error to be divided by.
    return np.maximum(spread, np.finfo(float).tiny)

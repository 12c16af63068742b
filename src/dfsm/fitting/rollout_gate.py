"""Whether a corrective function does good in rollouts, where the model will be used.

Cross-validation judges it on the samples of runs left out. A correction may explain something
there, such as what splines make of a kink, and lead astray where a rollout goes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dfsm.core.types import Array
from dfsm.data.dataset import Dataset
from dfsm.errors import hushed
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.numerics.time_mesh import std_over
from dfsm.simulation.simulate import Simulation, Status, simulate

# Training runs that are simulated to judge a model.
_RUNS = 8
# A channel that moves by less than this share of its overall spread in a run has no error there.
_MOVES = 0.01
# Rollouts of a linear fit that are farther off than this, relative to the spread of the record, say
# nothing: half of the variance, as where small differences grow.
_TELLING = 0.7


def tried_rollouts(model: DFSM, data: Dataset, settings: FitSettings) -> dict[int, Simulation]:
    """Rollouts over training runs, a few of them spread over all, by index of the run."""
    tried = np.unique(np.linspace(0, len(data) - 1, _RUNS).astype(int)).tolist()
    some = [data[i] for i in tried]
    with hushed():
        rollouts = simulate(model, some, start=settings.start, stop=settings.stop)
    return dict(zip(tried, rollouts, strict=True))


def relative_error(
    name: str, values: Array, samples: Samples, rollouts: Mapping[int, Simulation]
) -> float:
    """RMS error of a channel over its spread, mean over runs; NaN where it moves in none.

    Parameters
    ----------
    name
        Of the channel in the rollouts.
    values
        The record, ``(sample,)``.
    samples
        Times, and which samples are of which run.
    rollouts
        Completed ones, by index of the run.
    """
    errors, whole = [], std_over(values, None)
    for run, rollout in rollouts.items():
        time, truth = samples.times[run], values[samples.parts[run]]
        weight = np.gradient(time)
        weight /= weight.sum()
        spread = float(np.sqrt(weight @ (truth - weight @ truth) ** 2))
        off = np.interp(time, rollout.trajectory.time, rollout.trajectory[name]) - truth
        if spread > _MOVES * whole:
            errors.append(float(np.sqrt(weight @ off**2)) / spread)
    return float(np.mean(errors)) if errors else float("nan")


def harm_in_rollouts(model: DFSM, data: Dataset, samples: Samples, settings: FitSettings) -> str:
    """What speaks against the correction of f̂; "" where rollouts are no worse for it.

    Parameters
    ----------
    model
        With a corrective function; outputs are not looked at.
    data, samples
        The runs, and their samples with the latent states of the model.
    settings
        Of the fit.
    """
    model = replace(model, signals=replace(model.signals, outputs=()))
    with_it = tried_rollouts(model, data, settings)
    without = tried_rollouts(model.linear_fit(), data, settings)
    done, linear = (
        {k for k, s in rollouts.items() if s.status is Status.COMPLETED}
        for rollouts in (with_it, without)
    )
    if not linear or not linear >= done:
        return ""
    plain = _error(samples, {k: without[k] for k in linear})
    if not plain < _TELLING:
        return ""
    runs = f"{len(without)} training run{'s' * (len(without) > 1)}"
    if len(done) < len(linear):
        return (
            f"with the correction {len(linear - done)} of the rollouts over {runs} end early that "
            "its own are simulated to their end"
        )
    corrected = _error(samples, {k: with_it[k] for k in linear})
    if corrected <= plain:
        return ""
    return (
        f"with the correction rollouts over {runs} are off by {corrected:.2g} of the standard "
        f"deviation, its own by {plain:.2g}"
    )


def _error(samples: Samples, rollouts: Mapping[int, Simulation]) -> float:
    """Mean of the relative errors of the recorded states."""
    columns = samples.signals.observed_columns
    names = samples.signals.names("states")[: columns.stop - columns.start]
    states = samples.inputs[:, columns]
    pairs = zip(names, states.T, strict=True)
    errors = np.array([relative_error(name, v, samples, rollouts) for name, v in pairs])
    moving = errors[~np.isnan(errors)]
    return float(moving.mean()) if len(moving) else float("nan")

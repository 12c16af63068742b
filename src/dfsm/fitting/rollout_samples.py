"""Training samples as a model sees them in a rollout, where its own states stand in for the record.

Outputs of a refined model are fitted on these: a rollout is where they will be used, and latent
states exist nowhere else.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dfsm.data.dataset import Dataset
from dfsm.errors import hushed
from dfsm.fitting.samples import Samples, known_from
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.simulation.hidden import latents_along
from dfsm.simulation.simulate import Status, simulate


def with_latents(model: DFSM, data: Dataset, samples: Samples, settings: FitSettings) -> Samples:
    """Add the latent states of a model to the inputs of recorded samples."""
    if not model.signals.latents:
        return samples
    paths = []
    for run in data:
        inside = np.isin(run.time, run.window(known_from(run, settings), settings.stop).time)
        paths.append(latents_along(model, run)[inside])
    at = model.signals.observed_columns.stop
    inputs = np.insert(samples.inputs, [at] * len(model.signals.latents), np.concatenate(paths), 1)
    return replace(samples, inputs=inputs, signals=model.signals)


def along_rollouts(model: DFSM, data: Dataset, samples: Samples, settings: FitSettings) -> Samples:
    """Samples whose states are those of the model's rollouts of the training runs.

    A run whose rollout ends early keeps its recorded states. `samples` come from `with_latents`.
    """
    # Its outputs are what is going to be fitted.
    model = replace(model, signals=replace(model.signals, outputs=()))
    with hushed():
        rollouts = simulate(model, list(data), start=settings.start, stop=settings.stop)
    inputs = samples.inputs.copy()
    names = model.signals.names("states")
    columns = model.signals.state_columns
    for run, rollout, rows in zip(data, rollouts, samples.parts, strict=True):
        if rollout.status is Status.COMPLETED:
            inside = rollout.trajectory.window(known_from(run, settings), settings.stop)
            inputs[rows, columns] = inside.select(names).values
    return replace(samples, inputs=inputs)

"""Training samples as a model sees them in a rollout, where its own states stand in for the record.

Outputs of a refined model are fitted on these: a rollout is where they will be used, and latent
states exist nowhere else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dfsm.data.dataset import Dataset
from dfsm.errors import hushed
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.simulation.hidden import latents_along
from dfsm.simulation.simulate import Status, simulate

# Runs that are simulated at once: rollouts of all would take as much memory as the samples.
_AT_ONCE = 64


def with_latents(model: DFSM, data: Dataset, samples: Samples, settings: FitSettings) -> Samples:
    """Add the latent states of a model to the inputs of recorded samples, and take its terms."""
    if not model.signals.latents:
        return replace(samples, terms=model.terms)
    paths = []
    for run in data:
        inside = np.isin(run.time, run.window(*settings.window_of(run)).time)
        paths.append(latents_along(model, run)[inside])
    s = model.signals
    if s.telling:
        samples = _with_outputs(samples, s.telling)
    at = s.observed_columns.stop
    inputs = np.insert(samples.inputs, [at] * len(s.latents), np.concatenate(paths), 1)
    return replace(samples, inputs=inputs, signals=s, terms=model.terms)


def _with_outputs(samples: Samples, names: Sequence[str]) -> Samples:
    """The samples where measured states have become outputs of hidden ones."""
    s = samples.signals
    gone = [i for i, c in enumerate(s.states) if c.name in names]
    columns = np.array(gone) + s.state_columns.start
    seen = [samples.inputs[rows][:, columns] for rows in samples.parts]
    return replace(
        samples,
        inputs=np.delete(samples.inputs, columns, axis=1),
        recorded=tuple(np.column_stack(pair) for pair in zip(samples.recorded, seen, strict=True)),
        derivatives=np.delete(samples.derivatives, gone, axis=1),
        derivative_names=tuple(n for i, n in enumerate(samples.derivative_names) if i not in gone),
    )


def along_rollouts(model: DFSM, data: Dataset, samples: Samples, settings: FitSettings) -> Samples:
    """Samples whose states are those of the model's rollouts of the training runs.

    A run whose rollout ends early keeps its recorded states. `samples` come from `with_latents`.
    """
    if not model.signals.telling:
        # Its outputs are what is going to be fitted.
        model = replace(model, signals=replace(model.signals, outputs=()))
    inputs, parts = samples.inputs.copy(), samples.parts
    names = model.signals.names("states")
    columns = model.signals.state_columns
    for first in range(0, len(data), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        with hushed():
            rollouts = simulate(model, data[some], start=settings.start, stop=settings.stop)
        for run, rollout, rows in zip(data[some], rollouts, parts[some], strict=True):
            if rollout.status is Status.COMPLETED:
                inside = rollout.trajectory.window(*settings.window_of(run))
                inputs[rows, columns] = inside.select(names).values
    return replace(samples, inputs=inputs)

"""Refinement on one division of the runs: train on some until others are no longer met better."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice

import numpy as np

from dfsm.core.progress import track
from dfsm.core.types import Array
from dfsm.data.dataset import Dataset
from dfsm.errors import DfsmError, near_matches
from dfsm.models.dfsm import DFSM
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Step
from dfsm.refinement.growth import StabilityKept
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import Record, record_of
from dfsm.refinement.rollout_error import ErrorWeights, RolloutError
from dfsm.refinement.settings import RefineSettings
from dfsm.refinement.start import start_latents, start_network

# Steps without progress on the validation runs after which a stage ends.
_PATIENCE = 6
LATE = "the time was up (refine.seconds)"


@dataclass(frozen=True)
class Course:
    """What all divisions of the runs have in common."""

    model: DFSM
    settings: RefineSettings
    window: tuple[float | None, float | None]
    common: Sequence[str]
    seed: int
    began: float = field(default_factory=clock.perf_counter)

    @cached_property
    def weights(self) -> ErrorWeights:
        """How much each error counts."""
        return _weights(self.model, self.settings)

    def late(self, share: float = 1.0) -> bool:
        """Whether the time is up, or such a share of it."""
        limit = self.settings.seconds
        return limit is not None and clock.perf_counter() - self.began > share * limit

    def late_by_stage(self, begin: float, end: float) -> list[Callable[[], bool]]:
        """Whether the time of each stage is up, all together having some shares of the whole.

        What windows of the first length have learnt need not hold over the last, and is lost where
        these have no time left.
        """
        count = len(self.settings.windows)
        shares = [begin + (end - begin) * (k + 1) / count for k in range(count)]
        return [partial(self.late, share) for share in shares]

    def records(self, part: Dataset) -> list[list[Record]]:
        """What rollouts are compared with, in groups of runs with the same disturbances."""
        return [
            [record_of(self.model, part[k], self.settings.step, *self.window) for k in group]
            for group in part.matched(self.common)
        ]

    def parameters(self, records: Sequence[Sequence[Record]]) -> Parametrization:
        """What may change, with the latent states and the network that are asked for."""
        runs = [record for group in records for record in group]
        spread = _spread(runs)
        started, settings = self.model, self.settings
        if settings.latents and not started.signals.pairs:
            drivers = _drivers(started, settings)
            started = start_latents(started, runs, settings.latents, spread, drivers)
        if settings.network and started.e is None:
            started = start_network(started, settings.network, spread, self.seed)
        return Parametrization.of(started, spread)

    def problem(
        self,
        parameters: Parametrization,
        records: Sequence[Sequence[Record]],
        length: float | None,
    ) -> RolloutError:
        """The error that training lowers."""
        samples = sum(r.states[1:].size for group in records for r in group)
        kept = StabilityKept(parameters, samples)
        return RolloutError(parameters, records, length, self.weights, kept)


@dataclass(frozen=True)
class Trial:
    """One division of the runs: errors of those held out, and where training led.

    `steps` is the number of steps in each stage after which those held out were met best, and
    `training` and `validation` are names of runs.
    """

    before: float
    after: float
    parameters: Parametrization
    best: Array
    steps: tuple[int, ...]
    history: tuple[dict[str, float], ...]
    ended: tuple[str, ...]
    train: list[list[Record]]
    held: list[list[Record]]
    training: tuple[str, ...]
    validation: tuple[str, ...]


def _spread(runs: Sequence[Record]) -> Array:
    return np.sqrt(np.mean([np.mean(r.slopes**2, axis=0) for r in runs], axis=0))


def try_out(
    course: Course, training: Dataset, validation: Dataset, begin: float = 0.0, end: float = 1.0
) -> Trial:
    """Train on some of the runs until the others are no longer met better.

    Parameters
    ----------
    course
        Model and settings.
    training, validation
        The division of the runs.
    begin, end
        Shares of the time at which this division begins and ends.
    """
    settings = course.settings
    train, held = course.records(training), course.records(validation)
    runs = [record for group in train for record in group]
    unrefined = Parametrization.of(course.model, _spread(runs))
    final = RolloutError(unrefined, held, settings.windows[-1], course.weights)
    before = after = final.relative(np.zeros(unrefined.size))
    parameters = course.parameters(train)
    final = RolloutError(parameters, held, settings.windows[-1], course.weights)
    best = at = np.zeros(parameters.size)
    history: list[dict[str, float]] = []
    ended: list[str] = []
    steps: list[int] = []
    late = course.late_by_stage(begin, end)
    for stage, length in enumerate(settings.windows):
        problem = course.problem(parameters, train, length)
        check = RolloutError(parameters, held, length, course.weights)
        at, entries, taken, why = _stage(problem, check, at, settings.iterations, late[stage])
        history += [{"stage": stage, **entry} for entry in entries]
        ended.append(why)
        steps.append(taken)
        error = final.relative(at)
        if error < after:
            best, after = at, error
    return Trial(
        before=before,
        after=after,
        parameters=parameters,
        best=best,
        steps=tuple(steps),
        history=tuple(history),
        ended=tuple(ended),
        train=train,
        held=held,
        training=tuple(run.name for run in training),
        validation=tuple(run.name for run in validation),
    )


def _drivers(model: DFSM, settings: RefineSettings) -> tuple[str, ...] | None:
    names = [c.name for c in model.signals.inputs if c.name in model.signals.driving]
    unknown = [n for n in settings.latent_inputs or () if n not in names]
    if unknown:
        raise DfsmError(
            f"refine.latent_inputs names '{unknown[0]}', which is no control or disturbance of "
            "the model; " + near_matches(unknown[0], names)
        )
    return settings.latent_inputs


def _weights(model: DFSM, settings: RefineSettings) -> ErrorWeights:
    names = [c.name for c in model.signals.observed]
    unknown = [n for n in settings.weights if n not in names]
    if unknown:
        raise DfsmError(
            f"refine.weights names '{unknown[0]}', which is no state: choose among "
            f"{', '.join(names)}"
        )
    states = np.array([settings.weights.get(n, 1.0) for n in names])
    return ErrorWeights(states, settings.correlation, settings.decay)


# -- stages -------------------------------------------------------------------------------------


def _stage(
    problem: RolloutError,
    check: RolloutError,
    start: Array,
    limit: int,
    late: Callable[[], bool],
) -> tuple[Array, list[dict[str, float]], int, str]:
    """Step until the validation windows no longer improve.

    Returns
    -------
    tuple
        The best weights, one entry of the history per step, after how many of them those weights
        were reached, and why there are no more.
    """
    best, error, taken = start, check.relative(start), 0
    history: list[dict[str, float]] = []
    steps = LevenbergMarquardt(problem, Step(start), 0.0)
    for count, step in enumerate(track(islice(steps, limit), "refining", limit), start=1):
        now = check.relative(step.weights)
        history.append({"training": problem.relative(step.weights), "validation": now})
        if now < error:
            best, error, taken = step.weights, now, count
        if count - taken >= _PATIENCE:
            why = f"no better on the runs held out for {_PATIENCE} steps"
            return best, history, taken, why
        if late():
            return best, history, taken, LATE
    return best, history, taken, _reason(steps, limit)


def train_on_all(
    problem: RolloutError, start: Array, limit: int, late: Callable[[], bool]
) -> tuple[Array, list[dict[str, float]], str]:
    """Step at most so many times; as `_stage`, with the last weights."""
    at = start
    history: list[dict[str, float]] = []
    steps = LevenbergMarquardt(problem, Step(start), 0.0)
    for step in track(islice(steps, limit), "refining", limit):
        at = step.weights
        history.append({"training": problem.relative(at)})
        if late():
            return at, history, LATE
    return at, history, _reason(steps, limit)


def _reason(steps: LevenbergMarquardt, limit: int) -> str:
    return steps.stop.value if steps.stop else f"as many steps as allowed ({limit})"

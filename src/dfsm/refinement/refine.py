"""Rollout refinement: from the derivative fit as the start, minimise the simulation error.

A derivative fit answers what the state does next; a user asks where it is in ten minutes. Small
errors of the derivative that always point the same way, such as missing damping, cost little in the
first and everything in the second. Here the coefficients change until rollouts over windows of the
training runs follow the record,

    min_w  Σ_windows Σ_t |(ξ̂(t; w) - ξ(t)) / σ|² ,

with exact forward sensitivities through the integrator and Levenberg-Marquardt. Windows grow stage
by stage: over short ones a poor start does no harm, over long ones slow errors show. Runs held out
of the training decide when to stop, and a model that is no better on them is not handed out. Then
they are learnt from, too: as many steps as the last stage took follow on all runs.
"""

from __future__ import annotations

import time as clock
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from dfsm.core.progress import track
from dfsm.core.renamed import renamed
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.data.dataset import Dataset
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, DfsmWarning, near_matches
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import with_latent_range
from dfsm.models.signals import Provenance
from dfsm.numerics.levenberg_marquardt import LevenbergMarquardt, Step
from dfsm.refinement.growth import StabilityKept
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.rollout_error import ErrorWeights, RolloutError, record_of
from dfsm.refinement.start import start_latents, start_network

# Steps without progress on the validation runs after which a stage ends.
_PATIENCE = 6
_LATE = "the time was up (refine.seconds)"


@settings_class
class RefineSettings:
    """How a model is refined on rollouts.

    Attributes
    ----------
    windows
        Lengths of the rollouts in s, one stage after the other; None is a whole run.
    step
        Integration step in s; inputs are averaged over it.
    latents
        Number of latent states to add to a model that has none, an even number, see `latents.py`.
    latent_inputs
        Controls and disturbances that drive them; None takes all.
    network
        Hidden units of a tanh network to add to a derivative function that is not corrected; what
        derivatives do not show, rollouts may. `fit` then corrects outputs only.
    iterations
        Largest number of Levenberg-Marquardt steps per stage.
    decay
        Weight of the squared deviations from the start, in which a unit changes a derivative by
        about its own spread, beside the sum of squared errors relative to their spread.
    hold_out
        Share of the runs that decide when to stop, at least one; last of all they train, too.
    correlation
        Between the errors of runs that have the same disturbances and differ in their controls:
        at 0.8, the difference of two such runs counts five times and their mean about half, see
        `rollout_error.py`, and both are held out or neither is. 0 takes all runs as unrelated.
    weights
        Weight of a state's squared error, by name; 1 for all others.
    seconds
        No further step is begun after this time; None sets no limit.
    """

    windows: tuple[float | None, ...] = (20.0, 100.0, None)
    step: float = 0.25
    iterations: int = 20
    latents: int = 0
    latent_inputs: tuple[str, ...] | None = None
    network: int = 0
    decay: float = 0.0
    hold_out: float = 0.2
    correlation: float = 0.0
    weights: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None

    def __post_init__(self) -> None:
        require(bool(self.windows), "refine.windows", self.windows, "at least one length")
        for length in self.windows:
            good = length is None or length > self.step
            require(good, "refine.windows", length, "lengths in s, longer than refine.step")
        require(self.step > 0, "refine.step", self.step, "more than 0 s")
        even = self.latents >= 0 and self.latents % 2 == 0
        require(even, "refine.latents", self.latents, "an even number: they come in pairs")
        some = self.latent_inputs is None or len(self.latent_inputs) > 0
        require(some, "refine.latent_inputs", self.latent_inputs, "at least one name, or null")
        require(self.network >= 0, "refine.network", self.network, "a number of units, or 0")
        require(self.decay >= 0, "refine.decay", self.decay, "0 or more")
        require(self.iterations >= 1, "refine.iterations", self.iterations, "at least 1")
        require(0 < self.hold_out < 1, "refine.hold_out", self.hold_out, "a share between 0 and 1")
        good = 0 <= self.correlation < 1
        require(good, "refine.correlation", self.correlation, "at least 0 and less than 1")
        for name, weight in self.weights.items():
            require(weight >= 0, f"refine.weights.{name}", weight, "0 or more")


@dataclass(frozen=True)
class RefineResult:
    """What `refine` returns.

    Attributes
    ----------
    model
        The refined model, or its start where refinement did not help.
    improved
        Whether it is the refined one.
    before, after
        Mean squared error of the validation rollouts relative to each state's variance, over
        the last of the windows, weighted as in training; `after` is that of the best refined
        model before it saw them.
    history
        One entry per step: stage, training and validation error; of the steps on all runs, which
        come last, the training error alone.
    ended
        Why each stage ended, and last the steps on all runs, if any.
    message
        The outcome in one sentence.
    """

    model: DFSM
    improved: bool
    before: float
    after: float
    history: tuple[dict[str, float], ...]
    ended: tuple[str, ...]
    message: str


# One thread for each product of matrices: several runs are at work already.
@renamed(choices="settings")
@threadpool_limits.wrap(limits=1)
def refine(
    model: DFSM,
    runs: Iterable[Trajectory],
    settings: RefineSettings | None = None,
    *,
    start: float | None = None,
    stop: float | None = None,
    seed: int = 0,
) -> RefineResult:
    """Refine a model on rollouts over training runs.

    Parameters
    ----------
    model
        Where to start: all coefficients of its derivative function may change, linear and
        corrective ones and the dynamics of latent states; kinematic rows, coefficients known from
        physics, and outputs stay.
    runs
        Training runs; some of them are held out to decide when to stop.
    settings
        See `RefineSettings`; None takes the defaults.
    start, stop
        Time window in s, as in the fit.
    seed
        Decides which runs are held out at first.

    Returns
    -------
    RefineResult
        A refined model was not worse on the runs held out than its start before it learnt from
        them. It is stable at all schedule values if its start is, with the schedule frozen; `fit`
        also looks along recorded paths.

    Raises
    ------
    DfsmError
        Fewer than two runs, runs too short for the windows, or an unknown state in the weights.

    Warns
    -----
    DfsmWarning
        Refinement did not help and its start is returned.
    """
    settings = settings or RefineSettings()
    data, common = Dataset(runs), ()
    if settings.correlation:
        # What is computed from others is the same where they are.
        common = [n for n in model.signals.names("disturbances") if n in data.names]
    training, validation = data.split(settings.hold_out, seed, common)
    weights = _weights(model, settings)
    train, held = (
        [[record_of(model, part[k], settings.step, start, stop) for k in group] for group in groups]
        for part, groups in ((d, d.matched(common)) for d in (training, validation))
    )
    train_runs = [record for group in train for record in group]
    began = clock.perf_counter()

    def late() -> bool:
        return settings.seconds is not None and clock.perf_counter() - began > settings.seconds

    spread = np.sqrt(np.mean([np.mean(r.slopes**2, axis=0) for r in train_runs], axis=0))
    parameters = Parametrization.of(model, spread)
    final = RolloutError(parameters, held, settings.windows[-1], weights)
    at = np.zeros(parameters.size)
    before = after = final.relative(at)
    started = model
    if settings.latents and not model.signals.latents:
        drivers = _drivers(model, settings)
        started = start_latents(started, train_runs, settings.latents, spread, drivers)
    if settings.network and model.e is None:
        started = start_network(started, settings.network, spread, seed)
    if started is not model:
        parameters = Parametrization.of(started, spread)
        final = RolloutError(parameters, held, settings.windows[-1], weights)
        at = np.zeros(parameters.size)
    best, samples = at, sum(r.states[1:].size for r in train_runs)
    kept = StabilityKept(parameters, samples)
    history: list[dict[str, float]] = []
    ended: list[str] = []
    for stage, length in enumerate(settings.windows):
        problem = RolloutError(parameters, train, length, weights, kept)
        check = RolloutError(parameters, held, length, weights)
        at, entries, why = _stage(problem, check, at, settings.iterations, late)
        history += [{"stage": stage, **entry} for entry in entries]
        ended.append(why)
        error = final.relative(at)
        if error < after:
            best, after = at, error
    if after < before and not late():
        length, stage = settings.windows[-1], len(settings.windows)
        count = sum(entry["stage"] == stage - 1 for entry in history)
        problem = RolloutError(parameters, [*train, *held], length, weights, kept)
        best, entries, why = _on_all(problem, best, count, late)
        history += [{"stage": stage, **entry} for entry in entries]
        ended.append(why)
    refined = parameters.at(jnp.asarray(best))
    if refined.signals.latents:
        refined = with_latent_range(refined, [r.latent_states(refined) for r in train_runs])
    names = {"training": [r.name for r in training], "validation": [r.name for r in validation]}
    return _result(model, refined, (before, after), (history, ended), names)


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
) -> tuple[Array, list[dict[str, float]], str]:
    """Step until the validation windows no longer improve.

    Returns
    -------
    tuple
        The best weights, one entry of the history per step, and why there are no more.
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
            return best, history, f"no better on the runs held out for {_PATIENCE} steps"
        if late():
            return best, history, _LATE
    return best, history, _reason(steps, limit)


def _on_all(
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
            return at, history, _LATE
    return at, history, _reason(steps, limit)


def _reason(steps: LevenbergMarquardt, limit: int) -> str:
    return steps.stop.value if steps.stop else f"as many steps as allowed ({limit})"


def _result(
    model: DFSM,
    refined: DFSM,
    errors: tuple[float, float],
    account: tuple[Sequence[dict[str, float]], Sequence[str]],
    names: Mapping[str, list[str]],
) -> RefineResult:
    (before, after), (history, ended) = errors, account
    improved = after < before
    figures = f"{np.sqrt(before):.3g} to {np.sqrt(after):.3g}"
    if improved:
        message = (
            f"refined on {len(names['training'])} runs: the error of rollouts over those held out "
            f"({', '.join(names['validation'])}) went from {figures} standard deviations; some "
            "steps on all runs followed"
        )
        record = dict(model.provenance.record)
        record["refinement"] = {
            **names,
            "before": before,
            "after": after,
            "ended": list(ended),
            "message": message,
        }
        model = replace(refined, provenance=Provenance(record))
    else:
        tried = [e["validation"] for e in history if "validation" in e]
        best = f", at best {np.sqrt(min(tried)):.3g} after a step" if tried else ""
        message = (
            "refinement did not lower the error of rollouts over the runs held out "
            f"({np.sqrt(before):.3g} standard deviations{best}; {ended[-1]}), so the model it "
            "started from is returned: use more runs, or shorter refine.windows"
        )
        warnings.warn(message, DfsmWarning, stacklevel=3)
    return RefineResult(model, improved, before, after, tuple(history), tuple(ended), message)

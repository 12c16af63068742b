"""Rollout refinement: from the derivative fit as the start, minimise the simulation error.

A derivative fit answers what the state does next; a user asks where it is in ten minutes. Small
errors of the derivative that always point the same way, such as missing damping, cost little in the
first and everything in the second. Here the coefficients change until rollouts over windows of the
training runs follow the record,

    min_w  Σ_windows Σ_t |(ξ̂(t; w) - ξ(t)) / σ|² ,

with exact gradients through the integrator and Levenberg-Marquardt. Windows grow stage by stage:
over short ones a poor start does no harm, over long ones slow errors show. Runs held out of the
training decide when to stop, and a model that is no better on them is not handed out. Then they are
learnt from, too: as many steps as the last stage took follow on all runs. Where runs are held out
several times, others each time, all runs are learnt from at last, from the start and with as many
steps per stage as were best in the median.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from dfsm.core.host import from_host
from dfsm.core.renamed import renamed
from dfsm.data.dataset import Dataset
from dfsm.data.hold_out import checked, divisions
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmWarning, printable
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.latents import with_latent_range
from dfsm.models.signals import Provenance
from dfsm.refinement.settings import RefineSettings
from dfsm.refinement.trial import LATE, Course, Trial, train_on_all, try_out


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
    splits
        `before` and `after` of every division of the runs, of which they are the means.
    """

    model: DFSM
    improved: bool
    before: float
    after: float
    history: tuple[dict[str, float], ...]
    ended: tuple[str, ...]
    message: str
    splits: tuple[tuple[float, float], ...] = ()

    def __repr__(self) -> str:
        return f"<RefineResult: {printable(self.message)}; {len(self.history)} steps>"


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
    require_model(model)
    settings = settings or RefineSettings()
    data, common = Dataset(runs), ()
    if settings.correlation:
        # What is computed from others is the same where they are.
        common = [n for n in model.signals.names("disturbances") if n in data.names]
    hold_out = checked(settings.hold_out, "refine.hold_out")
    parts = divisions(data, hold_out, seed, common, start, stop)
    course = Course(model, settings, (start, stop), common, seed)
    # Training on all runs has as much of the time as each division.
    last = len(settings.windows) - 1
    shares = np.linspace(0, 1, len(parts) + 2).tolist()
    trials = [try_out(course, *part, *shares[k : k + 2]) for k, part in enumerate(parts)]
    first = trials[0]
    before, after = _means(trials)
    history, ended = list(first.history), list(first.ended)
    parameters, at, records = first.parameters, first.best, [*first.train, *first.held]
    if len(trials) == 1 and after < before and not course.late():
        count = sum(entry["stage"] == last for entry in history)
        problem = course.problem(parameters, records, settings.windows[-1])
        at, entries, why = train_on_all(problem, at, count, course.late)
        history += [{"stage": last + 1, **entry} for entry in entries]
        ended.append(why)
    elif len(trials) > 1 and after < before:
        history = [{"split": k, **entry} for k, t in enumerate(trials) for entry in t.history]
        steps = np.median([t.steps for t in trials], axis=0)
        parameters = course.parameters(records)
        at, late = np.zeros(parameters.size), course.late_by_stage(*shares[-2:])
        for stage, (length, count) in enumerate(zip(settings.windows, steps, strict=True)):
            problem = course.problem(parameters, records, length)
            at, entries, why = train_on_all(problem, at, round(count), late[stage])
            history += [{"stage": stage, **entry} for entry in entries]
            ended.append(why)
    refined = parameters.at(from_host(at))
    if refined.signals.latents:
        seen = first.train if len(trials) == 1 else records
        paths = [record.latent_states(refined) for group in seen for record in group]
        refined = with_latent_range(refined, paths)
    return _result(model, refined, trials, (history, ended), last)


def _means(trials: Sequence[Trial]) -> tuple[float, float]:
    """Errors of runs held out before and after, over all divisions."""
    return (
        float(np.mean([trial.before for trial in trials])),
        float(np.mean([trial.after for trial in trials])),
    )


def _result(
    model: DFSM,
    refined: DFSM,
    trials: Sequence[Trial],
    account: tuple[Sequence[dict[str, float]], Sequence[str]],
    last: int,
) -> RefineResult:
    history, ended = account
    before, after = _means(trials)
    improved = after < before
    if improved:
        message = f"{_account(trials)}; " + (
            "some steps on all runs followed"
            if len(trials) == 1
            else "training on all runs followed, from the start"
        )
        record = dict(model.provenance.record)
        record["refinement"] = {
            "training": list(trials[0].training),
            "validation": list(trials[0].validation),
            "before": before,
            "after": after,
            "ended": list(ended),
            "message": message,
        }
        if len(trials) > 1:
            record["refinement"]["splits"] = [
                {"validation": list(t.validation), "before": t.before, "after": t.after}
                for t in trials
            ]
        model = replace(refined, provenance=Provenance(record))
    else:
        # Over windows of the last length: shorter ones have smaller errors.
        tried = [e["validation"] for e in history if "validation" in e and e["stage"] == last]
        best = f", at best {np.sqrt(min(tried)):.3g} after a step" if tried else ""
        advice = "more refine.seconds, " if LATE in ended else ""
        message = (
            "refinement did not lower the error of rollouts over the runs held out "
            f"({np.sqrt(before):.3g} standard deviations{best}; {ended[-1]}), so the model it "
            f"started from is returned: use {advice}more runs, or shorter refine.windows"
        )
        warnings.warn(message, DfsmWarning, stacklevel=3)
    splits = tuple((t.before, t.after) for t in trials)
    return RefineResult(
        model, improved, before, after, tuple(history), tuple(ended), message, splits
    )


def _account(trials: Sequence[Trial]) -> str:
    """Errors of the runs held out, and how they differ from split to split."""
    first, last = np.sqrt([t.before for t in trials]), np.sqrt([t.after for t in trials])
    if len(trials) == 1:
        runs = len(trials[0].training)
        return (
            f"refined on {runs} run{'s' * (runs != 1)}: the error of rollouts over those held out "
            f"({', '.join(trials[0].validation)}) went from {first[0]:.3g} to {last[0]:.3g} "
            "standard deviations"
        )
    return (
        f"refined with runs held out {len(trials)} times: the error of rollouts over them went "
        f"from {first.min():.3g}-{first.max():.3g} to {last.min():.3g}-{last.max():.3g} standard "
        "deviations"
    )

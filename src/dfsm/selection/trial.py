"""One candidate structure: fit it, simulate the validation runs, say how far off it was."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from dfsm.core.files import json_value
from dfsm.core.types import Array
from dfsm.core.version import __version__
from dfsm.data.conversion import in_units_of
from dfsm.data.derivatives import differentiate, lead_in
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, DfsmWarning, hushed
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.models.signals import with_computed
from dfsm.numerics.time_mesh import weights_over_time
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.refine import RefineSettings
from dfsm.simulation.simulate import Status, simulate
from dfsm.validation.results import ChannelError, spread, training_spreads


@dataclass(frozen=True)
class Candidate:
    """A way to build a model, to be compared with others.

    Attributes
    ----------
    settings
        Signals and settings of the fit. The nonlinear-only model is not fitted.
    refine
        Refinement on rollouts, if any.
    changes
        What is different about it, for the table.
    """

    settings: FitSettings
    refine: RefineSettings | None = None
    changes: str = ""

    def fingerprint(self, course: Course) -> str:
        """Digest of all that decides the outcome: settings, runs, reference, version."""
        said = {
            "dfsm": __version__,
            "settings": asdict(replace(self.settings, nonlinear_only=False)),
            "refine": None if self.refine is None else asdict(self.refine),
            "training": [run.digest for run in course.training],
            "validation": [run.digest for run in course.validation],
            "reference": course.reference_digest,
        }
        text = json.dumps(json_value(said), sort_keys=True)
        return hashlib.sha256(text.encode("utf-8", errors="backslashreplace")).hexdigest()


@dataclass(frozen=True)
class Course:
    """What every candidate goes through: the same runs, the same records to be measured by.

    Attributes
    ----------
    training, validation
        Runs to fit, and to be judged on.
    references
        Per validation run the recorded states inside the time window by name, shape ``(time,)``.
    """

    training: tuple[Trajectory, ...]
    validation: tuple[Trajectory, ...]
    references: tuple[Mapping[str, Array], ...]

    @classmethod
    def of(
        cls, training: Sequence[Trajectory], validation: Sequence[Trajectory], settings: FitSettings
    ) -> Course:
        """Take the records as `settings` do: measured states as they stand, rates as extracted.

        Candidates with filters of their own would else each be judged by another record.
        """
        judged = [in_units_of(r, training[0].channels, "the training runs") for r in validation]
        references = tuple(_reference(run, settings) for run in judged)
        return cls(tuple(training), tuple(judged), references)

    @property
    def reference_digest(self) -> str:
        """Digest of the references."""
        h = hashlib.sha256()
        for reference in self.references:
            for name, values in sorted(reference.items()):
                h.update(name.encode("utf-8", errors="backslashreplace") + values.tobytes())
        return h.hexdigest()


@dataclass(frozen=True)
class Outcome:
    """How a candidate did.

    Attributes
    ----------
    message
        Why it could not be fitted; empty where it was.
    nrmse
        Per state the mean over the validation runs of the RMS error of the rollout over the
        standard deviation of the record; None where a rollout ended early.
    diverged
        Number of rollouts that ended early.
    fit_seconds, simulate_seconds
        Wall time of the fit and of one rollout, compiled.
    parameters
        Number of coefficients of the derivative function.
    warnings
        What the fit warned of.
    discarded
        Why a refinement was not taken over; empty where it was, or none was asked for.
    """

    message: str = ""
    nrmse: Mapping[str, float | None] = field(default_factory=dict)
    diverged: int = 0
    fit_seconds: float = 0.0
    simulate_seconds: float = 0.0
    parameters: int = 0
    warnings: tuple[str, ...] = ()
    discarded: str = ""


def try_out(course: Course, candidate: Candidate) -> tuple[Outcome, DFSM | None]:
    """Fit a candidate and simulate the validation runs; a mistake is an outcome, too."""
    settings = replace(candidate.settings, nonlinear_only=False)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", DfsmWarning)
            result = fit(course.training, settings, candidate.refine)
        with hushed():  # the outcome tells
            outcome = _judge(result.model, course, settings)
    except DfsmError as error:
        return Outcome(message=str(error)), None
    notes = tuple(str(w.message) for w in caught if issubclass(w.category, DfsmWarning))
    seconds = sum(result.seconds.values())
    refinement = result.model.provenance.record.get("refinement", {})
    discarded = "" if refinement.get("improved", True) else refinement["message"]
    outcome = replace(outcome, fit_seconds=seconds, warnings=notes, discarded=discarded)
    return outcome, result.model


def _judge(model: DFSM, course: Course, settings: FitSettings) -> Outcome:
    window: dict[str, Any] = {"start": settings.start, "stop": settings.stop}
    simulate(model, course.validation, **window)  # compiles
    simulations = simulate(model, course.validation, **window)
    diverged = sum(s.status is not Status.COMPLETED for s in simulations)
    pairs = list(zip((s.trajectory for s in simulations), course.references, strict=True))
    measured = [c.name for c in model.signals.observed if c.name in course.references[0]]
    usual = training_spreads(model)
    nrmse = {n: None if diverged else _mean_nrmse(pairs, n, usual[n]) for n in measured}
    return Outcome(
        nrmse=nrmse,
        diverged=diverged,
        simulate_seconds=float(np.mean([s.wall_time for s in simulations])),
        parameters=Parametrization.of(model, np.ones(len(model.signals.observed))).size,
    )


def _mean_nrmse(
    pairs: Sequence[tuple[Trajectory, Mapping[str, Array]]], name: str, usual: float
) -> float:
    """Over the runs in which a state moves; over all where it moves in none."""
    errors = [
        (ChannelError.of(x[name], r[name], weights_over_time([x.time])), r[name]) for x, r in pairs
    ]
    moving = [e.unless_still(recorded, usual).nrmse for e, recorded in errors]
    known = [v for v in moving if not np.isnan(v)]
    return float(np.mean(known or [e.nrmse for e, _ in errors]))


def _reference(run: Trajectory, settings: FitSettings) -> dict[str, Array]:
    run = with_computed(run, settings.hub_height, settings.features)
    head = lead_in(run, settings.start, settings.derivatives)
    rates = differentiate(head, settings.states, settings.derivatives)
    recorded = run.window(settings.start, settings.stop)
    extracted = rates.trajectory.window(settings.start, settings.stop)
    values = {n: recorded[n] if n in recorded else extracted[n] for n in rates.names}
    for name, value in values.items():
        if not spread(value):
            raise DfsmError(
                f"state '{name}' is constant in the validation run {run.where}, so an error has "
                "no scale there: choose other runs with compare.validation"
            )
    return values

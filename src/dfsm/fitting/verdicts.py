"""A verdict on every channel in words: usable, for trends only, not usable; why, and what to try.

A user wants to know what a model is good for, not what its residuals are. Rollouts over recorded
runs answer that: their error relative to what the channel does there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dfsm.fitting.doubts import Doubts
from dfsm.fitting.rollout_gate import relative_error
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.models.stability import Growth
from dfsm.simulation.simulate import Simulation, Status

# Error of a rollout over the standard deviation of the record. At 0.3 a curve lies on the other but
# for detail, at 0.7 half of the variance is explained.
USABLE, TRENDS = 0.3, 0.7


def grade(error: float | None) -> str:
    """The verdict on a relative error of rollouts; None is for rollouts that ended early."""
    if error is None or not error <= TRENDS:
        return "not usable"
    return "usable" if error <= USABLE else "for trends only"


@dataclass(frozen=True)
class Evidence:
    """What verdicts rest on.

    Attributes
    ----------
    rollouts
        By index of the run, simulated over the time of the samples.
    doubts
        About the linear fit; None where it was refined since.
    growths
        Of the whole model.
    refined
        Whether rollouts taught the model.
    discarded
        Whether what they taught was no better on runs held out.
    records
        What is wrong with records of states or inputs, by channel.
    grows
        At which rate the plant itself grows in open loop, in 1/s; None where it does not, or where
        nobody can tell it from a fault of the fit.
    """

    rollouts: Mapping[int, Simulation]
    doubts: Doubts | None
    growths: Sequence[Growth]
    refined: bool
    discarded: bool = False
    records: Mapping[str, str] = field(default_factory=dict)
    grows: float | None = None


def verdicts(samples: Samples, settings: FitSettings, evidence: Evidence) -> list[dict[str, Any]]:
    """Judge measured states and outputs by rollouts.

    Parameters
    ----------
    samples
        With the recorded states and outputs.
    settings
        Of the fit.
    evidence
        Rollouts and what else is known.

    Returns
    -------
    list of dict
        ``name``, ``nrmse`` (None where a rollout ended early), ``verdict``, ``text``, and
        ``doubt``: whether something speaks against it whatever the rollouts say.
    """
    columns = samples.signals.observed_columns
    states = samples.inputs[:, columns]
    names = [c.name for c in samples.signals.states][: states.shape[1]]
    measured = [spec.name for spec in settings.states]
    outputs = dict(zip(samples.signals.names("outputs"), samples.outputs.T, strict=True))
    recorded = {n: outputs[n] if n in outputs else states[:, names.index(n)] for n in measured}
    recorded |= outputs
    ended = [s for s in evidence.rollouts.values() if s.status is not Status.COMPLETED]
    entries = []
    for name, values in recorded.items():
        error = None if ended else relative_error(name, values, samples, evidence.rollouts)
        if error is not None and not np.isfinite(error):
            continue
        runs = f"{len(evidence.rollouts)} training run{'s' * (len(evidence.rollouts) > 1)}"
        verdict = grade(error)
        if error is None:
            why = f"{len(ended)} of the rollouts over {runs} end early"
        else:
            why = f"rollouts over {runs} are off by {error:.2g} of its standard deviation"
        text = f"{verdict}: {why}"
        doubt = _doubt(name, settings, evidence)
        if verdict != "usable":
            reason, advice = ("", "") if doubt is None else (f", and {doubt[0]}", doubt[1])
            if doubt is None:
                reason, advice = _advice(name, settings, evidence)
            rollouts = " on its own" if doubt is None and evidence.grows is not None else ""
            text = f"{verdict}{rollouts}, because {why}{reason}; try {advice}"
        elif doubt is not None:
            verdict = "for trends only"
            text = f"{verdict}, because {doubt[0]}, although {why}; try {doubt[1]}"
        entry = {"name": name, "nrmse": error, "verdict": verdict, "text": text}
        entries.append(entry | {"doubt": doubt is not None})
    return entries


def _doubt(name: str, settings: FitSettings, evidence: Evidence) -> tuple[str, str] | None:
    """The first doubt about a channel, and what to try; an output follows from all states."""
    states = [s.name for s in settings.states]
    concerned = states if name in settings.outputs else [name]
    inputs = {*settings.controls, *settings.driving}
    for channel, text in evidence.records.items():
        if channel in concerned or channel in inputs:
            return text, "what is told of that channel"
    rows = {f"{s}{end}": s for s in concerned for end in ("_dot", "_ddot")}
    reasons = () if evidence.doubts is None else evidence.doubts.reasons
    first = next((r for r in reasons if r.row in rows), None)
    if first is None:
        return None
    text = f"{first.text} ({first.row})"
    return text, first.advice


def _advice(name: str, settings: FitSettings, evidence: Evidence) -> tuple[str, str]:
    """Why, as far as anything tells, and what to try first."""
    if evidence.grows is not None:
        return (
            ", as they must of a plant that is unstable in open loop (it grows by "
            f"{evidence.grows:.3g} 1/s), however well it is fitted, as this one is",
            "it in closed loop with a controller, or over windows of about "
            f"{2 / evidence.grows:.2g} s each; a margin would only spoil it",
        )
    unstable = any(g.unstable for g in evidence.growths)
    if unstable and settings.hidden is not None:
        return ", and the model is unstable", "fewer hidden states (hidden.count), or hidden.stable"
    if unstable and settings.linear.margin is None:
        more = "" if evidence.discarded else ", or refine"
        return ", and the model is unstable", f"linear.margin{more}"
    if evidence.discarded:
        return "", "what is told of refinement, which was no better on the runs held out"
    if not evidence.refined and name not in settings.outputs:
        return "", "refine, which teaches the model on rollouts"
    if settings.linear.kind == "LTI" and settings.disturbances:
        return "", "linear.kind LPV along the disturbance that sets the operating point"
    if name in settings.outputs:
        return "", "other or more disturbances that act on it, or more runs"
    return "", "more runs, or inputs that are missing from the model"

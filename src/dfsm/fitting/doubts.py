"""What speaks against the coefficients of a linear fit.

Feedback, dead time, noise, few samples, and inputs too rough for their mesh.

Each question has a file of its own; here they are put to every row that was fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np

from dfsm.core.types import Array
from dfsm.data.derivatives import StateSpec, kinematic_rows
from dfsm.fitting.coloured import pulled, pulled_note
from dfsm.fitting.delays import (
    LateInputs,
    early_note,
    is_lag,
    lag_before,
    lag_note,
    late_inputs,
    late_note,
)
from dfsm.fitting.feedback import (
    Law,
    alike_note,
    feedback_note,
    follows,
    is_feedback,
    much_unexplained,
)
from dfsm.fitting.linear import CONDITION_LIMIT, LinearFit
from dfsm.fitting.noisy_inputs import noise_shares
from dfsm.fitting.over_intervals import coarse_note
from dfsm.fitting.regular_controls import course_of, own_course, poor_note
from dfsm.fitting.residuals import Residuals, residuals_of
from dfsm.fitting.rough_inputs import rough_note
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.fitting.standard_errors import standard_errors
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import poles
from dfsm.numerics.time_mesh import std_over

# A coefficient matters where its input makes so much of a row, and is not known where it is less
# than so many standard errors.
_MATTERS, _KNOWN = 0.2, 1.0
# A delay of so many intervals is about one, and a control that the states explain to so much is
# little else than they are.
_A_SAMPLE, _THE_STATES = 2.0, 0.95
# What makes a growth of the fit, and what no margin cures.
_DECEPTIVE = ("feedback", "alike", "late")
_EXCITE = "runs in which a set-point or a control is excited, or linear.known"


@dataclass(frozen=True)
class Reason:
    """Why not to believe a row.

    Attributes
    ----------
    row
        Name of the derivative.
    kind
        Which question it answers.
    text, advice
        For a verdict: what is wrong, and what to try.
    """

    row: str
    kind: Literal["feedback", "alike", "late", "noise", "chance", "rough", "coarse"]
    text: str
    advice: str


@dataclass(frozen=True)
class Doubts:
    """What was asked of a fit, and the answers.

    Attributes
    ----------
    notes
        One sentence each.
    errors
        Standard errors of the coefficients, ``(row, input)``; NaN in rows that are not fitted.
    reasons
        The same for verdicts.
    outdated
        Whether rollouts have changed the coefficients since.
    unexplained
        RMS that the linear fit leaves of its worst row, relative to the row's standard deviation.
    held
        Channels whose samples stay where the fit takes them for motion, with a sentence each.
    """

    notes: tuple[str, ...]
    errors: Array
    reasons: tuple[Reason, ...] = ()
    outdated: bool = False
    unexplained: float = 1.0
    held: Mapping[str, str] = field(default_factory=dict)

    @property
    def cured_by_margin(self) -> bool:
        """Whether a growth of the fit may be what `linear.margin` is there for."""
        return self.outdated or not any(
            r.kind in ("feedback", "alike", "late") for r in self.reasons
        )


def doubts(
    samples: Samples,
    fit: LinearFit,
    left: Array,
    settings: FitSettings,
    held_channels: Mapping[str, str],
    intervals: bool = False,
) -> Doubts:
    """Question the linear fit of the derivatives.

    Parameters
    ----------
    samples
        All training samples.
    fit
        Of all derivatives, kinematic rows included.
    left
        What it leaves of those that are not kinematic, ``(sample, row)``.
    settings
        Settings.
    held_channels
        Those whose samples stay where the fit takes them for motion, with a sentence each.
    intervals
        Whether the samples are means over intervals.
    """
    inputs, kinematic = samples.linear_inputs, kinematic_rows(settings.states)
    even, even_left, parts = _evenly(samples, inputs, left)
    mean = fit.mean_coefficients
    errors = np.full(mean.shape, np.nan)
    notes: list[str] = []
    reasons: list[Reason] = []
    if intervals:
        A = mean[:, samples.signals.state_columns]
        text, states = coarse_note(samples.time, samples.runs, A)
        notes += [text] if text else []
        for name, _ in (samples.derivative_names[i] for i in states):
            reasons.append(
                Reason(name, "coarse", "its samples are too far apart", "a finer record")
            )
    laws: dict[int, Law] = {}
    worst = 0.0
    names, driving = samples.linear_names, len(samples.signals.driving)
    for place, row in enumerate(r for r in range(len(mean)) if r not in kinematic):
        name, target = samples.derivative_names[row][0], samples.derivatives[:, row]
        errors[row] = standard_errors(even, even_left[:, place], parts)
        spread = max(float(std_over(target, samples.weights)), np.finfo(float).tiny)
        worst = max(worst, float(std_over(left[:, place], samples.weights)) / spread)
        held = {column for r, column in fit.model.known if r == row}
        errors[row, list(held)] = 0.0
        for text in _noise(name, samples, inputs, target, mean[row]):
            notes.append(text)
            reasons.append(Reason(name, "noise", "an input is noisy", "a smoother record of it"))
        series = residuals_of(samples.times, inputs, target, left[:, place])
        note = late = early = None
        if series is not None:
            late, alike = _late(series, names[:driving], settings, samples)
            first = len(samples.signals.controls)
            early = late_inputs(series, range(first, driving), early=True) if not late else None
            states = samples.signals.state_columns
            columns = [*range(driving), *range(states.start, states.stop)]
            lag = None
            # What is held is late by itself.
            if fit.model.schedule is None and not held_channels:
                lag = lag_before(series, columns)
            if lag is not None and is_lag(lag, late):
                about = _state_of(samples, row)
                notes.append(lag_note(name, about.name, about.order, lag, series.unexplained))
                if not lag.small:
                    cure = "the order told" if about.order == 1 else "what is told of it"
                    reasons.append(Reason(name, "late", "a lag is missing in it", cure))
                continue
            note = _feedback(samples, series, mean, row, held, laws)
            if note is None and alike is not None and much_unexplained(series):
                effect = float(mean[row, alike.column])
                text = alike_note(name, series.unexplained, names[alike.column], effect, alike)
                note = text, Reason(name, "alike", "a control is little else than it", _EXCITE)
        if note is not None:
            notes.append(note[0])
            reasons.append(note[1])
            continue
        if not fit.moved:  # for a margin it is no longer the best fit
            told = _unknown(name, names, mean[row], errors[row], samples, target, fit.condition)
            notes += told
            more = Reason(name, "chance", "effects on it may be chance", "longer or more runs")
            reasons += [more] * len(told)
        if text := rough_note(samples, name, mean[row], target, left[:, place]):
            notes.append(text)
            reasons.append(
                Reason(name, "rough", "an input is too rough for its mesh", "what is told of it")
            )
        if late is not None and series is not None:
            # By a sample, which looks like holding for half of one on either side.
            held_channels = {
                n: text
                for n, text in held_channels.items()
                if n not in {names[c] for c in late.seconds}
            }
            notes.append(late_note(name, names, late, series.unexplained))
            # A delay that costs little is no reason against the model.
            which = " and ".join(f"'{names[c]}'" for c in late.seconds)
            what = f"{which} act{'s' * (len(late.seconds) == 1)} late on it"
            reasons += [Reason(name, "late", what, "the delay told")] * (not late.small)
        elif early is not None and series is not None:
            notes.append(early_note(name, names, early, series.unexplained))
            which = " and ".join(f"'{names[c]}'" for c in early.seconds)
            what = f"{which} act{'s' * (len(early.seconds) == 1)} before it is recorded"
            reasons += [Reason(name, "late", what, "what is told of it")] * (not early.small)
        elif series is not None and fit.model.schedule is None:
            free = [c for c in range(len(samples.signals.controls)) if c not in held]
            fine = residuals_of(samples.times, inputs, target, left[:, place], inputs_too=True)
            noisy = any(r.row == name and r.kind == "noise" for r in reasons)
            for twice in [] if fine is None or noisy else pulled(fine, free):
                notes.append(pulled_note(name, names[twice.column], twice))
                reasons.append(
                    Reason(
                        name,
                        "feedback",
                        f"the effect of '{names[twice.column]}' is pulled",
                        _EXCITE,
                    )
                )
    return Doubts(tuple(notes), errors, tuple(reasons), False, worst, held_channels)


def _late(
    series: Residuals, names: Sequence[str], settings: FitSettings, samples: Samples
) -> tuple[LateInputs | None, Law | None]:
    """Delays that are not there as features yet, to a sample: what these leave is no new delay.

    Nor is one of about a sample in a control that is little else than the states: what these were
    a sample ago is their derivative. Then its law is the other answer. Nor one of so few sines that
    a delay is a coefficient too many: late, they are what other coefficients make of them.
    """
    given = [(f.source, f.seconds) for f in settings.features if f.kind == "delay" and f.seconds]
    near = max(series.sample, series.step)
    order = samples.signals.order
    states, controls = order.columns("states"), len(samples.signals.controls)
    columns, alike = list(range(len(names))), None
    acting = states.stop - states.start
    while (late := late_inputs(series, columns)) is not None:
        again = set[int]()
        for column, seconds in late.seconds.items():
            made = course_of(series, column)
            there = any(names[column] == n and abs(seconds - s) <= near for n, s in given)
            if there or (made is not None and made.directions < 2 + acting):
                again.add(column)
            elif column < controls and seconds <= _A_SAMPLE * near:
                law = follows(series, column, range(states.start, states.stop))
                if law.explained > _THE_STATES:
                    again.add(column)
                    alike = law
        if not again:
            break
        columns = [c for c in columns if c not in again]
    return late, alike


def _state_of(samples: Samples, row: int) -> StateSpec:
    """Which state a row is the highest derivative of."""
    specs = samples.signals.specs
    second = [spec for spec in specs if spec.order == 2]
    return specs[row] if row < len(specs) else second[row - len(specs)]


def memory_doubt(model: DFSM) -> list[str]:
    """What latent states learn that controls drive is the controller's of the runs.

    It answers the very wind and waves that latent states stand for, and they take the answer for
    the cause: right along runs of that controller, wrong with other gains and in an optimum.

    Parameters
    ----------
    model
        The refined model.

    Returns
    -------
    list of str
        At most one sentence.
    """
    signals = model.signals
    if not signals.latents or signals.startup:
        return []
    drives = np.abs(np.asarray(poles(model).drive)).max(axis=0) > 0
    names = [c.name for c, driven in zip(signals.controls, drives, strict=False) if driven]
    if not names or not signals.disturbances:
        return []
    return [
        f"latent states answer {', '.join(names)}: if a controller chose that in training, they "
        "take its answer to disturbances for their cause; for other gains and optimal control let "
        "disturbances alone drive them (refine.latent_inputs)"
    ]


def _evenly(samples: Samples, inputs: Array, left: Array) -> tuple[Array, Array, list[slice]]:
    """Inputs, what the fit leaves, and their runs, every sample standing for the same time."""
    if samples.weights is None:
        return inputs, left, samples.parts
    lengths = [np.ptp(time) for time in samples.times]
    step = sum(lengths) / len(inputs)
    counts = [max(2, round(length / step)) for length in lengths]
    both = inputs, left
    even = [np.empty((sum(counts), part.shape[1])) for part in both]
    begin = 0
    for time, count, rows in zip(samples.times, counts, samples.parts, strict=True):
        mesh = np.linspace(time[0], time[-1], count)
        for part, own in zip(both, even, strict=True):
            for column, values in enumerate(part[rows].T):
                own[begin : begin + count, column] = np.interp(mesh, time, values)
        begin += count
    ends = np.cumsum([0, *counts]).tolist()
    return even[0], even[1], [slice(start, stop) for start, stop in pairwise(ends)]


def _feedback(
    samples: Samples,
    series: Residuals,
    mean: Array,
    row: int,
    held: set[int],
    laws: dict[int, Law],
) -> tuple[str, Reason] | None:
    """What to tell of controls that states and their past tell, and of which kind that is."""
    if not much_unexplained(series):
        return None
    order = samples.signals.order
    states = order.columns("states")
    A = mean[:, states]
    name = samples.derivative_names[row][0]
    told, poor = [], None
    for column in range(len(samples.signals.controls)):
        if column in held or not mean[row, column]:
            continue
        if column not in laws:
            laws[column] = follows(series, column, range(states.start, states.stop))
        if not is_feedback(laws[column], A, mean[:, column]):
            continue
        course = own_course(series, column, A)
        if course is None:
            told.append(column)
            continue
        acting = 1 + int(np.count_nonzero(mean[row, states]))
        if course.directions < acting and poor is None:
            poor = poor_note(name, order.names[column], course, acting, series.unexplained)
    if told:
        names = [order.names[c] for c in told]
        note = feedback_note(
            name, series.unexplained, names, mean[row, told].tolist(), [laws[c] for c in told]
        )
        return note, Reason(name, "feedback", "feedback biases it", _EXCITE)
    if poor is not None:
        what = "a control has too few frequencies to tell its effect"
        return poor, Reason(name, "chance", what, "runs in which it has more")
    return None


def _unknown(
    name: str,
    names: Sequence[str],
    row: Array,
    errors: Array,
    samples: Samples,
    target: Array,
    condition: float,
) -> list[str]:
    """Coefficients that matter and are as large as what is not known of them."""
    if condition > CONDITION_LIMIT:  # told already: they cannot be told apart
        return []
    size = np.abs(row) * std_over(samples.linear_inputs, samples.weights)
    much = _MATTERS * std_over(target, samples.weights)
    matters = (size > much) & (np.abs(row) < _KNOWN * errors)
    if not matters.any():
        return []
    if not np.isfinite(errors[matters]).all():
        which = ", ".join(names[i] for i in np.flatnonzero(matters).tolist())
        return [
            f"{name}: the runs hold fewer independent samples than the fit has coefficients, so "
            f"nothing is known of the effects of {which}, however small the residual: give longer "
            "or more runs"
        ]
    told = ", ".join(
        f"{names[i]} ({row[i]:.3g} ± {errors[i]:.2g})" for i in np.flatnonzero(matters).tolist()
    )
    return [
        f"{name}: effects that are no larger than their standard errors, {told}, may be chance "
        "(from the correlation of what is left over): give longer or more runs, or linear.known"
    ]


def _noise(name: str, samples: Samples, inputs: Array, target: Array, row: Array) -> list[str]:
    shares = noise_shares(inputs, target, samples.parts, row)
    count = len(samples.signals.driving)
    return [
        f"{name}: {share:.0%} of what '{samples.linear_names[i]}' does on its own is white and has "
        "no effect there: where it is noise of a sensor, the fit makes its effect too weak by "
        "about that share; smooth the channel before the fit"
        for i, share in enumerate(shares[:count])
        if share > 0
    ]

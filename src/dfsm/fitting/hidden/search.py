"""Which equation: how many hidden states, what corrects them, what inputs do, how long a step.

Everything is decided on stretches of the records that are left out. Linear systems decide how many
hidden states are tried, several nonlinear starts follow from the best of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from dfsm.data.between import Between
from dfsm.data.trajectory import Trajectory
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.race import forms, promising, raced
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.hidden.starts import (
    Candidate,
    contracting,
    improved,
    linear_start,
    nonlinear_start,
    restarted,
    subspace,
)
from dfsm.fitting.hidden.windows import Standard, Windows, standard_of, windows_of

# Another interpolation must lower the squared error on data left out to this share, and half the
# step must change rollouts by no more than this share of it.
_WORTH_A_KIND, _STEP_ERROR = 0.95, 0.01
_MOST_STEPS = 8
# Steps to follow a change of the integration, and to learn from all of many data at last.
_FOLLOW, _LAST = 8, 5


@dataclass(frozen=True)
class Found:
    """What came of a search.

    Attributes
    ----------
    best
        After it has seen all data; its error is that on data left out before.
    standard
        Scales of the variables.
    kinds
        What each input does between samples.
    steps
        Of the integration per sample.
    windows
        All data.
    gains
        Squared errors on data left out of linear systems, by the number of hidden states.
    tried
        The same of nonlinear ones: what they were, and the error.
    kinds_tried
        By what inputs that nobody named do between samples.
    """

    best: Candidate
    standard: Standard
    kinds: tuple[Between, ...]
    steps: int
    windows: Windows
    gains: dict[int, float]
    tried: list[tuple[str, int, float]]
    kinds_tried: dict[str, float]


def search(
    records: Sequence[Trajectory],
    outputs: int,
    kinds: Sequence[Between],
    open_kinds: Sequence[bool],
    settings: HiddenSettings,
    seed: int,
) -> Found:
    """Find the equation that meets data left out best.

    Parameters
    ----------
    records
        Outputs and inputs of every run, in this order.
    outputs
        How many of the channels are outputs.
    kinds
        What each input does between samples, as far as it is known.
    open_kinds
        Which of these the data decide.
    settings
        See `HiddenSettings`.
    seed
        Of the draws.
    """
    standard, kinds = standard_of(records, outputs), tuple(kinds)
    windows = windows_of(records, standard, kinds, 1, settings.samples)
    linear = _linear(records, standard, windows, settings)
    gains = {c: candidate.error for c, candidate in linear.items()}
    first = promising(linear)[0] if settings.count is None else settings.count
    kinds, kinds_tried = _interpolation(
        records, standard, linear[first], (kinds, open_kinds), settings
    )
    windows = windows_of(records, standard, kinds, 1, settings.samples)
    best, tried = raced(linear, windows, settings, seed)
    best, steps = _steps(records, standard, best, kinds, settings)
    finer = windows_of(records, standard, kinds, steps, settings.samples)
    everything = windows_of(records, standard, kinds, steps).with_all()
    error = best.error
    weights = restarted(best, finer, everything)
    few = everything.used.sum() <= settings.samples
    last = settings.iterations if few else _LAST
    final = improved(best.form, everything, weights, settings.decay, last)
    final = replace(final, error=error)
    return Found(final, standard, kinds, steps, everything, gains, tried, kinds_tried)


def _linear(
    records: Sequence[Trajectory], standard: Standard, windows: Windows, settings: HiddenSettings
) -> dict[int, Candidate]:
    """Linear systems by the number of hidden states."""
    ny, nv = len(standard.outputs[0]), len(standard.inputs[0])
    counts = range(settings.most + 1)
    if settings.count is not None:
        # One fewer tells whether the data can tell so many.
        counts = range(max(0, settings.count - 1), settings.count + 1)
    found = subspace(records, standard, ny + max(counts))
    room = ny + max(counts)
    each = [linear_start(found, Form(ny + c, ny, nv, room=room), windows) for c in counts]
    if settings.stable is not None:
        margin = settings.stable * standard.step
        each = [contracting(c, margin) for c in each]
    return dict(zip(counts, each, strict=True))


def _interpolation(
    records: Sequence[Trajectory],
    standard: Standard,
    linear: Candidate,
    kinds: tuple[tuple[Between, ...], Sequence[bool]],
    settings: HiddenSettings,
) -> tuple[tuple[Between, ...], dict[str, float]]:
    """What inputs that nobody named do between samples, by what explains the data.

    A nonlinear start tells, the simplest there is: beside what a linear system leaves over, what
    inputs do between samples may be little.
    """
    now, open_kinds = kinds
    if not any(open_kinds):
        return now, {}
    windows = windows_of(records, standard, now, 1, settings.samples)
    form = forms(linear.form, windows, settings, 0)[0][0]
    start = nonlinear_start(linear, form, 0)
    tried: dict[str, tuple[Between, ...]] = {}
    errors: dict[str, float] = {}
    for kind in get_args(Between):
        pairs = zip(now, open_kinds, strict=True)
        tried[kind] = tuple(kind if free else k for k, free in pairs)
        windows = windows_of(records, standard, tried[kind], 1, settings.samples)
        errors[kind] = improved(form, windows, start, settings.decay, settings.iterations).error
    current = next(k for k, free in zip(now, open_kinds, strict=True) if free)
    least = min(errors, key=errors.__getitem__)
    return tried[least if errors[least] < _WORTH_A_KIND * errors[current] else current], errors


def _steps(
    records: Sequence[Trajectory],
    standard: Standard,
    best: Candidate,
    kinds: tuple[Between, ...],
    settings: HiddenSettings,
) -> tuple[Candidate, int]:
    """Steps per sample at which rollouts are what they are at half of it."""
    steps = 1
    while steps < _MOST_STEPS:
        finer = windows_of(records, standard, kinds, 2 * steps, settings.samples)
        here = windows_of(records, standard, kinds, steps, settings.samples)
        apart = HiddenError(best.form, here).paths(best.weights)
        apart = apart - HiddenError(best.form, finer).paths(best.weights)
        change = np.mean(np.sum(apart[..., : best.form.outputs] ** 2, -1))
        if change <= _STEP_ERROR * best.error * best.form.outputs:
            break
        steps *= 2
        best = improved(best.form, finer, best.weights, settings.decay, _FOLLOW)
    return best, steps

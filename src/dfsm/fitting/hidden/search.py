"""Which equation: how many hidden states, what corrects them, what inputs do, how long a step.

Everything is decided on stretches of the records that are left out. Linear systems decide how many
hidden states are tried, several nonlinear starts follow from the best of them.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from dfsm.data.between import Between
from dfsm.data.trajectory import Trajectory
from dfsm.data.windows import Windows as Motion
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form, polynomial
from dfsm.fitting.hidden.sensors import Sensed, as_recorded, sensed
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.hidden.short_windows import from_short_windows, starts_of
from dfsm.fitting.hidden.starts import (
    Candidate,
    behind_sensors,
    contracting,
    improved,
    linear_start,
    nonlinear_start,
    runs_away,
    subspace,
)
from dfsm.fitting.hidden.windows import Standard, Windows, standard_of, windows_of
from dfsm.models.corrective.polynomial import REACH

# A further hidden state must lower the squared error on data left out to this share; another
# interpolation to this; and half the step must change rollouts by no more than this share of it.
_WORTH_A_STATE, _WORTH_A_KIND, _STEP_ERROR = 0.7, 0.95, 0.01
# What instruments make of outputs must lower that of linear systems to this.
_WORTH_A_SENSOR = 0.7
# Linear systems whose squared error is no more than so many times the least, or than this of a
# record without noise, may be enough.
_NEARLY, _NOTHING = 2.0, 1e-8
# A start that leaves more than this share of the squared error of a linear system that is poor
# leads nowhere. One that leaves less and runs away is right about the record and wrong beyond:
# nothing mends that.
_LEADS, _POOR = 0.5, 0.2
# Most steps per sample, and radians of a swing up to which one is enough to begin with.
_MOST_STEPS, _PER_STEP = 8, 1.0
# The polynomial and some draws of tanh units go first.
_SCOUTS = 4
_MOST_MONOMIALS = 60
# Polynomials go on to so many times what was recorded.
_BEYOND = 1.5
# Steps to follow a change of the integration, and to learn from all data at last: the fewest, and
# all there are where data are many.
_FOLLOW, _LAST = 8, 5


@dataclass(frozen=True)
class Found:
    """What a search found.

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
    asked = _Asked(records, standard, open_kinds, settings, _first_steps(records, outputs))
    windows = asked.windows(kinds)
    linear = _behind(asked, kinds, windows)
    gains = {c: candidate.error for c, candidate in linear.items()}
    if settings.count is not None:
        linear = {settings.count: linear[settings.count]}
    counts = _promising(linear, windows, settings)
    linear = {c: linear[c] for c in counts}
    kinds, kinds_tried = _interpolation(asked, linear[counts[0]], kinds)
    windows = asked.windows(kinds)
    best, tried = _ascended(linear, windows, settings, seed)
    best, kinds = _interpolated(asked, best, kinds)
    further = last_steps(best, settings.iterations)
    best, steps = _steps(asked, best, kinds)
    everything = windows_of(records, standard, kinds, steps).with_all()
    error = best.error
    weights = best.weights
    if len(windows.y) < len(everything.y):
        starts = starts_of(best.form, best.parameters, everything)
        weights = np.concatenate([best.parameters, starts.ravel()])
    few = everything.used.sum() <= settings.samples
    last = further if few else _LAST
    final = improved(best.form, everything, weights, settings.decay, last)
    final = replace(final, error=error)
    return Found(final, standard, kinds, steps, everything, gains, tried, kinds_tried)


@dataclass(frozen=True)
class _Asked:
    """Records and what is asked of them, see `search`; `steps` are those per sample at first."""

    records: Sequence[Trajectory]
    standard: Standard
    open_kinds: Sequence[bool]
    settings: HiddenSettings
    steps: int

    def windows(self, kinds: Sequence[Between], steps: int | None = None) -> Windows:
        """As much of the records as the search looks at."""
        most = self.settings.samples
        return windows_of(self.records, self.standard, kinds, steps or self.steps, most)

    def kinds_of_all(self, kinds: Sequence[Between]) -> dict[str, tuple[Between, ...]]:
        """By what inputs that nobody named may do, what all inputs do then."""
        if not any(self.open_kinds):
            return {}
        return {
            kind: tuple(kind if free else k for k, free in zip(kinds, self.open_kinds, strict=True))
            for kind in get_args(Between)
        }


def _first_steps(records: Sequence[Trajectory], outputs: int) -> int:
    """Steps per sample that the swings of what is measured ask of Runge and Kutta."""
    names = records[0].names[:outputs]
    windows = Motion(records, names)
    fastest = min(windows.swing(name) for name in names)
    steps = 1
    while steps < _MOST_STEPS and 2 * np.pi * windows.usual / (steps * fastest) > _PER_STEP:
        steps *= 2
    return steps


def _behind(asked: _Asked, kinds: Sequence[Between], windows: Windows) -> dict[int, Candidate]:
    """Linear systems by the number of hidden states, behind the instruments that records tell."""
    records, standard, settings = asked.records, asked.standard, asked.settings
    told = sensed(records, standard, settings.output)
    if told is None or settings.output is None:
        plain = _linear(as_recorded(records), standard, (windows, windows), settings)
        if told is None:
            return plain
    else:
        plain = {}
    unfolded = replace(asked, records=told.records).windows(kinds)
    behind = _linear(told, standard, (unfolded, windows), settings)
    least = min((c.error for c in plain.values()), default=np.inf)
    return behind if min(c.error for c in behind.values()) < _WORTH_A_SENSOR * least else plain


def _linear(
    told: Sensed, standard: Standard, windows: tuple[Windows, Windows], settings: HiddenSettings
) -> dict[int, Candidate]:
    """Linear systems by the number of hidden states."""
    ny, nv = len(standard.outputs[0]), len(standard.inputs[0])
    counts: Sequence[int] = range(settings.most + 1)
    if settings.count is not None:
        # Fewer tell whether there are too many.
        counts = sorted({settings.count // 2, max(0, settings.count - 1), settings.count})
    found = subspace(told.records, standard, ny + max(counts))
    room, (unfolded, seen) = ny + max(counts), windows
    each = [linear_start(found, Form(ny + c, ny, nv, room=room), unfolded) for c in counts]
    if told.sensors:
        each = [behind_sensors(c, told, seen) for c in each]
    if settings.stable is not None:
        margin = settings.stable * standard.step
        each = [contracting(c, margin) for c in each]
    return dict(zip(counts, each, strict=True))


def _promising(
    linear: dict[int, Candidate], windows: Windows, settings: HiddenSettings
) -> list[int]:
    """Numbers of hidden states to try, from the fewest that may be enough.

    A linear system takes what is nonlinear for further states. So where one with more is far
    better, the simplest nonlinear start is asked whether fewer do.
    """
    known = [c for c in sorted(linear) if np.isfinite(linear[c].error)]
    least = min(linear[c].error for c in known)
    enough = max(_NEARLY * least, _NOTHING)
    first = next(c for c in known if linear[c].error <= enough)
    fewer = [c for c in reversed(known) if c < first]
    if fewer and settings.form != "none":
        least = _simplest(linear[first], windows, settings)
        for count in fewer:
            error = _simplest(linear[count], windows, settings)
            if not error <= _NEARLY * least:
                break
            first, least = count, min(least, error)
    return [c for c in known if c >= first]


def _simplest(linear: Candidate, windows: Windows, settings: HiddenSettings) -> float:
    """Squared error on data left out of the simplest nonlinear start there is."""
    form = _forms(linear.form, windows, settings, 0)[0][0]
    start = nonlinear_start(linear, form, 0)
    return improved(form, windows, start, settings.decay, settings.iterations).error


def _from(
    linear: Candidate, form: Form, draw: int, windows: Windows, settings: HiddenSettings
) -> Candidate:
    """Where a nonlinear start leads; by way of short windows where it leads nowhere at once."""
    weights = nonlinear_start(linear, form, draw)
    found = improved(form, windows, weights, settings.decay, settings.iterations)
    if linear.error <= _POOR or found.error <= _LEADS * linear.error:
        return found
    weights = from_short_windows(form, weights, windows, settings.decay)
    again = improved(form, windows, weights, settings.decay, settings.iterations)
    return min(found, again, key=_error)


def _ascended(
    linear: dict[int, Candidate], windows: Windows, settings: HiddenSettings, seed: int
) -> tuple[Candidate, list[tuple[str, int, float]]]:
    """The best of all, from few hidden states to more, until one more is not worth it.

    What is nonlinear looks like further states to a linear system: it only tells where to begin.
    Few draws tell how many there are, and whether the others are worth drawing.
    """
    best, others, tried = None, None, []
    for count in linear:
        tasks = _forms(linear[count].form, windows, settings, seed)
        candidates = list(_nonlinear(linear[count], windows, settings, tasks[:_SCOUTS]))
        tried += [(c.form.kind, count, c.error) for c in candidates]
        # Where all run away, the linear one stays.
        first = min([*candidates, linear[count]], key=_error)
        if best is not None and first.error > _WORTH_A_STATE * best.error:
            break
        best, others = first, (linear[count], candidates, tasks[_SCOUTS:])
        if first.error <= _NOTHING:
            break
    if best is None or others is None:
        raise ValueError("no number of hidden states to try")
    start, scouts, tasks = others
    least = min((c.error for c in scouts if c.form.kind == "tanh"), default=np.inf)
    if least <= _NEARLY * best.error:
        more = list(_nonlinear(start, windows, settings, tasks))
        count = start.form.states - start.form.outputs
        tried += [(c.form.kind, count, c.error) for c in more]
        best = min([best, *more], key=_error)
    return best, tried


def _error(candidate: Candidate) -> float:
    return candidate.error


def _nonlinear(
    linear: Candidate, windows: Windows, settings: HiddenSettings, tasks: list[tuple[Form, int]]
) -> Iterable[Candidate]:
    """Candidates from one linear system, several at a time."""

    def one(task: tuple[Form, int]) -> Candidate:
        form, draw = task
        found = _from(linear, form, draw, windows, settings)
        return replace(found, error=np.inf) if runs_away(found, windows) else found

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(one, tasks)


def _forms(
    base: Form, windows: Windows, settings: HiddenSettings, seed: int
) -> list[tuple[Form, int]]:
    """What is tried beside a linear form, the polynomial first, and the draw of each."""
    if settings.form == "none":
        return [(base, 0)]
    forms: list[tuple[Form, int]] = []
    there = windows.y[(windows.used + windows.left_out) > 0]
    farthest = np.ptp(there, axis=0) if base.sensors else np.abs(there)
    reach = max(REACH, _BEYOND * float(max(farthest.max(), np.abs(windows.v).max())))
    if settings.form in (None, "polynomial") and settings.stable is None:
        forms.append((polynomial(base, settings.degree, _MOST_MONOMIALS, reach), 0))
    if settings.form in (None, "tanh"):
        tanh = replace(base, kind="tanh", units=settings.units, room=0)
        forms += [(tanh, seed * settings.starts + k) for k in range(settings.starts)]
    return forms


def _interpolation(
    asked: _Asked, linear: Candidate, kinds: tuple[Between, ...]
) -> tuple[tuple[Between, ...], dict[str, float]]:
    """What inputs that nobody named do between samples, by what explains the data.

    A nonlinear start tells, the simplest there is: beside what a linear system leaves over, what
    inputs do between samples may be little.
    """
    tried = asked.kinds_of_all(kinds)
    if not tried:
        return kinds, {}
    now = next(k for k, free in zip(kinds, asked.open_kinds, strict=True) if free)
    errors = {
        kind: _simplest(linear, asked.windows(each), asked.settings) for kind, each in tried.items()
    }
    # In the order of `tried`, so that the first of equals is taken.
    least = list(tried.values())[int(np.argmin(list(errors.values())))]
    clear = min(errors.values()) < _WORTH_A_KIND * errors[now]
    return least if clear else tried[now], errors


def _interpolated(
    asked: _Asked, best: Candidate, kinds: tuple[Between, ...]
) -> tuple[Candidate, tuple[Between, ...]]:
    """The same question asked of the best, which what inputs do may hold back by now."""
    found, settings = [(best, kinds)], asked.settings
    for each in asked.kinds_of_all(kinds).values():
        if each == kinds:
            continue
        windows, steps = asked.windows(each), settings.iterations // 2
        other = improved(best.form, windows, best.weights, settings.decay, steps)
        if other.error < _WORTH_A_KIND * best.error and not runs_away(other, windows):
            found.append((replace(other, steps=best.steps), each))
    return min(found, key=lambda candidate: candidate[0].error)


def _steps(asked: _Asked, best: Candidate, kinds: Sequence[Between]) -> tuple[Candidate, int]:
    """Steps per sample at which rollouts are what they are at half of it."""
    steps = asked.steps
    while steps < _MOST_STEPS:
        here, finer = asked.windows(kinds, steps), asked.windows(kinds, 2 * steps)
        apart = HiddenError(best.form, here).outputs(best.weights)
        apart = apart - HiddenError(best.form, finer).outputs(best.weights)
        change = np.mean(np.sum(apart**2, -1))
        if change <= _STEP_ERROR * best.error * best.form.outputs:
            break
        steps *= 2
        best = improved(best.form, finer, best.weights, asked.settings.decay, _FOLLOW)
    return best, steps


def last_steps(best: Candidate, limit: int) -> int:
    """Steps on all data: where data left out ended a search early, nothing else tells when to end.

    As far as these let the search go in its second half, so are the last steps of all there may be.
    A linear system, or a search that came to its end, is followed to the end.
    """
    if best.form.kind == "none" or not best.steps:
        return limit
    return min(limit, max(_LAST, 2 * best.steps - limit))

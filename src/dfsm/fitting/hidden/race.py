"""Several nonlinear starts for every number of hidden states, and which of them is kept.

All run a short lap, those ahead a long one, and these again with other data left out: one stretch
of a record that suits a candidate by chance does not decide. A further hidden state must gain more
than one standard error of what it gains (Breiman et al. 1984, Classification and Regression Trees).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import numpy as np

from dfsm.core.types import Array
from dfsm.fitting.hidden.error import BATCH, HiddenError
from dfsm.fitting.hidden.form import Form, polynomial
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.hidden.starts import (
    Candidate,
    improved,
    nonlinear_start,
    restarted,
    runs_away,
)
from dfsm.fitting.hidden.windows import Windows
from dfsm.models.corrective.polynomial import REACH

Tried = list[tuple[str, int, float]]
Task = TypeVar("Task")
Result = TypeVar("Result")
# A further hidden state must lower the squared error on data left out to this share.
_WORTH_A_STATE = 0.75
# Linear systems whose squared error is no more than so many times the least may be enough.
_NEARLY = 2.0
# Steps of the short lap, and how many run on.
_LAP, _AHEAD = 12, 4
_MOST_MONOMIALS = 60
# Polynomials go on to so many times what was recorded.
_BEYOND = 1.5
# Parts of the data left out, whose errors tell by how much a gain is uncertain.
_PARTS = 8


def promising(linear: dict[int, Candidate]) -> list[int]:
    """Numbers of hidden states from the least that a linear system is nearly as good with."""
    least = min(c.error for c in linear.values())
    first = min(c for c in linear if linear[c].error <= _NEARLY * least)
    return [c for c in sorted(linear) if c >= first and np.isfinite(linear[c].error)]


def raced(
    linear: dict[int, Candidate], windows: Windows, settings: HiddenSettings, seed: int
) -> tuple[Candidate, Tried]:
    """The best of all, from few hidden states to more, until one more is not worth it.

    What is nonlinear looks like further states to a linear system: it only tells where to begin,
    and whether two more may be worth it where one more is not.
    """
    counts = promising(linear) if settings.count is None else [settings.count]
    best, at = _laps(linear[counts[0]], windows, settings, seed), counts[0]
    tried: Tried = [(c.form.kind, at, c.error) for c in best]
    for count in counts[1:]:
        two = count - at == 2
        if count - at > 2 or (two and linear[count].error > _WORTH_A_STATE * linear[at].error):
            break
        found = _laps(linear[count], windows, settings, seed)
        tried += [(c.form.kind, count, c.error) for c in found]
        worth = found[0].error <= _WORTH_A_STATE * best[0].error
        if worth and _clearly(found[0], best[0], windows):
            best, at = found, count
    if settings.count and _open(linear, settings.count):
        tried += _one_fewer(linear[settings.count - 1], best[0], windows, settings, seed)
    return best[0], tried


def _laps(
    linear: Candidate, windows: Windows, settings: HiddenSettings, seed: int
) -> list[Candidate]:
    """Those from one linear system that ran to the end, the best first, the linear one too."""
    entries = forms(linear.form, windows, settings, seed)
    few = windows
    start = linear
    # The short lap looks at one batch.
    if len(windows.y) > (each := max(1, BATCH // windows.y.shape[1])):
        rows = np.linspace(0, len(windows.y) - 1, each).astype(int)
        few = windows.part(rows)
        starts = linear.weights[linear.form.size :].reshape(len(windows.y), -1)[rows]
        start = replace(linear, weights=np.concatenate([linear.parameters, starts.ravel()]))

    def lap(entry: tuple[Form, int]) -> Candidate:
        weights = nonlinear_start(start, *entry)
        return improved(entry[0], few, weights, settings.decay, _LAP)

    def on(k: int) -> Candidate:
        weights = restarted(laps[k], few, windows)
        found = improved(laps[k].form, windows, weights, settings.decay, settings.iterations)
        return replace(found, error=np.inf) if runs_away(found, windows) else found

    def again(k: int) -> float:
        form, draw = entries[k]
        weights = nonlinear_start(linear, form, draw)
        return improved(form, other, weights, settings.decay, settings.iterations).error

    laps = _each(lap, entries)
    ahead = sorted(range(len(entries)), key=lambda k: laps[k].error)
    ahead = _of_every_kind(ahead, entries)
    found = _each(on, ahead)
    other = windows.turned()
    left = [c for c in zip(found, ahead, strict=True) if np.isfinite(c[0].error)]
    if len(left) > 1:
        second = _each(again, [k for _, k in left])
        found = [
            replace(c, error=(c.error + e) / 2) for (c, _), e in zip(left, second, strict=True)
        ]
    return sorted([*found, linear], key=lambda c: c.error)


def _of_every_kind(ahead: list[int], entries: Sequence[tuple[Form, int]]) -> list[int]:
    """The first few, and the first of every kind."""
    kinds = {entries[k][0].kind: k for k in reversed(ahead)}
    return [k for k in ahead if k in ahead[:_AHEAD] or k in kinds.values()]


def _each(function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, tasks))


def _open(linear: dict[int, Candidate], count: int) -> bool:
    """Whether linear systems leave it open what the last hidden state is good for."""
    return linear[count].error > _WORTH_A_STATE * linear[count - 1].error


def _one_fewer(
    linear: Candidate, best: Candidate, windows: Windows, settings: HiddenSettings, seed: int
) -> Tried:
    """What the last hidden state gained: the same kind of equation without it."""
    only = replace(settings, form=best.form.kind, starts=1)
    form, draw = forms(linear.form, windows, only, seed)[0]
    weights = nonlinear_start(linear, form, draw)
    found = improved(form, windows, weights, settings.decay, settings.iterations)
    return [(form.kind, linear.form.states - linear.form.outputs, found.error)]


def _clearly(better: Candidate, worse: Candidate, windows: Windows) -> bool:
    """Whether the errors on data left out differ by more than one standard error of that."""
    apart = [HiddenError(c.form, windows).squares_left_out(c.weights) for c in (worse, better)]
    gains = np.array([part.mean() for part in np.array_split(apart[0] - apart[1], _PARTS)])
    return bool(gains.mean() > gains.std(ddof=1) / np.sqrt(_PARTS))


def forms(
    base: Form, windows: Windows, settings: HiddenSettings, seed: int
) -> list[tuple[Form, int]]:
    """What is tried beside a linear form, the polynomial first, and the draw of each."""
    if settings.form == "none":
        return [(base, 0)]
    several: list[tuple[Form, int]] = []
    if settings.form in (None, "polynomial") and settings.stable is None:
        reach = max(REACH, _BEYOND * _farthest(windows))
        several.append((polynomial(base, settings.degree, _MOST_MONOMIALS, reach), 0))
    if settings.form in (None, "tanh"):
        tanh = replace(base, kind="tanh", units=settings.units, room=0)
        several += [(tanh, seed * settings.starts + k) for k in range(settings.starts)]
    return several


def _farthest(windows: Windows) -> float:
    """Largest recorded deviation in standard deviations."""
    there: Array = windows.y[(windows.used + windows.left_out) > 0]
    return float(max(np.abs(there).max(), np.abs(windows.v).max()))

"""Rows of the derivative fit over intervals between samples, where inputs jump at these.

Means over an interval hold for any model; how the states go on within it is asked of the one that
has just been fitted, and a few fits after one another settle it. See `data.steps`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dfsm.core.types import Array, IntArray
from dfsm.data.steps import Slopes, Steps

if TYPE_CHECKING:
    from dfsm.fitting.samples import Samples

# Fits after one another at most, and the change of all slopes, relative to their spread, that ends.
_FITS, _SETTLED = 12, 1e-9
# Weights that differ by less than this share are one.
_EQUAL = 1e-3
# Largest rate times step that the formulas follow to about 2 %, and the share of a mode that each
# of its states has at least.
_REACH, _SHARE = 1.8, 0.3


def over_intervals(samples: Samples, fit: Callable[[Samples], Slopes]) -> tuple[Samples, Samples]:
    """Rows that a fit of the derivatives takes, and the samples with what was learnt meanwhile.

    Parameters
    ----------
    samples
        At points in time.
    fit
        Fits rows and returns the linear model of all derivatives.

    Returns
    -------
    tuple of Samples
        Rows over intervals, or at samples where these tell their derivative; and `samples` with
        the rates of the states that have none recorded. Both are `samples` where inputs have no
        jumps, or only few.
    """
    steps = list(samples.steps)
    if not any(s.open.any() for s in steps):
        return samples, samples
    slopes = [s.straight() for s in steps]
    rows = _rows(samples, steps, slopes)
    last = np.inf
    for _ in range(_FITS):
        model = fit(rows)
        pairs = [s.modelled(model) for s in steps]
        change = max(
            float(np.abs(new - old).max()) / (float(np.ptp(new)) or 1.0)
            for (_, news), olds in zip(pairs, slopes, strict=True)
            for new, old in zip(news, olds, strict=True)
        )
        # Intervals so long that the formulas say nothing more: what there is is best.
        if not change < last:
            break
        steps, slopes = [s for s, _ in pairs], [s for _, s in pairs]
        rows, last = _rows(samples, steps, slopes), change
        if change < _SETTLED:
            break
    inputs = samples.inputs.copy()
    inputs[:, samples.signals.state_columns] = np.concatenate([s.states for s in steps])
    return rows, replace(samples, inputs=inputs)


def coarse_note(time: Array, runs: IntArray, A: Array) -> tuple[str, list[int]]:
    """What to say of modes that are over within an interval, and the states that are theirs.

    Parameters
    ----------
    time, runs
        Of the rows over intervals.
    A
        Of the fit, ``(state, state)``.
    """
    step = float(np.median(np.diff(time)[np.diff(runs) == 0]))
    values, vectors = np.linalg.eig(A)
    k = int(np.argmax(np.abs(values)))
    rate = float(np.abs(values[k]))
    if not rate * step > _REACH:
        return "", []
    taking_part = np.abs(vectors[:, k] * np.linalg.pinv(vectors)[k])
    return (
        f"a mode of {rate:.3g} 1/s is over within the {step:.3g} s between samples, so that rates "
        "fitted over these may be off by tens of percent: record at steps of at most "
        f"{1 / rate:.2g} s, or give what is known of it as linear.known"
    ), np.flatnonzero(taking_part > _SHARE).tolist()


def _rows(
    samples: Samples, steps: Sequence[Steps], slopes: Sequence[tuple[Array, Array]]
) -> Samples:
    """Samples that tell their derivative, and intervals between others, run by run."""
    parts, own = list[tuple[Array, ...]](), samples.parts
    for k, (s, ends) in enumerate(zip(steps, slopes, strict=True)):
        half = np.diff(s.time) / 2
        stands = (np.append(half, 0.0) + np.insert(half, 0, 0.0))[s.own]
        inputs, rates, spans, times = s.rows(ends)
        run = (
            np.concatenate([samples.inputs[own[k]][s.own], inputs]),
            np.concatenate([samples.derivatives[own[k]][s.own], rates]),
            np.concatenate([stands, spans]),
            np.concatenate([s.time[s.own], times]),
        )
        order = np.argsort(run[-1], kind="stable")
        parts.append(tuple(part[order] for part in run))
    *stacked, times = zip(*parts, strict=True)
    inputs, derivatives, weights = (np.concatenate(p) for p in stacked)
    alike = np.ptp(weights) <= _EQUAL * weights.mean()
    none = {name: np.empty((0, 0)) for name in ("harmonics", "field")}
    return replace(
        samples,
        inputs=inputs,
        derivatives=derivatives,
        times=times,
        psi=np.empty(0),
        weights=None if alike else weights / weights.mean(),
        recorded=(),
        steps=(),
        **none,
    )

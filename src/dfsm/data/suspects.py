"""Samples and runs that cannot belong to the rest: a stray sample, a run in another unit.

Least squares has no defence against them: one sample a million times the others decides every
coefficient, and a square of 1e160 is no number any more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array, IntArray
from dfsm.core.units import agree
from dfsm.data.derivatives import DerivativeSettings, lead_in
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError

Suspects = Literal["refuse", "drop", "keep"]
SUSPECTS: tuple[str, ...] = get_args(Suspects)

# Beyond this, squares and their sums leave the range of numbers.
_HUGE = 1e100
# A few samples are strays where they are so many times further from the median than all others.
_STRAY, _FEW = 1e3, 5
# Samples that are looked at together.
_BLOCK = 1_000_000
# Factors between units that bear one name in files: thousands, rad and deg, rad/s and rpm.
_FACTORS = {
    1000.0: "a thousand",
    1e6: "a million",
    180 / np.pi: "deg per rad",
    30 / np.pi: "rpm per rad/s",
}
# How far off a factor may be (a share, in logarithms) where means tell it and where only spreads
# do, which differ with the excitation, too; and how far apart the other runs.
_NEAR, _NEARER, _ALIKE = 0.35, 0.1, 2.0
_ADVICE = "correct it, or set data.outliers to drop (or to keep, if it is right)"


def screened(
    runs: Sequence[Trajectory],
    names: Iterable[str],
    what: Suspects,
    window: tuple[float | None, float | None],
    settings: DerivativeSettings,
) -> list[Trajectory]:
    """Refuse runs with samples that cannot be, or do without these.

    Parameters
    ----------
    runs
        Whole records.
    names
        Channels to look at; those that a run lacks are passed over.
    what
        ``"refuse"``; ``"drop"`` bridges stray samples by straight lines and leaves out runs in
        another unit; ``"keep"`` refuses only what cannot be squared.
    window
        Start and stop in s of what is compared between runs.
    settings
        How much before the start derivatives remember, see `lead_in`; what lies earlier may be as
        it is.

    Raises
    ------
    DfsmError
        Names the run, the channel and the time of the first suspect, or the factor.
    """
    names = list(dict.fromkeys(names))
    if what == "keep":
        for run in runs:
            _require_squares(run, [n for n in names if n in run])
        return list(runs)
    kept = [
        _without_strays(
            run, [n for n in names if n in run], what, lead_in(run, window[0], settings)
        )
        for run in runs
    ]
    for name in names:
        if not all(name in run for run in kept):
            continue
        units = [run.channel(name).unit for run in kept]
        if not all(agree(units[0], unit) for unit in units):
            continue  # which is said of the runs' units, and needs no guess
        odd = _other_unit(run.window(*window)[name] for run in kept)
        if odd is None:
            continue
        place, factor, word = odd
        if _excited_less(kept, names, window, place, factor):
            continue
        if what == "refuse" or len(kept) == 2:  # which of two is wrong, nobody knows
            run = kept[place]
            unit = run.channel(name).unit or "no unit"
            raise DfsmError(
                f"{run.where}: '{name}' ({unit}) is {factor:.3g} times what it is in the other "
                f"runs, in mean, spread and range ({word}), as if in another unit: {_ADVICE}"
            )
        del kept[place]
    return kept


def _excited_less(
    runs: Sequence[Trajectory],
    names: Sequence[str],
    window: tuple[float | None, float | None],
    place: int,
    factor: float,
) -> bool:
    """Whether all that moves shrinks or grows with a channel: a small or a large run, no unit.

    One channel alone says nothing. Where a square does it, as a power of a force and a speed, the
    rest shrinks by the root.
    """
    parts = [run.window(*window) for run in runs]
    spreads = np.array([[p[n].std() if n in p else 0.0 for n in names] for p in parts])
    usual = np.median(np.delete(spreads, place, axis=0), axis=0)
    moving = usual > 0
    if moving.sum() < 2 or not (spreads[place, moving] > 0).all():
        return False
    ratio = np.log(spreads[place, moving] / usual[moving]) * np.sign(np.log(factor))
    return bool((ratio >= abs(np.log(factor)) / 2 - _NEAR).all())


def stray_notes(run: Trajectory, names: Sequence[str]) -> list[str]:
    """Say which samples of a run, not of a fit, are far from all others, one sentence a channel."""
    notes = []
    for name in names:
        rows = stray_rows(run[name])
        if len(rows):
            notes.append(
                f"{run.where}: {strays_told(name, run.time, run[name], rows)}, far beyond all its "
                "other samples: errors of this run say nothing until that is corrected"
            )
    return notes


def _require_squares(run: Trajectory, names: Sequence[str]) -> None:
    """Refuse values of which no sum of squares is a number.

    Raises
    ------
    DfsmError
        Names the run, the channel and the time of the first.
    """
    for name in names:
        rows = _huge_rows(run[name])
        if len(rows):
            raise DfsmError(
                f"{run.where}: {strays_told(name, run.time, run[name], rows)}, which cannot be "
                "squared in 64 bits: correct it, or give it in a larger unit"
            )


def _without_strays(
    run: Trajectory, names: Sequence[str], what: Suspects, used: Trajectory
) -> Trajectory:
    values: Array | None = None
    first_used = len(run) - len(used)
    for name in names:
        samples = run[name]
        strays = first_used + stray_rows(used[name])
        if not len(strays):
            continue
        if what == "refuse" or len(strays) > _FEW:
            few = len(strays) <= _FEW
            others = "all its other samples" if few else "what can be squared in 64 bits"
            advice = _ADVICE if few else "correct them, or give the channel in a larger unit"
            raise DfsmError(
                f"{run.where}: {strays_told(name, run.time, samples, strays)}, far beyond "
                f"{others}: {advice}"
            )
        good = np.ones(len(samples), dtype=bool)
        good[strays] = False
        values = run.values.copy() if values is None else values
        bridged = np.interp(run.time[strays], run.time[good], samples[good])
        values[strays, run.column(name)] = bridged
    return run if values is None else replace(run, values=values)


def stray_rows(samples: Array) -> IntArray:
    """Rows of the samples that are huge, or a few that are far from all others."""
    finite = np.isfinite(samples)
    huge = _huge_rows(samples)
    if len(huge) or len(samples) <= 2 * _FEW:
        return huge
    good = samples if finite.all() else samples[finite]
    if len(good) <= 2 * _FEW:
        return huge
    middle = float(np.median(good))
    # The farthest of each block, and of these the farthest.
    found = [_farthest(samples[k : k + _BLOCK], middle) for k in range(0, len(samples), _BLOCK)]
    order = np.concatenate([k * _BLOCK + rows for k, rows in enumerate(found)])
    off = _off(samples[order], middle)
    first = np.argsort(-off, kind="stable")[: _FEW + 1]
    order, far = order[first], off[first]
    for count in range(1, _FEW + 1):
        if far[count] > 0 and far[count - 1] > _STRAY * far[count]:
            return np.sort(order[:count])
    return huge


def strays_told(name: str, time: Array, samples: Array, rows: IntArray) -> str:
    """The first of some samples of a channel, and how many more there are."""
    more = f" (and {len(rows) - 1} more)" if len(rows) > 1 else ""
    return f"'{name}' is {samples[rows[0]]:.4g} at {time[rows[0]]:g} s{more}"


def _huge_rows(samples: Array) -> IntArray:
    return _rows(samples, lambda part: np.isfinite(part) & (np.abs(part) > _HUGE))


def _off(samples: Array, middle: float) -> Array:
    """Distances from the middle, 0 of what is no number."""
    finite = np.isfinite(samples)
    return np.where(finite, np.abs(np.where(finite, samples, middle) - middle), 0.0)


def _farthest(samples: Array, middle: float) -> IntArray:
    """The few rows that are farthest from the middle, in their order."""
    off = _off(samples, middle)
    if len(off) <= _FEW + 1:
        return np.arange(len(off))
    return np.sort(np.argpartition(-off, _FEW)[: _FEW + 1])


def _rows(samples: Array, which: Callable[[Array], NDArray[np.bool_]]) -> IntArray:
    """Rows of which something is true, looked at block by block."""
    blocks = range(0, len(samples), _BLOCK)
    parts = [k + np.flatnonzero(which(samples[k : k + _BLOCK])) for k in blocks]
    return np.concatenate([np.empty(0, dtype=np.int64), *parts])


def _other_unit(channels: Iterable[Array]) -> tuple[int, float, str] | None:
    """The run that is off by the factor of a unit from all others, which agree."""
    figures = []
    for samples in channels:
        if not np.isfinite(samples).all():
            return None
        figures.append((samples.std(), np.ptp(samples), abs(samples.mean())))
    table = np.array(figures)
    if len(table) < 2:
        return None
    for place in range(len(table)):
        others = np.delete(table, place, axis=0)
        usual = np.median(others, axis=0)
        # A mean of nearly nothing says nothing.
        told = np.array([True, True, usual[2] > usual[0]])
        if not (usual[told] > 0).all() or not (table[place, told] > 0).all():
            continue
        if (others[:, told].max(0) > _ALIKE * usual[told]).any():
            continue
        if (others[:, told].min(0) * _ALIKE < usual[told]).any():
            continue
        ratio = np.log(table[place, told] / usual[told])
        # No run is exactly like another.
        scatter = _NEAR if told[2] else _NEARER
        for factor, word in _FACTORS.items():
            for sign, text in ((1, word), (-1, f"1 / {word}")):
                if np.abs(ratio - sign * np.log(factor)).max() <= scatter:
                    return place, float(np.exp(ratio.mean())), text
    return None

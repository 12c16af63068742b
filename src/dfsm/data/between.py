"""Inputs as they are between samples: held, joined by straight lines, or smooth.

A controller with a sampling time, an operator, and a converter hold what they give out; a wind or a
wave goes on between samples. What an input does there decides what it seems to effect: a held
one, taken for a line, seems to act half a step early.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view

from dfsm.core.types import Array, IntArray
from dfsm.data.signs import changes_regularly
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, missing
from dfsm.numerics.time_mesh import same_instant

Between = Literal["hold", "linear", "cubic"]
KINDS: tuple[str, ...] = get_args(Between)
# One for all inputs, or by name; inputs without one are as the model or the data say.
Chosen = Between | Mapping[str, Between] | None

# A held input stays over at least this share of the intervals.
_STAYS = 0.5
# Of its moves at most this share goes on in the direction of the one before: a signal that leaves a
# limit and comes back moves on for many samples.
_GOES_ON = 0.35
# A signal is rough that turns at so many of its samples, and has such a share of its variance above
# a quarter of the sampling rate; and the fewest samples that tell.
_TURNS, _FAST, _FEWEST = 0.5, 0.15, 30
# A slow signal that is rounded stays and moves by one unit of its rounding, over so many levels.
_ROUNDED = 20
# Steps of rounding are alike, within such a share of the usual one.
_ALIKE = 0.1
# A line between two samples is an event that rises so many times as much as those beside it, as
# those of the whole record, and over such a share of the range; so many intervals on each side are
# beside it, and more events than such a share of the intervals are how the input is.
_SUDDEN, _MATTERS, _BESIDE, _FEW = 12.0, 0.02, 8, 0.1


def is_held(values: Array) -> bool:
    """Tell whether samples ``(time,)`` stay and jump, as those of a held input do.

    One that jumps at regular moments, as a digital controller does, may follow a smooth signal, as
    long as its steps are not all of one size: a slow signal that is rounded moves like that.
    """
    steps = np.diff(values)
    moves = steps[steps != 0]
    if not len(moves) or len(moves) > (1 - _STAYS) * len(steps):
        return False
    follows = (steps[1:] != 0) & (steps[:-1] != 0)
    goes_on = follows & (np.sign(steps[1:]) == np.sign(steps[:-1]))
    if goes_on.sum() > _GOES_ON * len(moves):
        return False
    sizes = np.abs(moves)
    usual = np.median(sizes)
    if np.ptp(values) < _ROUNDED * usual:
        return True
    differ = np.median(np.abs(sizes - usual)) > _ALIKE * usual
    return bool(differ) and changes_regularly(values)


class Roughness(NamedTuple):
    """How rough samples are.

    Attributes
    ----------
    turns
        Share of the samples at which the slope changes its sign.
    fast
        Share of the variance above a quarter of the sampling rate.
    """

    turns: float
    fast: float

    @property
    def rough(self) -> bool:
        """Whether no spline knows what is between the samples."""
        return self.turns >= _TURNS and self.fast >= _FAST


def roughness(values: Array) -> Roughness:
    """Judge equidistant samples ``(time,)``."""
    if len(values) < _FEWEST or not np.ptp(values) > 0:
        return Roughness(0.0, 0.0)
    steps = np.diff(values)
    # Tapered, for an offset of the ends is all frequencies.
    tapered = (values - values.mean()) * np.hanning(len(values))
    power = np.abs(np.fft.rfft(tapered)) ** 2
    fast = power[len(power) // 2 :].sum() / power.sum()
    return Roughness(float(np.mean(steps[1:] * steps[:-1] < 0)), float(fast))


def rough_ones(
    runs: Sequence[Trajectory], names: Sequence[str], kinds: Sequence[Between]
) -> tuple[str, ...]:
    """Inputs that are joined by lines and turn at nearly every sample, in all runs that they vary.

    Parameters
    ----------
    runs
        The samples that count.
    names, kinds
        Inputs, and what they do between samples.
    """
    rough = []
    for name, kind in zip(names, kinds, strict=True):
        moving = [run for run in runs if np.ptp(run[name]) > 0]
        even = all(not same_instant(run.time).any() for run in moving)
        if kind == "linear" and moving and even:
            found = [roughness(run[name]).rough for run in moving]
            rough += [name] if all(found) else []
    return tuple(rough)


def recognised(runs: Iterable[Trajectory], names: Sequence[str]) -> tuple[Between, ...]:
    """Tell of each channel whether it is held in every run in which it varies.

    Samples that are one instant, before and after an event, show a jump whatever the input does
    between samples, and have no say.

    Returns
    -------
    tuple of str
        ``"hold"`` or ``"linear"``, in the order of `names`.
    """
    found: dict[str, list[bool]] = {name: [] for name in names}
    for run in runs:
        apart = np.concatenate([[True], ~same_instant(run.time)])
        for name in names:
            values = run[name][apart]
            if np.ptp(values) > 0:
                found[name].append(is_held(values))
    return tuple("hold" if found[n] and all(found[n]) else "linear" for n in names)


def resolved(
    chosen: Chosen, names: Sequence[str], otherwise: Sequence[Between] = ()
) -> tuple[Between, ...]:
    """What each input does between samples.

    Parameters
    ----------
    chosen
        One kind for all, or by name.
    names
        The inputs.
    otherwise
        Kinds of those that are not named, in the order of `names`; empty takes lines.

    Raises
    ------
    DfsmError
        A kind that there is not, or a name that is no input.
    """
    if chosen is None:
        chosen = {}
    if isinstance(chosen, str):
        chosen = dict.fromkeys(names, chosen)
    if lost := [name for name in chosen if name not in names]:
        raise DfsmError(f"inputs: {missing(lost, names)}")
    for name, kind in chosen.items():
        if kind not in KINDS:
            raise DfsmError(f"inputs.{name} is '{kind}', expected one of {', '.join(KINDS)}")
    rest = otherwise or ("linear",) * len(names)
    return tuple(chosen.get(n, kind) for n, kind in zip(names, rest, strict=True))


def combined(first: Chosen, then: Chosen, names: Sequence[str]) -> Chosen:
    """What two choices say together of some inputs: the first goes before, name by name."""
    if isinstance(first, str):
        return first
    rest: Mapping[str, Between] | None
    rest = {name: then for name in names} if isinstance(then, str) else then
    both: dict[str, Between] = {**(rest or {}), **(first or {})}
    return both or None


def parse_chosen(text: str | None) -> Chosen:
    """Read what a command line says: one kind, or ``name=kind`` separated by commas.

    Raises
    ------
    DfsmError
        It is neither.
    """
    if text is None:
        return None
    parts = [part.strip().rpartition("=") for part in text.split(",")]
    kinds = {kind.strip() for _, _, kind in parts}
    named = [bool(name) for name, _, _ in parts]
    if not kinds <= {*KINDS} or (not all(named) and len(parts) > 1):
        raise DfsmError(
            f"--interpolation is '{text}', expected one of {', '.join(KINDS)}, or these by input: "
            "u=hold,w=cubic"
        )
    by_name = {name.strip(): kind.strip() for name, _, kind in parts}
    # The kinds were compared with those that there are.
    return by_name if all(named) else parts[0][2].strip()  # pyright: ignore[reportReturnType]


def events(time: Array, values: Array) -> IntArray:
    """Intervals over which an otherwise smooth input moves suddenly: a hammer's blow, a trip.

    Parameters
    ----------
    time
        Samples in s, ``(sample,)``.
    values
        The input there, ``(sample,)``.

    Returns
    -------
    ndarray
        Each by its first sample, increasing; none where two samples stand for one instant.
    """
    apart = np.flatnonzero(~same_instant(time))
    moves = np.abs(np.diff(values))[apart]
    rises = moves / np.diff(time)[apart]
    if len(apart) <= 2 * _BESIDE or not rises.any():
        return np.empty(0, dtype=np.intp)
    large = rises > _SUDDEN * np.median(rises[rises > 0])
    found = np.flatnonzero(large & (moves > _MATTERS * np.ptp(values)))
    around = np.pad(rises, _BESIDE, mode="reflect")
    beside = np.median(sliding_window_view(around, 2 * _BESIDE + 1)[found], axis=1)
    found = found[rises[found] > _SUDDEN * beside]
    return apart[found] if len(found) <= _FEW * len(apart) else apart[:0]


def kinks(run: Trajectory, names: Sequence[str], kinds: Sequence[Between]) -> IntArray:
    """Samples at which states have a kink, for an input does something sudden there; increasing.

    Parameters
    ----------
    run
        The whole record.
    names, kinds
        Its inputs, and what they do between samples: held ones jump at samples, all may jump
        between two samples at one instant, and `events` of those joined by lines begin and end at
        samples.
    """
    values = run.select(names).values
    moved = np.diff(values, axis=0) != 0
    moved[~same_instant(run.time)] &= np.array([kind == "hold" for kind in kinds], dtype=bool)
    found = [np.flatnonzero(moved.any(axis=1)) + 1]
    for column, kind in zip(values.T, kinds, strict=True):
        if kind == "linear":
            first = events(run.time, column)
            found += [first, first + 1]
    return np.unique(np.concatenate(found))


def polynomials(time: Array, values: Array, kinds: Sequence[Between]) -> Array:
    """Inputs at every time, as a polynomial between each two samples.

    Parameters
    ----------
    time
        Samples in s, ``(sample,)``.
    values
        Inputs there, ``(sample, input)``.
    kinds
        What each does between them. Splines end where two samples stand for one instant.

    Returns
    -------
    ndarray
        Coefficients of the powers three to none of the time since the sample before,
        ``(4, sample - 1, input)``.
    """
    c = np.zeros((4, len(time) - 1, values.shape[1]))
    c[3] = values[:-1]
    smooth = np.array([kind == "cubic" for kind in kinds], dtype=bool)
    lines = np.array([kind == "linear" for kind in kinds], dtype=bool)
    c[2][:, lines] = np.diff(values[:, lines], axis=0) / np.diff(time)[:, None]
    if smooth.any():
        ends = [-1, *np.flatnonzero(same_instant(time)), len(time) - 1]
        for before, last in pairwise(ends):
            part = slice(before + 1, last + 1)
            if last > before + 1:
                spline = scipy.interpolate.CubicSpline(time[part], values[part][:, smooth]).c
                c[4 - len(spline) :, part.start : last, smooth] = spline
    return c

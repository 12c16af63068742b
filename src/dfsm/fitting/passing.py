"""Blade-passing loads: which harmonics of the wind field make them, learnt per output and multiple.

What ĝ leaves is regressed on q_n e^{ikψ} of the recorded azimuth, between (k - ½) and (k + ½) times
the rotor's mean speed, where nothing else should vary. Runs left out decide everything: which n,
whether coefficients follow the operating point, how much they are shrunk, and whether a multiple k
of the speed is there at all. Runs in the same wind are left out together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray
from dfsm.data.dataset import Dataset
from dfsm.errors import DfsmError
from dfsm.fitting.samples import Samples
from dfsm.models.dfsm import DFSM
from dfsm.models.passing import (
    FACTORS,
    Passing,
    field_harmonics,
    harmonics_of,
    operating_factors,
)
from dfsm.models.signals import Azimuth

# Sets of factors that coefficients may have: constant, with the speed, and with the schedule too.
_FORMS = ((0,), (1,), (1, 2))
# Shrinkage, in shares of the mean square of a harmonic.
_RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)
# What is simpler is kept where it explains at most so much less of a band, on runs left out.
_TOLERANCE = 0.005
# A multiple of the speed that explains less of its band than this on runs left out is noise.
_WORTHWHILE = 0.05
# The other direction of the azimuth is the right one where it explains so much more.
_CLEARLY = 0.2
# Half the width of a band, in multiples of the rotor's mean speed.
_HALF = 0.5
# Blocks of a run that are left out in turn where all runs have the same wind.
_BLOCKS = 4
# A band holds a load where its RMS is at least this share of the output's standard deviation.
_PRESENT = 0.01
# Below this share explained, a note says what is missing.
_MOST = 0.5
# RMS of what is left without a field over that of the band, above which inputs cause it.
_OVERFILLED = 1.15


@dataclass(frozen=True)
class _Sums:
    """Sums of products over the samples of one part of the data, between two frequencies.

    Attributes
    ----------
    gram, right
        Of the features, and of features and residuals: ``(feature, feature)``,
        ``(feature, output)``.
    residual, total
        Of squared residuals and squared outputs, ``(output,)``.
    count
        Samples.
    """

    gram: Array
    right: Array
    residual: Array
    total: Array
    count: int

    @classmethod
    def of(cls, features: Array, residuals: Array, outputs: Array) -> _Sums:
        """Sums over samples."""
        squares = (residuals**2).sum(0), (outputs**2).sum(0)
        return cls(features.T @ features, features.T @ residuals, *squares, len(features))

    def __add__(self, other: _Sums) -> _Sums:
        names = ("gram", "right", "residual", "total", "count")
        return _Sums(*(getattr(self, n) + getattr(other, n) for n in names))


@dataclass(frozen=True)
class _Choice:
    """What one output takes at one multiple of the speed."""

    orders: tuple[int, ...]
    form: int
    ridge: float


class _Multiple:
    """Everything about one multiple k of the speed: sums per fold, and what explains how much.

    Features are the harmonics times the factors, factor by factor.
    """

    def __init__(self, orders: Sequence[int], rings: int, folds: Sequence[_Sums]) -> None:
        self.orders, self.rings, self.folds = tuple(orders), rings, folds
        self._errors: dict[_Choice, Array] = {}

    @cached_property
    def whole(self) -> _Sums:
        """Sums over all folds."""
        return _summed(self.folds)

    def columns(self, choice: _Choice) -> IntArray:
        """Features of a choice."""
        n = 1 + len(self.orders) * self.rings
        taken = np.repeat([o in choice.orders for o in self.orders], self.rings)
        both = np.flatnonzero(np.tile([True, *taken], 2))
        return np.concatenate([f * 2 * n + both for f in _FORMS[choice.form]])

    def coefficients(self, choice: _Choice, sums: _Sums) -> tuple[IntArray, Array]:
        """Features and their ridge solution ``(feature, output)``."""
        columns = self.columns(choice)
        gram = sums.gram[np.ix_(columns, columns)]
        size = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        scaled = gram / np.outer(size, size) + choice.ridge * np.eye(len(columns))
        return columns, np.linalg.solve(scaled, sums.right[columns] / size[:, None]) / size[:, None]

    def left(self, choice: _Choice) -> Array:
        """Squares that are left on folds left out of training, ``(output,)``."""
        if choice not in self._errors:
            squares = np.zeros(len(self.whole.residual))
            for k, held in enumerate(self.folds):
                others = _summed([f for i, f in enumerate(self.folds) if i != k])
                columns, c = self.coefficients(choice, others)
                gram = held.gram[np.ix_(columns, columns)]
                squares += held.residual - 2 * (c * held.right[columns]).sum(0)
                squares += (c * (gram @ c)).sum(0)
            self._errors[choice] = squares
        return self._errors[choice]

    def explained(self, choice: _Choice, output: int) -> float:
        """Share of the output's band that choice and ĝ explain together."""
        return 1 - float(self.left(choice)[output] / max(self.whole.total[output], 1e-300))

    def choose(self, output: int, forms: Iterable[int]) -> _Choice | None:
        """The simplest of what explains most of one output; None where nothing does."""

        def best(orders: tuple[int, ...], forms: Iterable[int]) -> _Choice:
            choices = [_Choice(orders, f, r) for f in forms for r in _RIDGES]
            return max(choices, key=lambda c: self.explained(c, output))

        tried = [best(self.orders, [f]) for f in forms]
        least = max(self.explained(c, output) for c in tried) - _TOLERANCE
        choice = next(c for c in tried if self.explained(c, output) >= least)
        while choice.orders:
            fewer = [
                best(tuple(n for n in choice.orders if n != gone), [choice.form])
                for gone in choice.orders
            ]
            simpler = max(fewer, key=lambda c: self.explained(c, output))
            if self.explained(simpler, output) < least:
                break
            choice = simpler
        before = 1 - float(self.whole.residual[output] / max(self.whole.total[output], 1e-300))
        gain = self.explained(choice, output) - before
        return choice if gain >= _WORTHWHILE else None


def fit_passing(
    model: DFSM, samples: Samples, data: Dataset
) -> tuple[DFSM, list[dict[str, Any]], list[str]]:
    """Add to a model what the wind field does to its outputs as blades pass.

    Parameters
    ----------
    model
        With an output function; its azimuth has rings.
    samples
        All training samples, with the azimuth and field as recorded. Inputs may be along rollouts.
    data
        The runs that they are of.

    Returns
    -------
    tuple
        The model; per output a dictionary of JSON values: ``explained`` (share of every band that
        has harmonics of the field, on runs left out) and ``text``; at most one warning.

    Raises
    ------
    DfsmError
        The azimuth turns the other way, or at another speed than the rotor.
    """
    azimuth = model.signals.azimuth
    turn = model.signals.azimuth_rate
    if azimuth is None or turn is None or model.g is None or not samples.outputs.shape[1]:
        return model, [], []
    column = model.signals.state_columns.start + turn[0]
    speed = float(np.abs(samples.inputs[:, column]).mean())
    schedule = _schedule(model, samples.inputs)
    ends = np.array([schedule.min(), schedule.max()])
    factors = np.asarray(operating_factors(samples.inputs[:, column] / speed, schedule, ends))
    residuals = samples.outputs - _averages(model, samples)
    groups = data.matched(model.signals.names("field"))
    parts = _Parts(samples, residuals, factors, groups)
    multiples = parts.multiples(azimuth)
    _check_direction(parts, multiples, azimuth)
    forms = range(len(_FORMS) if ends[1] > ends[0] else 2)
    n = len(harmonics_of(azimuth))
    C = np.zeros((FACTORS, samples.outputs.shape[1], 2 * n))
    accounts: list[dict[str, Any]] = []
    for i in range(C.shape[1]):
        chosen = {k: m.choose(i, forms) for k, m in multiples.items()}
        first = 0
        for k, tried in azimuth.tried.items():
            width = 1 + len(tried) * len(azimuth.rings)
            choice = chosen.get(k)
            if choice is not None:
                m = multiples[k]
                columns, c = m.coefficients(choice, m.whole)
                factor, place = np.divmod(columns, 2 * width)
                part, place = np.divmod(place, width)
                C[factor, i, part * n + first + place] = c[:, i]
            first += width
        accounts.append(_account(multiples, chosen, i))
    passing = Passing(from_host(C), from_host(speed), from_host(ends), column)
    notes = _overfilled(multiples.get(azimuth.blades), azimuth.blades, samples)
    return replace(model, passing=passing), accounts, notes


def unexplained(model: DFSM, samples: Samples) -> list[str]:
    """What a fit without a wind field should say about blade passing: at most one sentence."""
    azimuth, turn = model.signals.azimuth, model.signals.azimuth_rate
    if azimuth is None or turn is None or azimuth.rings or not samples.outputs.shape[1]:
        return []
    k = azimuth.blades
    residuals = samples.outputs - _averages(model, samples)
    sums = _Parts(samples, residuals, np.ones((len(residuals), 1)), ()).around(k)
    if sums is None:
        return []
    shares = 1 - sums.residual / np.maximum(sums.total, 1e-300)
    poor = [
        f"{max(share, 0):.0%} for {name}"
        for name, share in zip(_present(sums, samples), shares, strict=True)
        if name and share < _MOST
    ]
    if not poor:
        return []
    return [
        f"cos {k}ψ and sin {k}ψ explain little of the {k}P band ({', '.join(poor)}): most of such "
        "loads comes from the wind field that blades turn in; dfsm wind adds its harmonics to "
        "runs, for azimuth.rings"
    ]


def _overfilled(multiple: _Multiple | None, k: int, samples: Samples) -> list[str]:
    """Where ĝ has more in the band of blade passing than there is, before the field comes in."""
    if multiple is None:
        return []
    sums = multiple.whole
    left = np.sqrt(sums.residual / np.maximum(sums.total, 1e-300))
    names = _present(sums, samples)
    poor = {n: v for n, v in zip(names, left, strict=True) if n and v > _OVERFILLED}
    if not poor:
        return []
    worst = max(poor, key=lambda n: poor[n])
    return [
        f"without the wind field the model leaves {poor[worst]:.1f} times the {k}P band of "
        f"{worst}: an input reaches too far up in frequency (rates among the features do, "
        "lags of the same channel do not)"
    ]


def _present(sums: _Sums, samples: Samples) -> list[str]:
    """Names of the outputs that have a load in a band, empty for the others."""
    there = np.sqrt(sums.total / max(sums.count, 1)) > _PRESENT * samples.outputs.std(0)
    names = samples.signals.names("outputs")
    return [name if t else "" for name, t in zip(names, there, strict=True)]


# -- sums over the samples ----------------------------------------------------------------------


@dataclass(frozen=True)
class _Parts:
    """Samples with what ĝ leaves of them, and which runs are left out together.

    Attributes
    ----------
    samples
        All of them.
    residuals
        What ĝ leaves, ``(sample, output)``.
    factors
        Factors of the coefficients, ``(sample, factor)``.
    groups
        Runs with the same wind.
    """

    samples: Samples
    residuals: Array
    factors: Array
    groups: Sequence[Sequence[int]]

    def multiples(self, azimuth: Azimuth) -> dict[int, _Multiple]:
        """Sums of every multiple of the speed."""
        sums: dict[int, list[_Sums]] = {k: [] for k in azimuth.tried}
        alone = len(self.groups) < 2
        for group in self.groups:
            for k, tried in azimuth.tried.items():
                one = replace(azimuth, orders={k: tried})
                parts = [p for run in group for p in self._band(run, k, one)]
                if parts:
                    sums[k] += parts if alone else [_summed(parts)]
        rings = len(azimuth.rings)
        tried = azimuth.tried
        return {k: _Multiple(tried[k], rings, f) for k, f in sums.items() if len(f) > 1}

    def around(self, k: int) -> _Sums | None:
        """Sums of residuals and outputs in one band, without features."""
        runs = range(len(self.samples.times))
        parts = [p for run in runs for p in self._band(run, k, None)]
        return _summed(parts) if parts else None

    def _band(self, run: int, k: int, azimuth: Azimuth | None) -> list[_Sums]:
        """Blocks of one run, between two frequencies; none where it resolves less than a turn."""
        s, rows = self.samples, self.samples.parts[run]
        time, psi = s.times[run], s.psi[rows]
        steps = np.diff(time)
        mesh, step = time, float(np.median(steps))
        turns = abs(psi[-1] - psi[0]) / (2 * np.pi)
        mean = turns / (time[-1] - time[0])
        low, high = (k - _HALF) * mean * step * 2, (k + _HALF) * mean * step * 2
        if turns < 2 or high >= 1:
            return []
        h = np.zeros((len(time), 0))
        if azimuth is not None:
            field = s.field[rows][:, [s.signals.names("field").index(n) for n in azimuth.field]]
            h = np.asarray(field_harmonics(psi, field, azimuth))
        features = (self.factors[rows][:, :, None] * h[:, None, :]).reshape(len(time), -1)
        values = np.concatenate([features, self.residuals[rows], s.outputs[rows]], axis=1)
        if np.ptp(steps) > 1e-3 * step:
            mesh = np.arange(time[0], time[-1], step)
            values = np.stack([np.interp(mesh, time, v) for v in values.T], axis=1)
        filtered = _band_pass(values, low, high)
        n, m = features.shape[1], self.residuals.shape[1]
        X, r, y = filtered[:, :n], filtered[:, n : n + m], filtered[:, n + m :]
        blocks = np.array_split(np.arange(len(mesh)), _BLOCKS)
        return [_Sums.of(X[b], r[b], y[b]) for b in blocks]


def _band_pass(values: Array, low: float, high: float) -> Array:
    """Zero-phase Butterworth filter between two shares of the Nyquist frequency."""
    sections = scipy.signal.butter(3, [low, high], btype="bandpass", output="sos")
    padding = min(len(values) - 1, int(np.ceil(6 / (high - low))))
    return scipy.signal.sosfiltfilt(sections, values - values.mean(0), axis=0, padlen=padding)


def _summed(parts: Sequence[_Sums]) -> _Sums:
    total = parts[0]
    for part in parts[1:]:
        total += part
    return total


def _averages(model: DFSM, samples: Samples) -> Array:
    """What ĝ gives without a field, blade by blade where it has harmonics of its own."""
    azimuth = model.signals.azimuth
    own = azimuth is not None and not azimuth.rings
    return np.asarray(model.output(*model.split(samples.inputs), samples.psi if own else None))


def _schedule(model: DFSM, inputs: Array) -> Array:
    column = None if model.g is None else model.g.schedule
    return np.zeros(len(inputs)) if column is None else inputs[:, column]


# -- does the azimuth turn as it should? ---------------------------------------------------------


def _check_direction(parts: _Parts, multiples: dict[int, _Multiple], azimuth: Azimuth) -> None:
    """Refuse an azimuth that turns the other way in the field than the settings say."""

    def shares(multiples: dict[int, _Multiple], turning: bool) -> Array:
        """What harmonics explain, without those that are the same either way unless `turning`."""
        return np.array(
            [
                max(m.explained(_Choice(orders, 1, _RIDGES[1]), i), 0)
                for m in multiples.values()
                for orders in [tuple(n for n in m.orders if turning or n == 0)]
                for i in range(parts.residuals.shape[1])
            ]
        )

    told = shares(multiples, True)
    # Only the right way can they explain anything: the other is tried where they do not.
    if not len(told) or (told - shares(multiples, False)).max() >= _CLEARLY:
        return
    other = replace(azimuth, direction=-azimuth.direction)
    turned = shares(parts.multiples(other), True)
    if (turned - told).max() < _CLEARLY:
        return
    best = int(np.argmax(turned - told))
    outputs = parts.samples.signals.names("outputs")
    k = list(multiples)[best // len(outputs)]
    raise DfsmError(
        f"the azimuth '{azimuth.angle}' turns the other way in the wind field than "
        f"azimuth.direction {azimuth.direction} says: with {other.direction} its harmonics explain "
        f"{turned[best]:.0%} instead of {told[best]:.0%} of the {k}P band of "
        f"{outputs[best % len(outputs)]}, so set azimuth.direction to {other.direction}"
    )


# -- what was done ------------------------------------------------------------------------------


def _account(
    multiples: dict[int, _Multiple], chosen: dict[int, _Choice | None], output: int
) -> dict[str, Any]:
    """Which harmonics an output has, and what they explain."""
    explained, told = dict[str, float](), []
    for k, choice in chosen.items():
        if choice is None:
            continue
        share = explained[f"{k}P"] = multiples[k].explained(choice, output)
        orders = f"n = {', '.join(map(str, choice.orders))}" if choice.orders else "ψ alone"
        told.append(f"{share:.0%} of the {k}P band ({orders})")
    if told:
        text = f"with harmonics of the wind field: {', '.join(told)} explained on runs left out"
    else:
        text = "harmonics of the wind field explain nothing on runs left out"
    return {"explained": explained, "text": text}

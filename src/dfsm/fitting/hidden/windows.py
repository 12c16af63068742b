"""Records cut into windows of one length, with inputs where steps need them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dfsm.core.types import Array, IntArray
from dfsm.data.between import Between
from dfsm.data.trajectory import Trajectory
from dfsm.simulation.integrate import stages_of

# Samples of a window, and windows up to which data are left out in several places of each.
LENGTH, _FEW = 1500, 3
# Share of the samples that is left out.
_LEFT_OUT, _PLACES = 0.25, 4


@dataclass(frozen=True)
class Standard:
    """What turns channels into standardised variables: (value - mean) / scale, time in `step` s."""

    outputs: tuple[Array, Array]
    inputs: tuple[Array, Array]
    step: float


@dataclass(frozen=True)
class Windows:
    """Parts of records, standardised; what fills up a shorter one has steps of zero.

    Attributes
    ----------
    y
        Outputs, ``(window, time, output)``.
    h
        Intervals, ``(window, time - 1)``.
    v
        Inputs at the start, middle and end of every step, ``(window, time - 1, step, 3, input)``.
    used, left_out
        Which samples train and which judge, 1 or 0, ``(window, time)``.
    first
        Record and sample at which each window begins, ``(window, 2)``.
    """

    y: Array
    h: Array
    v: Array
    used: Array
    left_out: Array
    first: Array

    def with_all(self) -> Windows:
        """The same, with nothing left out."""
        return replace(self, used=self.used + self.left_out, left_out=0 * self.left_out)

    def reversed(self) -> Windows:
        """Inputs as if time ran back: of the same kind, in an order that never was."""
        return replace(self, h=self.h[:, ::-1], v=self.v[:, ::-1, ::-1, ::-1])

    def part(self, rows: slice | IntArray) -> Windows:
        """Some of the windows."""
        return Windows(*(getattr(self, n)[rows] for n in _FIELDS))

    def heads(self, samples: int) -> Windows:
        """The first samples of every window."""
        cut = {n: getattr(self, n)[:, : samples - 1] for n in ("h", "v")}
        return replace(
            self, **cut, **{n: getattr(self, n)[:, :samples] for n in ("y", "used", "left_out")}
        )

    def pieces(self, length: int) -> Windows:
        """Windows of about so many samples that share their ends, for training alone.

        `first` tells the window and sample at which each begins; where all is left out is none.
        """
        cuts = [
            (i, int(a), int(b))
            for i, there in enumerate(self.used + self.left_out)
            for a, b in pairwise(_edges(int(np.count_nonzero(there)), length))
            if self.used[i, a : b + 1].any()
        ]
        N = max(b - a for _, a, b in cuts) + 1
        sizes = {"y": N, "h": N - 1, "v": N - 1, "used": N}
        cut = {
            name: np.zeros((len(cuts), size, *getattr(self, name).shape[2:]))
            for name, size in sizes.items()
        }
        for k, (i, a, b) in enumerate(cuts):
            for name, size in sizes.items():
                count = b - a + 1 - (N - size)
                cut[name][k, :count] = getattr(self, name)[i, a : a + count]
        first = np.array([(i, a) for i, a, _ in cuts])
        return Windows(**cut, left_out=np.zeros_like(cut["used"]), first=first)


_FIELDS = ("y", "h", "v", "used", "left_out", "first")


def standard_of(records: Sequence[Trajectory], outputs: int) -> Standard:
    """Mean and spread of the channels, of which the first are outputs, and the usual interval."""
    values = np.concatenate([r.values for r in records])
    scale = values.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    step = float(np.median(np.concatenate([np.diff(r.time) for r in records])))
    mean = values.mean(axis=0)
    return Standard((mean[:outputs], scale[:outputs]), (mean[outputs:], scale[outputs:]), step)


def windows_of(
    records: Sequence[Trajectory],
    standard: Standard,
    kinds: Sequence[Between],
    steps: int,
    most: int | None = None,
) -> Windows:
    """Cut records into windows.

    Parameters
    ----------
    records
        Outputs and inputs, in this order.
    standard
        Of them.
    kinds
        What each input does between samples.
    steps
        Of the integration per sample.
    most
        Of the samples; windows are then spread over the records.
    """
    length = min(LENGTH, max(len(r) for r in records))
    cuts = [
        (k, int(a), int(b))
        for k, r in enumerate(records)
        for a, b in pairwise(_edges(len(r), length))
    ]
    if most is not None and len(cuts) * length > most:
        chosen = np.linspace(0, len(cuts) - 1, max(1, most // length)).round().astype(int)
        cuts = [cuts[i] for i in dict.fromkeys(chosen.tolist())]
    ny = len(standard.outputs[0])
    v = [_stages(r, standard, kinds, steps, ny) for r in records]
    W, N = len(cuts), max(b - a for _, a, b in cuts) + 1
    out = Windows(
        np.zeros((W, N, ny)),
        np.zeros((W, N - 1)),
        np.zeros((W, N - 1, *v[0].shape[1:])),
        np.zeros((W, N)),
        np.zeros((W, N)),
        np.array([(k, a) for k, a, _ in cuts]),
    )
    mean, scale = standard.outputs
    for i, (k, a, b) in enumerate(cuts):
        n = b - a
        out.y[i, : n + 1] = (records[k].values[a : b + 1, :ny] - mean) / scale
        out.h[i, :n] = np.diff(records[k].time[a : b + 1]) / standard.step
        out.v[i, :n] = v[k][a:b]
        judged = _judged(n + 1, W)
        out.left_out[i, : n + 1] = judged
        out.used[i, : n + 1] = 1 - judged
    return out


def _edges(samples: int, length: int) -> Array:
    pieces = max(1, round((samples - 1) / (length - 1)))
    return np.linspace(0, samples - 1, pieces + 1).round().astype(int)


def _judged(samples: int, windows: int) -> Array:
    """Which samples of a window are left out: some stretches of a long one, the ends of many."""
    at = np.arange(samples) / samples
    if windows > _FEW:
        return (at >= 1 - _LEFT_OUT).astype(float)
    return (at * _PLACES % 1 >= 1 - _LEFT_OUT).astype(float)


def _stages(
    record: Trajectory, standard: Standard, kinds: Sequence[Between], steps: int, outputs: int
) -> Array:
    """Standardised inputs at the start, middle and end of steps, ``(interval, step, 3, input)``."""
    names = record.names[outputs:]
    mean, scale = standard.inputs
    v = np.stack(stages_of(record.select(names), kinds, steps), axis=2)
    return (v - mean) / scale

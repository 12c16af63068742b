"""When waves act: how much of a floating platform's pitch acceleration their elevation tells.

Least squares on seeds 1 to 8 of one mean wind: the acceleration from states, controls, wind, and
the elevation at some times before and after. What is left on seeds 9 and 10, where waves are, is
what that elevation does not tell. Nothing else is fitted, and no model is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

import dfsm
from benchmarks.accuracy import bundled
from dfsm.core.types import Array

# First and last seconds of the elevation, before (negative) and after, and the interval in s.
_SPANS = ((0, 0), (-10, 0), (-30, 0), (-60, 0), (-30, 2), (-30, 4), (-30, 6), (-30, 10), (-30, 20))
_INTERVAL = 0.5
# Where waves have their power, in Hz.
_BAND = (0.05, 0.25)
_SIGNALS = ("PtfmPitch", "PtfmPitch_dot", "GenSpeed", "GenTq", "BldPitch1", "RotWind")


def run() -> dict[str, Any]:
    """Share of the acceleration's standard deviation that is left, by mean wind and span."""
    turbine = bundled()
    figures: dict[str, Any] = {}
    for wind in turbine.ALL_WINDS:
        tables = [_signals(run, turbine.START) for run in turbine.runs([wind], range(1, 11))]
        figures[f"{int(wind)} m/s"] = {
            f"{first} to {last} s": _left(tables, first, last) for first, last in _SPANS
        }
    return figures


def _signals(run: dfsm.Trajectory, start: float) -> tuple[Array, Array, Array, slice]:
    """Acceleration and other signals, band-passed, the elevation, and the samples that count."""
    slopes = dfsm.differentiate(run, [dfsm.StateSpec(name="PtfmPitch", order=2)]).trajectory
    assert run.time_step is not None
    sos = butter(4, _BAND, "bandpass", fs=1 / run.time_step, output="sos")
    rate = slopes["PtfmPitch_dot"]
    table = np.column_stack([rate if n == "PtfmPitch_dot" else run[n] for n in _SIGNALS])
    acceleration = np.gradient(rate, run.time)
    passed = sosfiltfilt(sos, np.column_stack([acceleration, table]), axis=0)
    elevation = sosfiltfilt(sos, run["Wave1Elev"])
    inside = slice(*np.searchsorted(run.time, [start, run.time[-1] - max(b for _, b in _SPANS)]))
    return passed[:, 0], passed[:, 1:], elevation, inside


def _left(tables: Sequence[tuple[Array, Array, Array, slice]], first: float, last: float) -> float:
    step = 0.05
    shifts = np.rint(np.arange(first, last + _INTERVAL / 2, _INTERVAL) / step).astype(int)

    def rows(table: tuple[Array, Array, Array, slice]) -> tuple[Array, Array]:
        target, others, elevation, inside = table
        at = np.arange(inside.start, inside.stop, 4)
        waves = np.stack([elevation[at + k] for k in shifts], axis=1)
        return np.concatenate([others[at], waves], axis=1), target[at]

    X, y = (np.concatenate(parts) for parts in zip(*map(rows, tables[:8]), strict=True))
    scale = X.std(axis=0)
    weights = np.linalg.lstsq(X / scale, y, rcond=1e-10)[0]
    shares = [
        np.sqrt(np.mean((target - inputs / scale @ weights) ** 2)) / target.std()
        for inputs, target in map(rows, tables[8:])
    ]
    return float(np.mean(shares))


def waves_table(figures: dict[str, Any]) -> list[str]:
    """What is left, by span and mean wind."""
    winds = list(figures)
    lines = [f"| elevation | {' | '.join(winds)} |", "|---|" + "---|" * len(winds)]
    for span in figures[winds[0]]:
        lines.append(f"| {span} | {' | '.join(f'{figures[w][span]:.2f}' for w in winds)} |")
    return lines

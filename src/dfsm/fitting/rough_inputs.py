"""Inputs that turn at nearly every sample: nobody knows what they do in between.

The fit takes them for lines and every interval as one row, which is right for lines. Where much of
a row is left over all the same, they are not.
"""

from __future__ import annotations

import numpy as np

from dfsm.core.types import Array
from dfsm.data.between import Roughness, roughness
from dfsm.fitting.held_inputs import held_unseen
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.numerics.time_mesh import std_over

# An input matters that makes so much of a row, where so much of this is unexplained.
_MATTERS, _UNEXPLAINED = 0.2, 0.3


def rough_note(samples: Samples, name: str, row: Array, target: Array, left: Array) -> str:
    """What a rough input leaves unexplained of a row, and what to do; "" for nothing.

    Parameters
    ----------
    samples
        That the row was fitted on.
    name
        Of the row.
    row
        Its coefficients, ``(input,)``.
    target, left
        The derivative, and what the fit leaves of it, ``(sample,)``.
    """
    spread = std_over(target, samples.weights)
    unexplained = std_over(left, samples.weights) / max(float(spread), np.finfo(float).tiny)
    if not samples.rough or unexplained < _UNEXPLAINED:
        return ""
    size = np.abs(row) * std_over(samples.linear_inputs, samples.weights)
    driving = list(samples.signals.driving)
    columns = [driving.index(n) for n in samples.rough]
    column = max(columns, key=lambda c: float(size[c]))
    if size[column] < _MATTERS * spread or column in _held(samples):
        return ""
    runs = [samples.inputs[rows, column] for rows in samples.parts]
    seen = [r for values in runs if (r := roughness(values)).rough] or [Roughness(1.0, 1.0)]
    turns, fast = (float(np.mean(v)) for v in zip(*seen, strict=True))
    return (
        f"{name}: '{driving[column]}' turns at {turns:.0%} of its samples, and {fast:.0%} of its "
        "variance is above a quarter of the sampling rate; joined by straight lines it leaves "
        f"{unexplained:.0%} of the row unexplained, so it does something else in between and its "
        "effect is wrong: record it at a shorter step, or say how it goes with "
        f"inputs: {{{driving[column]}: hold}} or cubic"
    )


def _held(samples: Samples) -> list[int]:
    """Inputs that act as held ones, which is told elsewhere."""
    if samples.weights is not None:
        return []
    states = samples.inputs[:, samples.signals.observed_columns]
    driving = samples.inputs[:, samples.signals.order.driving_columns]
    return held_unseen(lambda: samples.blocks(states, driving))


def inputs_told(samples: Samples, settings: FitSettings) -> list[str]:
    """Which inputs were recognised as held or sudden, and what to set where they are not."""
    names = samples.signals.driving
    told = [
        f"{name} turns at nearly every sample: taken for lines, interval by interval (if it does "
        f"something else in between, set inputs: {{{name}: hold}} or cubic)"
        for name in samples.rough
    ]
    told += [
        f"{name} moves suddenly over {count} interval{'s' * (count > 1)} between samples: "
        "derivatives are taken between these"
        for name, count in samples.sudden
    ]
    chosen = settings.inputs or {}
    if isinstance(chosen, str):
        return told
    kinds = zip(names, samples.signals.between, strict=True)
    held = [name for name, kind in kinds if kind == "hold" and name not in chosen]
    if held:
        which = ", ".join(held)
        told.append(
            f"{which} stay{'s' * (len(held) == 1)} and jump{'s' * (len(held) == 1)}: held between "
            f"samples (for lines set inputs: {{{held[0]}: linear}})"
        )
    return told

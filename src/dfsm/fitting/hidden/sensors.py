"""What instruments make of states that nobody sees as they are, as far as records tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.windows import Standard
from dfsm.models.terms.sensor import Sensing, Sensor
from dfsm.numerics.folds import Unfolded, unfolded

# Samples of every record that tell whether an output is folded.
_LOOKED_AT = 4000
# An output ends where it stays at one value for this share of the samples, and so many of them.
_STAYS, _FEWEST = 0.01, 5


@dataclass(frozen=True)
class Sensed:
    """Records as they would be if instruments saw everything, to start from.

    Attributes
    ----------
    sensors
        One per output; empty where all see what there is.
    levels
        Of the standardised outputs, see `Form.seen`.
    records
        Standardised outputs are the first of x here, as far as they are known.
    """

    sensors: tuple[Sensor, ...]
    levels: Array
    records: Sequence[Trajectory]


def as_recorded(records: Sequence[Trajectory]) -> Sensed:
    """Outputs that are states."""
    return Sensed((), np.zeros(0), records)


def sensed(
    records: Sequence[Trajectory], standard: Standard, sensing: Sensing | None
) -> Sensed | None:
    """What may stand behind the outputs; None where they look like states.

    Parameters
    ----------
    records
        Outputs and inputs, in this order.
    standard
        Of them.
    sensing
        What all instruments do; None tries what records look like.
    """
    if sensing == "direct":
        return None
    ny = len(standard.outputs[0])
    sensors, levels, values = [], np.zeros(ny), [r.values.copy() for r in records]
    for k in range(ny):
        mean, scale = float(standard.outputs[0][k]), float(standard.outputs[1][k])
        pairs = [(r.values[:, ny:], r.values[:, k]) for r in records]
        clipped = _clipped([y for _, y in pairs], sensing)
        fold = None if sensing == "clipped" else _fold(pairs, sensing)
        if fold is not None:
            sensors.append(Sensor("absolute" if fold.power == 1 else "square", up=fold.up))
            levels[k] = (fold.level - mean) / scale
            for table, path in zip(values, fold.paths, strict=True):
                table[:, k] = mean + scale * path / scale ** (1 / fold.power)
        elif clipped is not None:
            low, high = ((end - mean) / scale for end in clipped)
            sensors.append(Sensor("clipped", low, high))
        else:
            sensors.append(Sensor())
    if all(s.sensing == "direct" for s in sensors):
        return None
    told = [replace(r, values=v) for r, v in zip(records, values, strict=True)]
    return Sensed(tuple(sensors), levels, told)


def _fold(pairs: Sequence[tuple[Array, Array]], sensing: Sensing | None) -> Unfolded | None:
    """The likeliest fold of one output."""
    powers = {"absolute": (1,), "square": (2,)}.get(sensing or "", (1, 2))
    if sensing is None:
        parts = [(u[:_LOOKED_AT], y[:_LOOKED_AT]) for u, y in pairs]
        looks = [f for p in powers if (f := unfolded(parts, p)) is not None and f.clear]
        if not looks:
            return None
        powers = (min(looks, key=lambda f: f.left).power,)
    return unfolded(pairs, powers[0])


def _clipped(outputs: Sequence[Array], sensing: Sensing | None) -> tuple[float, float] | None:
    """Where the range of an instrument ends."""
    y = np.concatenate(outputs)
    ends = [float(y.min()), float(y.max())]
    within = 1e-6 * (ends[1] - ends[0])
    there = [int(np.sum(np.abs(y - end) <= within)) for end in ends]
    stays = [count >= max(_FEWEST, _STAYS * len(y)) for count in there]
    if not any(stays) or not (ends[1] > ends[0] and sensing in (None, "clipped")):
        return None
    return ends[0] if stays[0] else -np.inf, ends[1] if stays[1] else np.inf


def behind(form: Form, parameters: Array, outputs: Array) -> list[Array]:
    """What the first states may be where outputs are seen, ``(window, output)`` each.

    Where the sign is lost there are two.
    """
    if not form.sensors:
        return [outputs]
    folds = np.array([s.folds for s in form.sensors])
    seen = outputs - folds * parameters[-form.outputs :]
    both = np.array([[s.behind(v) for s, v in zip(form.sensors, row, strict=True)] for row in seen])
    return [both[..., 0], both[..., 1]] if folds.any() else [both[..., 0]]

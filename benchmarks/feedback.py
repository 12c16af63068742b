"""How often a fit's two warnings of biased effects hit, and how often they are false alarms.

One or two states under an unknown force of some speed, in a PI loop with or without an excited
set-point, or in open loop: x' = -a x + b u + force, x'' = -w² x - 2 z w x' + b u + force. The true
b is known; half of the records have 2 % of noise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.signal import lfilter

from dfsm.core.types import Array
from dfsm.fitting.coloured import pulled
from dfsm.fitting.feedback import follows, is_feedback, much_unexplained
from dfsm.fitting.regular_controls import own_course
from dfsm.fitting.residuals import residuals_of

SEED, EACH = 5, 15
_COUNT, _FINE = 2000, 5
# Effects that are off by more count as wrong, by less as right.
_WRONG, _RIGHT = 0.3, 0.15
# Excitation of the set-point, or kind of the control in open loop.
KINDS: dict[str, tuple[str | float, ...]] = {
    "loops with an excited set-point": (0.3, 1.0, 3.0),
    "other loops": (0.0,),
    "open loops": ("sines", "noise", "steps", "one sine"),
}


def run() -> dict[str, Any]:
    """Counts by kind: wrong effects and those told, right ones and those told."""
    seeds = np.random.default_rng(SEED)
    figures = {}
    for name, kinds in KINDS.items():
        judged = [
            found
            for kind in kinds
            for order in (1, 2)
            for noise in (0.0, 0.02)
            for _ in range(EACH)
            if (
                found := _judged(np.random.default_rng(seeds.integers(1 << 30)), kind, order, noise)
            )
        ]
        wrong = [told for bias, told in judged if abs(bias) > _WRONG]
        right = [told for bias, told in judged if abs(bias) <= _RIGHT]
        figures[name] = {
            "wrong": len(wrong),
            "wrong and told": sum(wrong),
            "right": len(right),
            "right and told": sum(right),
        }
    return figures


def _judged(
    rng: np.random.Generator, kind: str | float, order: int, noise: float
) -> tuple[float, bool] | None:
    """Relative bias of b by least squares, and whether it is told; None if it runs off."""
    record = _record(rng, kind, order)
    if record is None:
        return None
    x, u, slope, b = record
    x = x + noise * x.std(axis=0) * rng.normal(size=x.shape)
    slope = slope + 3 * noise * slope.std() * rng.normal(size=len(slope))
    inputs = np.column_stack([u, x])
    row = np.linalg.lstsq(inputs - inputs.mean(axis=0), slope - slope.mean(), rcond=None)[0]
    left = slope - slope.mean() - (inputs - inputs.mean(axis=0)) @ row
    time = np.arange(float(len(u)))
    series = residuals_of([time], inputs, slope, left)
    if series is None:
        return None
    A = np.array([row[1:]]) if order == 1 else np.array([[0.0, 1.0], row[1:]])
    law = follows(series, 0, range(1, 1 + order))
    effect = np.zeros(order)
    effect[-1] = row[0]
    told = much_unexplained(series) and is_feedback(law, A, effect)
    if told and (course := own_course(series, 0, A)) is not None:
        told = course.directions < 1 + order
    fine = residuals_of([time], inputs, slope, left, inputs_too=True)
    return float(row[0] / b - 1), bool(told or (fine is not None and pulled(fine, [0])))


def _record(
    rng: np.random.Generator, kind: str | float, order: int
) -> tuple[Array, Array, Array, float] | None:
    """States ``(time, order)``, control, derivative of the last state, and b."""
    a, b = rng.uniform(0.02, 0.2), rng.uniform(0.05, 0.3)
    force = rng.uniform(0.3, 1.5) * b * _slow(rng, rng.uniform(5, 50))
    w, z = rng.uniform(0.1, 0.4), rng.uniform(0.05, 0.5)
    gain = rng.uniform(0.3, 2) * (1 if order == 1 else w**2 / b)
    rate = rng.uniform(0, 0.1) * gain
    wanted = np.repeat(rng.normal(size=_COUNT // 40), 40)
    chosen = _open(rng, kind) if isinstance(kind, str) else None
    size = 0.0 if isinstance(kind, str) else kind
    x, u, slope = np.zeros((_COUNT, order)), np.zeros(_COUNT), np.zeros(_COUNT)
    state, integral, h = np.zeros(order), 0.0, 1 / _FINE
    for k in range(_COUNT):
        off = size * wanted[k] - state[0]
        now = gain * off + rate * integral if chosen is None else chosen(k)
        integral += off
        x[k], u[k] = state, now
        for part in range(_FINE):
            f = -a * state[0] if order == 1 else -(w**2) * state[0] - 2 * z * w * state[1]
            f += b * now + force[k]
            slope[k] = slope[k] if part else f
            last = state[-1] + h * f
            state = np.array([last] if order == 1 else [state[0] + h * last, last])
        if not abs(state[0]) < 1e4:
            return None
    return x, u, slope, b


def _open(rng: np.random.Generator, kind: str) -> Callable[[int], float]:
    time = np.arange(_COUNT)
    if kind == "sines":
        rates, phases = rng.uniform(0.02, 0.5, (4, 1)), rng.uniform(0, 6, (4, 1))
        values = np.sin(rates * time + phases).sum(axis=0)
    elif kind == "noise":
        values = _slow(rng, rng.uniform(3, 30))
    elif kind == "steps":
        values = np.repeat(rng.choice([-1.0, 1.0], _COUNT // 15 + 1), 15)
    else:
        values = np.sin(rng.uniform(0.05, 0.3) * time)
    return lambda k: float(values[k])


def _slow(rng: np.random.Generator, memory: float) -> Array:
    x = rng.standard_normal(_COUNT)
    for lag in (memory, memory / 5):
        decay = np.exp(-1 / lag)
        x = np.asarray(lfilter([1 - decay], [1.0, -decay], x))
    return x / x.std()

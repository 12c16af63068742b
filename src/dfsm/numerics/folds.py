"""Signs that an instrument dropped: what was seen as |x|, as x again.

Where x crosses zero, |x| touches it with a kink. Signs are those along which a linear equation of
the past, of x and of the inputs, tells the next sample best: found by dynamic programming (Viterbi
1967, "Error bounds for convolutional codes and an asymptotically optimum decoding algorithm"), the
equation by least squares, in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dfsm.core.types import Array, IntArray

# Samples of the past that the equation takes, and how often equation and signs follow each other.
_PAST, _ROUNDS = 4, 6
# A level counts as zero where it is no farther from it than this share of the range.
_ZERO = 0.05
# Signs must leave no more than this share of what is not told without, and change so often.
_KINKS, _CROSSINGS = 0.5, 4
# Fewest samples of a record that tells.
_FEWEST = 80


class Unfolded(NamedTuple):
    """What was seen as level + up · |x|^power.

    Attributes
    ----------
    paths
        x of every record, ``(time,)``; the sign of all together is free.
    level, up
        See `fold_level`.
    power
        1 or 2.
    left
        Share of x that its past and the inputs do not tell.
    clear
        Whether it is told so much better than |x| that something folded it.
    """

    paths: Sequence[Array]
    level: float
    up: int
    power: int
    left: float
    clear: bool


def unfolded(records: Sequence[tuple[Array, Array]], power: int = 1) -> Unfolded | None:
    """Find what an instrument saw the absolute value of, or the square.

    Parameters
    ----------
    records
        Inputs ``(time, input)`` and one output ``(time,)`` of runs on even samples.
    power
        1 or 2.

    Returns
    -------
    Unfolded or None
        None where the records are too short.
    """
    level, up = fold_level([y for _, y in records])
    sizes = [np.maximum(up * (y - level), 0.0) ** (1 / power) for _, y in records]
    if max(map(len, sizes)) < _FEWEST:
        return None
    inputs = _standard([u for u, _ in records])
    longest = max(range(len(sizes)), key=lambda k: len(sizes[k]))
    smooth = np.array([2.0, -1.0, *np.zeros(_PAST - 2)])
    signs = [_signs(m, smooth, np.zeros(len(m))) for m in sizes]
    # The first equation comes from one record: signs of others may all be the opposite.
    told = [longest]
    for _ in range(_ROUNDS):
        paths = [s * m for s, m in zip(signs, sizes, strict=True)]
        own, driven = _equation([paths[k] for k in told], [inputs[k] for k in told])
        before, told = signs, list(range(len(sizes)))
        signs = [_signs(m, own, _force(u, driven)) for m, u in zip(sizes, inputs, strict=True)]
        if all(np.array_equal(a, b) for a, b in zip(before, signs, strict=True)):
            break
    paths = [s * m for s, m in zip(signs, sizes, strict=True)]
    crossings = sum(int((np.diff(s) != 0).sum()) for s in signs)
    left = _left(paths, inputs)
    clear = crossings >= _CROSSINGS and left < _KINKS * _left(sizes, inputs)
    total = sum(float(x @ x) for x in paths)
    return Unfolded(paths, level, up, power, left / max(total, np.finfo(float).tiny), clear)


def fold_level(outputs: Sequence[Array]) -> tuple[float, int]:
    """Where outputs would have been folded, and whether to above (1) or below (-1) of that.

    Kinks are sharp turns; there are more of them at the end of the range where outputs are folded.
    """
    low, high = min(float(y.min()) for y in outputs), max(float(y.max()) for y in outputs)
    turns = [(y[1:-1], y[2:] - 2 * y[1:-1] + y[:-2]) for y in outputs if len(y) > 2]
    middle = (low + high) / 2
    below = sum(float(np.sum(np.maximum(d[y < middle], 0) ** 2)) for y, d in turns)
    above = sum(float(np.sum(np.minimum(d[y >= middle], 0) ** 2)) for y, d in turns)
    end, up = (low, 1) if below >= above else (high, -1)
    return (0.0 if abs(end) <= _ZERO * (high - low) else end), up


def _standard(inputs: Sequence[Array]) -> list[Array]:
    """Inputs of spread one with a constant beside them, ``(time, input + 1)``."""
    scale = np.concatenate(inputs).std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return [np.column_stack([u / scale, np.ones(len(u))]) for u in inputs]


def _lagged(x: Array, u: Array) -> tuple[Array, Array]:
    """Past of x and inputs of now and then, ``(time - past, ...)``."""
    n = len(x) - _PAST
    own = np.stack([x[_PAST - k - 1 : _PAST - k - 1 + n] for k in range(_PAST)], axis=1)
    lags = [u[_PAST - k : _PAST - k + n, :-1] for k in range(_PAST + 1)]
    return own, np.column_stack([*lags, np.ones(n)])


def _equation(paths: Sequence[Array], inputs: Sequence[Array]) -> tuple[Array, Array]:
    """Coefficients of the past of x, and of the inputs."""
    pairs = [_lagged(x, u) for x, u in zip(paths, inputs, strict=True)]
    table = np.concatenate([np.column_stack(pair) for pair in pairs])
    now = np.concatenate([x[_PAST:] for x in paths])
    found = np.linalg.lstsq(table, now, rcond=1e-10)[0]
    return found[:_PAST], found[_PAST:]


def _left(paths: Sequence[Array], inputs: Sequence[Array]) -> float:
    """Squares that the best equation leaves."""
    own, driven = _equation(paths, inputs)
    total = 0.0
    for x, u in zip(paths, inputs, strict=True):
        past, now = _lagged(x, u)
        total += float(np.sum((x[_PAST:] - past @ own - now @ driven) ** 2))
    return total


def _force(u: Array, driven: Array) -> Array:
    force = np.zeros(len(u))
    force[_PAST:] = _lagged(np.zeros(len(u)), u)[1] @ driven
    return force


def _signs(sizes: Array, own: Array, force: Array) -> IntArray:
    """Signs of the sizes along which x_k = own · past + force_k is met best, ``(time,)``."""
    p = len(own)
    count = 2**p
    # Bit j of a state is the sign of the sample j steps ago; the newest enters as bit 0.
    bits = 1 - 2 * ((np.arange(count)[:, None] >> np.arange(p)) & 1)
    new, old = np.arange(count) & 1, np.arange(count) >> 1
    came = np.stack([old, old | (count >> 1)], axis=1)
    cost, origin = np.zeros(count), np.zeros((len(sizes), count), dtype=np.int8)
    signed = (1 - 2 * new)[:, None]
    rows = np.arange(count)
    for k in range(p, len(sizes)):
        told = bits @ (own * sizes[k - p : k][::-1]) + force[k]
        ways = cost[came] + (signed * sizes[k] - told[came]) ** 2
        best = ways.argmin(axis=1)
        cost, origin[k] = ways[rows, best], best
    state = int(cost.argmin())
    signs = np.empty(len(sizes), dtype=np.int64)
    for k in range(len(sizes) - 1, p - 1, -1):
        signs[k] = bits[state, 0]
        state = int(came[state, origin[k, state]])
    signs[:p] = bits[state][::-1]
    return signs

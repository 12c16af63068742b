"""Rainflow counting, four turning points at a time."""

from __future__ import annotations

from collections.abc import Sequence


def four_point_cycles(loads: Sequence[float]) -> tuple[list[tuple[int, int]], list[int]]:
    """Cycles that close along turning points (ISO 12110-2), and the points that remain.

    Parameters
    ----------
    loads
        Turning points; Python's own numbers, with which this is fastest.

    Returns
    -------
    tuple
        Places of both ends of every cycle in the order in which they close, and of what is left.
    """
    pairs: list[tuple[int, int]] = []
    kept: list[int] = []
    values: list[float] = []
    for i, load in enumerate(loads):
        while len(values) >= 3:
            b, c = values[-2], values[-1]
            inner = abs(c - b)
            if inner > abs(b - values[-3]) or inner > abs(load - c):
                break
            pairs.append((kept[-2], kept[-1]))
            del kept[-2:], values[-2:]
        kept.append(i)
        values.append(load)
    return pairs, kept

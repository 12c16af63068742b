"""Interpolation in a grid of equidistant points, as weights of the points."""

from __future__ import annotations

import numpy as np

from dfsm.core.types import Array, IntArray


def bilinear_weights(columns: Array, rows: Array, x: Array, y: Array) -> Array:
    """Weights that interpolate in a grid at places inside it; outside, its edge counts.

    Parameters
    ----------
    columns, rows
        Equidistant coordinates of the grid, increasing, shapes ``(column,)`` and ``(row,)``.
    x, y
        Places, along the columns and along the rows, shape ``(place,)``.

    Returns
    -------
    ndarray
        Shape ``(place, point)``; points go along the columns first.
    """
    weights = np.zeros((len(x), len(rows), len(columns)))
    places = np.arange(len(x))
    row, up = _cell(rows, y)
    column, side = _cell(columns, x)
    for i, part in ((0, 1 - up), (1, up)):
        weights[places, row + i, column] = part * (1 - side)
        weights[places, row + i, column + 1] = part * side
    return weights.reshape(len(x), -1)


def _cell(grid: Array, at: Array) -> tuple[IntArray, Array]:
    """Which cell of an equidistant grid, and how far along it from 0 to 1."""
    place = np.clip((at - grid[0]) / (grid[1] - grid[0]), 0, len(grid) - 1)
    cell = np.minimum(place.astype(np.int64), len(grid) - 2)
    return cell, place - cell

"""Inputs that act late: dead time, which least squares takes for slow dynamics.

Where what an input did some time ago explains a derivative much better than what it does now, the
fit has no way to say so but a slower eigenvalue and a larger gain. The same row is fitted with the
input delayed by a grid of times; the time that leaves least says by how much it is late.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.fitting.residuals import Residuals, stacked

# A row is looked at where more than this is unexplained, and a delay told where it leaves at most
# this share of the residual's variance; of a residual below a tenth it must leave less.
_UNEXPLAINED, _LEAVES = 0.02, 0.25
_SMALL, _LEAVES_OF_SMALL = 0.1, 0.1
# Share of a sampling interval below which it is no delay: half of one is what a held input, taken
# for a line, seems to be late or early.
_LATE = 0.75
# Intervals below which chance explains as much, delays tried, and the longest relative to a run.
_FEWEST, _TRIED, _LONGEST = 150, 40, 0.2


@dataclass(frozen=True)
class LateInput:
    """How late an input acts on a row.

    Attributes
    ----------
    column
        Of the inputs.
    seconds
        The delay that explains most.
    unexplained
        What is left with it, relative to the derivative's standard deviation.
    small
        Whether little is unexplained without it, too.
    """

    column: int
    seconds: float
    unexplained: float
    small: bool


def late_input(residuals: Residuals, columns: range) -> LateInput | None:
    """The input whose delay explains most of what a row leaves over, if one explains much.

    Parameters
    ----------
    residuals
        One row.
    columns
        Inputs that may act late.
    """
    sizes = [len(run) for run in residuals.inputs]
    if residuals.unexplained <= _UNEXPLAINED or sum(sizes) < _FEWEST:
        return None
    longest = _LONGEST * min(sizes)
    head = [0.0, 0.1, 0.25, 0.5, 0.75]
    grid = np.unique(np.concatenate([head, np.geomspace(1, max(longest, 1), _TRIED)]))
    shortest = _LATE * (residuals.sample or residuals.step) / residuals.step
    small = residuals.unexplained <= _SMALL
    share = _LEAVES_OF_SMALL if small else _LEAVES
    delayed = _Delayed(residuals)
    now, best = delayed.left(), None
    for column in columns:
        left = [delayed.left(column, lag) for lag in grid]
        k = int(np.argmin(left))
        around = np.linspace(grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)], 13)
        finer = [delayed.left(column, lag) for lag in around]
        lag, least = float(around[int(np.argmin(finer))]), min(finer)
        # At the end of the grid it is no delay that is sought, at its head no delay at all.
        inside = k < len(grid) - 1 and lag >= shortest
        if inside and least < share * now and (best is None or least < best[1]):
            best = (column, least, lag)
    if best is None:
        return None
    spread = float(stacked(residuals.targets).std())
    column, least, lag = best
    return LateInput(column, lag * residuals.step, float(np.sqrt(least)) / spread, small)


class _Delayed:
    """Variance that a linear fit leaves with one input delayed."""

    def __init__(self, residuals: Residuals) -> None:
        self.runs = residuals.inputs
        X, y = stacked(residuals.inputs), stacked(residuals.targets)
        X, y = X - X.mean(axis=0), y - y.mean()
        self.table = np.column_stack([X, y])
        self.gram = self.table.T @ self.table

    def left(self, column: int | None = None, lag: float = 0.0) -> float:
        """Variance left, the input in one column being so many intervals late."""
        gram, n = self.gram, len(self.table)
        if column is not None:
            late = stacked([_shifted(run[:, column], lag) for run in self.runs])
            late = late - late.mean()
            products = self.table.T @ late
            gram = gram.copy()
            gram[column], gram[:, column] = products, products
            gram[column, column] = late @ late
        scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        gram = gram / np.outer(scale, scale)
        inner, right = gram[:-1, :-1], gram[:-1, -1]
        share = 1 - right @ np.linalg.lstsq(inner, right, rcond=1e-12)[0]
        return float(share * scale[-1] ** 2 / n)


def _shifted(values: Array, lag: float) -> Array:
    at = np.arange(len(values))
    return np.interp(at - lag, at, values)


def late_note(row: str, name: str, late: LateInput, unexplained: float) -> str:
    """Which input acts late, by how much, and what to set."""
    return (
        f"{row}: '{name}' acts about {late.seconds:.3g} s late: so delayed it leaves "
        f"{late.unexplained:.1%} of the row unexplained instead of {unexplained:.1%}, and without "
        "the delay the fit takes it for slower dynamics; add the feature "
        f"{{source: {name}, kind: delay, seconds: {late.seconds:.3g}}}"
    )

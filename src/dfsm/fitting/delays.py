"""Inputs that act late or early, by dead time, a lag or a clock: taken for other dynamics.

Where what inputs did some time ago explains a derivative much better than what they do now, the
fit has no way to say so but a slower eigenvalue and a larger gain. The same row is fitted with
inputs delayed by a grid of times, several of them together; the times that leave least say by how
much they are late. A disturbance measured behind the plant, or by a clock that is late, acts before
its record does: the same with times to come.

A row of an order more is no dead time, though it looks like one: with d = dx/dt, the equation
d' = -d / τ + β x + γ u says that d is β x + γ u behind a lag of τ. The row is therefore fitted
with all of its inputs behind one lag, too, and what leaves least has the word.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

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
# Of several delays, one that the others do without costs less than so many times what they leave,
# or than such a share of the residual's variance; and how often all are sought in turn.
_DOES_WITHOUT, _COSTS, _ROUNDS = 2.0, 0.02, 6
# A lag has the word before delays that leave so many times as much; it, or an early input, is the
# whole story only where no more than this is unexplained with it: beyond, several are missing.
_CLEARER, _WHOLE = 2.0, 0.25
# Columns that follow from others to so much, and the share of a variance that rounding leaves of
# everything.
_RANK, _ROUNDING = 1e-12, 1e-12


@dataclass(frozen=True)
class LateInputs:
    """How late inputs act on a row, or how early.

    Attributes
    ----------
    seconds
        The delays that explain most, by column of the inputs; all negative where inputs are early.
    left
        Variance that is left with them.
    unexplained
        The same as a root relative to the derivative's standard deviation.
    small
        Whether little is unexplained without them, too.
    """

    seconds: Mapping[int, float]
    left: float
    unexplained: float
    small: bool


@dataclass(frozen=True)
class Lag:
    """A lag between a row and all that it takes.

    Attributes
    ----------
    seconds
        Its time constant.
    left, unexplained, small
        As of `LateInputs`.
    """

    seconds: float
    left: float
    unexplained: float
    small: bool


def late_inputs(
    residuals: Residuals, columns: Sequence[int], early: bool = False
) -> LateInputs | None:
    """The inputs whose delays explain most of what a row leaves over, if they explain much.

    Parameters
    ----------
    residuals
        One row.
    columns
        Inputs that may act late.
    early
        Look for inputs that act early instead.
    """
    search = _search(residuals)
    moving = [c for c in columns if np.ptp(stacked(residuals.inputs)[:, c]) > 0]
    if search is None or not moving:
        return None
    grid, shortest, share, rows = search
    ends = shortest, float(grid[-1])
    grid = np.unique(-grid) if early else grid
    alike = min(grid.tolist(), key=lambda lag: rows.left(dict.fromkeys(moving, float(lag))))
    # From none late, and from all late alike: of two that are, none alone explains much.
    starts = [{}] if len(moving) == 1 else [{}, dict.fromkeys(moving, alike)]
    found = [_in_turn(rows, grid, moving, start) for start in starts]
    lags = _needed(rows, min(found, key=rows.left), ends)
    left = rows.left(lags)
    if not lags or left >= share * rows.left({}):
        return None
    seconds = {c: lag * residuals.step for c, lag in sorted(lags.items())}
    found = LateInputs(seconds, left, *_relative(residuals, left))
    # What comes next tells of rates, and of much else that is missing.
    return None if early and found.unexplained > _WHOLE else found


def lag_before(residuals: Residuals, columns: Sequence[int]) -> Lag | None:
    """The lag between a row and what it takes that explains most, if it explains much.

    Parameters
    ----------
    residuals
        One row.
    columns
        What is behind the lag: the states and inputs, all of them.
    """
    search = _search(residuals)
    if search is None:
        return None
    grid, shortest, share, rows = search
    left = [rows.behind(columns, lag) for lag in grid]
    k = int(np.argmin(left))
    around = np.linspace(grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)], 13)
    finer = [rows.behind(columns, lag) for lag in around]
    lag, least = float(around[int(np.argmin(finer))]), min(finer)
    if k == len(grid) - 1 or lag < shortest or least >= share * rows.left({}):
        return None
    found = Lag(lag * residuals.step, least, *_relative(residuals, least))
    return found if found.unexplained <= _WHOLE else None


def is_lag(lag: Lag | None, late: LateInputs | None) -> bool:
    """Whether a lag explains a row, and no delays do as well."""
    return lag is not None and (late is None or late.left > _CLEARER * lag.left)


def _search(residuals: Residuals) -> tuple[Array, float, float, _Rows] | None:
    """Delays to try and the shortest to tell, in intervals, the share that they may leave; rows."""
    sizes = [len(run) for run in residuals.inputs]
    if residuals.unexplained <= _UNEXPLAINED or sum(sizes) < _FEWEST:
        return None
    longest = _LONGEST * min(sizes)
    head = [0.0, 0.1, 0.25, 0.5, 0.75]
    grid = np.unique(np.concatenate([head, np.geomspace(1, max(longest, 1), _TRIED)]))
    shortest = _LATE * (residuals.sample or residuals.step) / residuals.step
    share = _LEAVES_OF_SMALL if residuals.unexplained <= _SMALL else _LEAVES
    return grid, shortest, share, _Rows(residuals)


def _relative(residuals: Residuals, left: float) -> tuple[float, bool]:
    spread = float(stacked(residuals.targets).std())
    return float(np.sqrt(left)) / spread, residuals.unexplained <= _SMALL


def _in_turn(
    rows: _Rows, grid: Array, columns: Sequence[int], start: Mapping[int, float]
) -> dict[int, float]:
    """Delays of all columns, each sought with the others as they are, the best one first."""
    lags = dict(start)

    def best(column: int, tried: Array) -> tuple[float, float]:
        left = rows.left_of_each(lags, column, tried)
        k = int(np.argmin(left))
        return float(left[k]), float(tried[k])

    for _ in range(_ROUNDS):
        before = dict(lags)
        rest = list(columns)
        while rest:
            tried = {c: best(c, grid) for c in rest}
            first = min(rest, key=lambda c: tried[c][0])
            rest.remove(first)
            lags[first] = tried[first][1]
        if lags == before:
            break
    places = {c: int(np.searchsorted(grid, lags[c])) for c in columns}
    for _ in range(2):
        for column, k in places.items():
            around = np.linspace(grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)], 13)
            lags[column] = best(column, around)[1]
    return lags


def _needed(rows: _Rows, lags: Mapping[int, float], ends: tuple[float, float]) -> dict[int, float]:
    """The delays that the others cannot do without, the least needed going first."""
    # At the end of the grid it is no delay that is sought, at its head no delay at all.
    kept = {c: lag for c, lag in lags.items() if ends[0] <= abs(lag) < ends[1]}
    costs = _COSTS * rows.left({})
    while kept:
        left = rows.left(kept)
        without = {c: rows.left({k: v for k, v in kept.items() if k != c}) for c in kept}
        least = min(kept, key=lambda c: without[c])
        if without[least] > max(_DOES_WITHOUT * left, left + costs):
            break
        del kept[least]
    return kept


class _Rows:
    """Variance that a linear fit leaves with some of its inputs late."""

    def __init__(self, residuals: Residuals) -> None:
        self.runs = residuals.inputs
        X, y = stacked(residuals.inputs), stacked(residuals.targets)
        X, y = X - X.mean(axis=0), y - y.mean()
        self.table = np.column_stack([X, y])
        self._shifted: dict[tuple[int, tuple[float, ...]], Array] = {}
        # Products of a column at many lags with all columns, and the lags that these had.
        self._products: dict[tuple[int, tuple[float, ...]], tuple[Array, Array]] = {}
        # Products of all columns with each other, and the lags that they had.
        self._known = b"", np.zeros((0, 0))

    def left(self, lags: Mapping[int, float]) -> float:
        """Variance left, the inputs in some columns being so many intervals late."""
        return self._rest(self._gram(self._lags(lags)))

    def left_of_each(self, lags: Mapping[int, float], column: int, tried: Array) -> Array:
        """Variance left with each of some lags of one column, the others as in `lags`.

        What one column more explains follows from its products with the others and the target
        (Frisch & Waugh 1933).
        """
        now = self._lags(lags)
        products = self._against(column, tried, now)
        others = np.delete(np.arange(self.table.shape[1] - 1), column)
        gram = self._gram(now)
        gram, right, whole = gram[np.ix_(others, others)], gram[others, -1], gram[-1, -1]
        scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        inverse = np.linalg.pinv(gram / np.outer(scale, scale), _RANK, hermitian=True)
        own, right = products[:, others] / scale, right / scale
        by_others = inverse @ right
        size = np.sum(self._late(column, tried) ** 2, axis=1)
        rest = size - np.einsum("li,ij,lj->l", own, inverse, own)
        more = products[:, -1] - own @ by_others
        free = rest > _RANK * size
        gain = np.where(free, more**2 / np.where(free, rest, 1.0), 0.0)
        share = (whole - right @ by_others - gain) / whole
        return np.maximum(share, _ROUNDING) * whole / len(self.table)

    def _lags(self, lags: Mapping[int, float]) -> Array:
        """Of all columns, that of the target included."""
        now = np.zeros(self.table.shape[1])
        now[list(lags)] = list(lags.values())
        return now

    def _against(self, column: int, tried: Array, now: Array) -> Array:
        """Products of a column at some lags with all columns as late as they are."""
        key = column, tuple(tried.tolist())
        late = self._late(column, tried)
        if key not in self._products:
            self._products[key] = late @ self.table, np.zeros(len(now))
        products, before = self._products[key]
        for other in np.flatnonzero(now != before).tolist():
            products[:, other] = late @ self._late(other, now[other : other + 1])[0]
        before[:] = now
        return products

    def _gram(self, now: Array) -> Array:
        """Products of all columns with each other, as late as they are."""
        if self._known[0] != now.tobytes():
            table = self.table.copy()
            for column in np.flatnonzero(now).tolist():
                table[:, column] = self._late(column, now[column : column + 1])[0]
            self._known = now.tobytes(), table.T @ table
        return self._known[1]

    def behind(self, columns: Sequence[int], lag: float) -> float:
        """Variance left, all of some columns being behind a first-order lag."""
        table = self.table.copy()
        some = list(columns)
        lagged = stacked([_lagged(run[:, some], lag) for run in self.runs])
        table[:, some] = lagged - lagged.mean(axis=0)
        return self._rest(table.T @ table)

    def _late(self, column: int, lags: Array) -> Array:
        """An input as late as each of some lags says, ``(lag, sample)``."""
        key = column, tuple(lags.tolist())
        if key not in self._shifted:
            late = [stacked([_shifted(r[:, column], lag) for r in self.runs]) for lag in lags]
            late = np.stack(late)
            self._shifted[key] = late - late.mean(axis=1, keepdims=True)
        return self._shifted[key]

    def _rest(self, gram: Array) -> float:
        scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        gram = gram / np.outer(scale, scale)
        inner, right = gram[:-1, :-1], gram[:-1, -1]
        share = 1 - right @ np.linalg.lstsq(inner, right, rcond=_RANK)[0]
        share = max(float(share), _ROUNDING)
        return share * float(scale[-1]) ** 2 / len(self.table)


def _shifted(values: Array, lag: float) -> Array:
    at = np.arange(len(values))
    return np.interp(at - lag, at, values)


def _lagged(values: Array, lag: float) -> Array:
    """Behind a lag of so many intervals that was at rest, lines in between."""
    if not lag:
        return values
    decay = float(np.exp(-1 / lag))
    held = (1 - decay) * lag
    driving = (held - decay) * values[:-1] + (1 - held) * values[1:]
    bands = np.stack([np.ones(len(values)), np.full(len(values), -decay)])
    return scipy.linalg.solve_banded((1, 0), bands, np.concatenate([values[:1], driving]))


def late_note(row: str, names: Sequence[str], late: LateInputs, unexplained: float) -> str:
    """Which inputs act late, by how much, and what to set."""
    acting, features = _acting(names, late, "late", "delay")
    one = len(late.seconds) == 1
    return (
        f"{row}: {acting}: so delayed {'it leaves' if one else 'they leave'} "
        f"{late.unexplained:.1%} of the row unexplained instead of {unexplained:.1%}, and without "
        f"the delay{'s' * (not one)} the fit takes it for slower dynamics; add the "
        f"feature{'s' * (not one)} {features}"
    )


def early_note(row: str, names: Sequence[str], early: LateInputs, unexplained: float) -> str:
    """Which disturbances act before they are recorded, by how much, and what to set."""
    acting, features = _acting(names, early, "before it is recorded", "lead")
    return (
        f"{row}: {acting}: so advanced {early.unexplained:.1%} of the row is left unexplained "
        f"instead of {unexplained:.1%}; measured behind the plant, or by a late clock, it wants "
        f"the feature{'s' * (len(early.seconds) > 1)} {features}; where its rate acts, one of kind "
        "rate; where it follows from the states it is an output"
    )


def _acting(names: Sequence[str], late: LateInputs, how: str, kind: str) -> tuple[str, str]:
    """Inputs with the seconds by which they act otherwise, and the features that say so."""
    told = [(names[c], f"{abs(s):.3g}") for c, s in late.seconds.items()]
    acting = " and ".join(
        f"'{name}' acts about {s} s {how}" if k == 0 else f"'{name}' about {s} s"
        for k, (name, s) in enumerate(told)
    )
    return acting, ", ".join(f"{{source: {n}, kind: {kind}, seconds: {s}}}" for n, s in told)


def lag_note(row: str, state: str, order: int, lag: Lag, unexplained: float) -> str:
    """That a row wants an order more, and what to set."""
    cure = (
        f"set {{name: {state}, order: 2}} among signals.states"
        if order == 1
        else "record what is in between (what an actuator does, not what it is told) and make it a "
        "state; for a disturbance a feature of kind lag may do"
    )
    return (
        f"{row}: all that acts on it acts through a lag of about {lag.seconds:.3g} s, which leaves "
        f"{lag.unexplained:.1%} of the row unexplained instead of {unexplained:.1%}: something in "
        f"between is missing, as an actuator or an inertia, and its coefficients are wrong; {cure}"
    )

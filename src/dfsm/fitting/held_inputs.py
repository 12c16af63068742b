"""Inputs that are held although they change at every sample: only the states can tell.

A state at the next sample follows from what a held input was since the last one, and not from what
it is by then; an input that goes on in lines acts with both. So states are regressed on the two
samples before them and on the inputs before, now and then: a held input has no effect "then".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array, IntArray

# Share of its standard deviation by which an input bends from sample to sample that is rough.
_ROUGH = 0.5
# Largest effect "then", with two of its standard errors, relative to that "now". Joined by lines it
# is a quarter or more.
_NONE = 0.1
# Largest effect of a smooth input before, likewise: a held one has none where all states are
# recorded, and the same one as now where the rate of a state is not. Of an input that is joined by
# lines and late by a sample both are alike, or that before is four times that now.
_BEFORE, _BEFORE_WITHOUT_RATES = 0.1, 1.5
# Samples per effect, and the share of the largest direction below which there is none.
_FEWEST, _SINGULAR = 10, 1e-12


def held_unseen(
    runs: Callable[[], Iterable[tuple[Array, Array]]],
    complete: bool = False,
    known: Sequence[int] = (),
) -> list[int]:
    """Columns of the inputs that act as held ones.

    Parameters
    ----------
    runs
        Equidistant samples of the states and of the inputs of every run, ``(sample, state)`` and
        ``(sample, input)``; called for each pass over them, which holds one run at a time.
    complete
        Whether the states hold all that the next ones follow from: rates of those of order 2, too.
    known
        Columns that are held for certain, and act now only. What a set-point was before and is then
        would tell, with what its controller sets, the very state that this answers.
    """
    bends, spread = _bends_and_spread(inputs for _, inputs in runs())
    moving = spread > 0
    moving[list(known)] = False
    rough = moving & (bends > _ROUGH * spread)
    found = []
    # A smooth input tells little, and only beside all others; of it more is asked.
    for columns, past in ((rough, True), (moving, not complete)):
        if (
            columns.any()
            and (told := _effects(runs, np.flatnonzero(columns), known, past)) is not None
        ):
            found += [
                column
                for column, effect in zip(np.flatnonzero(columns).tolist(), told, strict=True)
                if effect.held and (rough[column] or effect.alone(complete))
            ]
    return sorted(set(found))


@dataclass(frozen=True)
class _Effect:
    """What an input does then, now and before to the state that tells most, with errors."""

    then: float
    now: float
    before: float
    errors: tuple[float, float, float]

    @property
    def held(self) -> bool:
        then, now, _ = self.errors
        small = _NONE * self.now
        return self.then + 2 * then < small and 2 * now < small

    def alone(self, complete: bool) -> bool:
        most = _BEFORE if complete else _BEFORE_WITHOUT_RATES
        return self.before + 2 * self.errors[2] < most * self.now


def _effects(
    runs: Callable[[], Iterable[tuple[Array, Array]]],
    columns: IntArray,
    known: Sequence[int],
    past: bool,
) -> list[_Effect] | None:
    """Effects of some inputs on the next states; None of too few samples."""
    count, largest = 0, np.zeros(0)
    for X, _ in _before_and_after(runs(), columns, known, past):
        most = np.abs(X).max(axis=0)
        largest, count = np.maximum(largest, most) if count else most, count + len(X)
    width = len(largest)
    if count < _FEWEST * width:
        return None
    largest = np.maximum(largest, np.finfo(float).tiny)
    # Triangles instead of products, whose rounding is that of squares: smooth inputs are alike.
    R = np.zeros((0, 0))
    for X, y in _before_and_after(runs(), columns, known, past):
        block = np.hstack([X / largest, y])
        R = np.asarray(np.linalg.qr(np.vstack([R, block]) if len(R) else block, mode="r"))
    left_side, right = R[:width, :width], R[:width, width:]
    U, sizes, V = np.linalg.svd(left_side)
    kept = sizes > _SINGULAR * sizes[0]
    inverse = (V[kept].T / sizes[kept]) @ U[:, kept].T
    effects = inverse @ right
    left = (
        np.sum((right - left_side @ effects) ** 2, 0) + np.sum(R[width:, width:] ** 2, 0)
    ) / count
    errors = np.sqrt(np.outer(np.sum(inverse**2, axis=1), left))
    many, found = len(columns), []
    for k in range(many):
        rows = k, many + k, 2 * many + k
        best = int(np.argmax(np.abs(effects[rows[1]]) / np.maximum(errors[rows[1]], 1e-300)))
        then, now, before = (float(np.abs(effects[row, best])) for row in rows)
        a, b, c = (float(errors[row, best]) for row in rows)
        found.append(_Effect(then, now, before, (a, b, c)))
    return found


def _bends_and_spread(runs: Iterable[Array]) -> tuple[Array, Array]:
    """Root mean squares of second differences and standard deviations, ``(input,)``, over runs."""
    figures = [
        (len(v), v.mean(axis=0), v.var(axis=0), np.sum(np.diff(v, 2, axis=0) ** 2, axis=0))
        for v in runs
    ]
    counts, means, variances, squares = (np.array(part) for part in zip(*figures, strict=True))
    share = counts / counts.sum()
    variance = share @ (variances + (means - share @ means) ** 2)
    return np.sqrt(squares.sum(axis=0) / max(np.sum(counts - 2), 1)), np.sqrt(variance)


def _before_and_after(
    runs: Iterable[tuple[Array, Array]], columns: IntArray, known: Sequence[int], past: bool
) -> Iterator[tuple[Array, Array]]:
    """What may act on the next state, "then", "now" and "before" first, and that state, by run."""
    for states, inputs in runs:
        if len(inputs) < 3:
            continue
        some, rest = inputs[:, columns], np.delete(inputs, columns, axis=1)
        lines = np.delete(inputs, [*columns, *known], axis=1)
        before = rest if past else lines
        acting = [some[2:], some[1:-1], some[:-2], lines[2:], rest[1:-1], before[:-2]]
        stood = [states[1:-1], states[:-2]] if past else [states[1:-1]]
        yield np.column_stack([*acting, *stood, np.ones(len(some) - 2)]), states[2:]


def held_note(name: str) -> str:
    """What to set for such an input."""
    return (
        f"'{name}' acts as if it were held from sample to sample, since what it is at the next one "
        "has no effect until then, but is joined by straight lines, which makes its effect wrong: "
        f"set inputs: {{{name}: hold}} (linear to leave it so)"
    )

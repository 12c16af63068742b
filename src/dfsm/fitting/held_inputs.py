"""Inputs that are held although they change at every sample: only the states can tell.

A state at the next sample follows from what a held input was since the last one, and not from what
it is by then; an input that goes on in lines acts with both. So states are regressed on the two
samples before them and on the inputs before, now and then: a held input has no effect "then".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from dfsm.core.types import Array, IntArray

# Share of its standard deviation by which an input must bend from sample to sample to tell.
_ROUGH = 0.5
# Largest effect "then", with two of its standard errors, relative to that "now". Joined by lines it
# is a quarter or more.
_NONE = 0.1
_FEWEST = 10


def held_unseen(runs: Callable[[], Iterable[tuple[Array, Array]]]) -> list[int]:
    """Columns of the inputs that act as held ones.

    Parameters
    ----------
    runs
        Equidistant samples of the states and of the inputs of every run, ``(sample, state)`` and
        ``(sample, input)``; called for each pass over them, which holds one run at a time.
    """
    bends, spread = _bends_and_spread(inputs for _, inputs in runs())
    columns = np.flatnonzero((bends > _ROUGH * spread) & (spread > 0))
    if not len(columns):
        return []
    count, largest = 0, np.zeros(0)
    for X, _ in _before_and_after(runs(), columns):
        most = np.abs(X).max(axis=0)
        largest, count = np.maximum(largest, most) if count else most, count + len(X)
    if count < _FEWEST * len(largest):
        return []
    largest = np.maximum(largest, np.finfo(float).tiny)
    products, with_next = 0.0, 0.0
    for X, y in _before_and_after(runs(), columns):
        products, with_next = products + (X / largest).T @ (X / largest), with_next + X.T @ y
    inverse = np.linalg.pinv(products, hermitian=True)
    effects = inverse @ (with_next / largest[:, None])
    squares = [
        np.sum((y - X / largest @ effects) ** 2, axis=0)
        for X, y in _before_and_after(runs(), columns)
    ]
    # Bounded below: of a fit without residual the rounding decides.
    left = np.sum(squares, axis=0) / count
    errors = np.sqrt(np.maximum(np.outer(np.diag(inverse), left), 0.0))
    found, after = [], len(columns)
    for k, column in enumerate(columns.tolist()):
        now = after + k
        best = int(np.argmax(np.abs(effects[now]) / np.maximum(errors[now], 1e-300)))
        most = np.abs(effects[now, best])
        later = np.abs(effects[k, best]) + 2 * errors[k, best]
        if later < _NONE * most and 2 * errors[now, best] < _NONE * most:
            found.append(column)
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
    runs: Iterable[tuple[Array, Array]], columns: IntArray
) -> Iterator[tuple[Array, Array]]:
    """What may act on the next state, "then" and "now" first, and that state, run by run."""
    for states, inputs in runs:
        if len(inputs) < 3:
            continue
        x, u, rest = states[1:-1], inputs[1:-1], np.delete(inputs, columns, axis=1)
        past = [x, states[:-2], inputs[:-2], rest[1:-1], rest[2:], np.ones(len(x))]
        yield np.column_stack([inputs[2:, columns], u[:, columns], *past]), states[2:]


def held_note(name: str) -> str:
    """What to set for such an input."""
    return (
        f"'{name}' acts as if it were held from sample to sample, since what it is at the next one "
        "has no effect until then, but is joined by straight lines, which makes its effect wrong: "
        f"set inputs: {{{name}: hold}} (linear to leave it so)"
    )

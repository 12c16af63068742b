"""Inputs that are held although they change at every sample: only the states can tell.

A state at the next sample follows from what a held input was since the last one, and not from what
it is by then; an input that goes on in lines acts with both. So states are regressed on the two
samples before them and on the inputs before, now and then: a held input has no effect "then".
"""

from __future__ import annotations

import numpy as np

from dfsm.core.types import Array, IntArray

# Share of its standard deviation by which an input must bend from sample to sample to tell.
_ROUGH = 0.5
# Largest effect "then", with two of its standard errors, relative to that "now". Joined by lines it
# is a quarter or more.
_NONE = 0.1
_FEWEST = 10


def held_unseen(states: Array, inputs: Array, runs: IntArray) -> list[int]:
    """Columns of the inputs that act as held ones.

    Parameters
    ----------
    states, inputs
        Equidistant samples, ``(sample, state)`` and ``(sample, input)``.
    runs
        Run of every sample.
    """
    within = runs[2:] == runs[:-2]
    bends = np.array([np.sqrt(np.mean(np.diff(v, 2)[within] ** 2)) for v in inputs.T])
    spread = np.array([v.std() for v in inputs.T])
    columns = np.flatnonzero((bends > _ROUGH * spread) & (spread > 0))
    rows = np.flatnonzero(runs[2:] == runs[:-2]) + 1
    count = len(columns)
    width = 2 * states.shape[1] + 2 * inputs.shape[1] + count + 1
    if not count or len(rows) < _FEWEST * width:
        return []
    now, then = inputs[rows][:, columns], inputs[rows + 1][:, columns]
    rest = np.delete(inputs, columns, axis=1)
    past = [states[rows], states[rows - 1], inputs[rows - 1], rest[rows], rest[rows + 1]]
    X = np.column_stack([then, now, *past, np.ones(len(rows))])
    X, y = X / np.maximum(np.abs(X).max(axis=0), np.finfo(float).tiny), states[rows + 1]
    inverse = np.linalg.pinv(X.T @ X, hermitian=True)
    effects = inverse @ (X.T @ y)
    left = np.mean((y - X @ effects) ** 2, axis=0)
    # Bounded below: of a fit without residual the rounding decides.
    errors = np.sqrt(np.maximum(np.outer(np.diag(inverse), left), 0.0))
    found = []
    for k, column in enumerate(columns.tolist()):
        best = int(np.argmax(np.abs(effects[count + k]) / np.maximum(errors[count + k], 1e-300)))
        most = np.abs(effects[count + k, best])
        later = np.abs(effects[k, best]) + 2 * errors[k, best]
        if later < _NONE * most and 2 * errors[count + k, best] < _NONE * most:
            found.append(column)
    return found


def held_note(name: str) -> str:
    """What to set for such an input."""
    return (
        f"'{name}' acts as if it were held from sample to sample, since what it is at the next one "
        "has no effect until then, but is joined by straight lines, which makes its effect wrong: "
        f"set inputs: {{{name}: hold}} (linear to leave it so)"
    )

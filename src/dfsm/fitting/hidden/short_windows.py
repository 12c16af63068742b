"""States at the starts of windows, and rollouts over short windows before long ones.

The error of a long rollout has no slope that leads anywhere where the equation is far from right:
what is nonlinear then runs away, or beats against the record. Over a few dozen samples, from states
that are free, every start does something sensible. So parameters learn there first, and windows
grow: multiple shooting, of which the pieces are joined at last (Bock 1983; for training Ribeiro,
Tiels, Umenberger, Schön & Aguirre 2020, "On the smoothness of nonlinear system identification").
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dfsm.core.types import Array
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.sensors import behind
from dfsm.fitting.hidden.starts import improved
from dfsm.fitting.hidden.windows import Windows

# Samples of the short windows, and the steps over each.
_STAGES = ((20, 20), (40, 10), (100, 10), (300, 10))
# Samples that tell the state at the start of a window, and steps towards it.
_HEAD, _STEPS = 100, 12


def from_short_windows(form: Form, weights: Array, windows: Windows, decay: float) -> Array:
    """Weights that rollouts over ever longer windows have improved.

    Parameters
    ----------
    form
        The equation.
    weights
        Where to begin, states at the starts of `windows` included.
    windows
        Records; what is left out of them stays unseen.
    decay
        See `HiddenSettings`.
    """
    p, paths = weights[: form.size], HiddenError(form, windows).paths(weights)
    for length, steps in _STAGES:
        pieces = windows.pieces(length)
        if len(pieces.y) <= len(windows.y):
            break
        window, sample = pieces.first.T
        starts = starts_of(form, p, pieces, [paths[window, sample]])
        found = improved(form, pieces, np.concatenate([p, starts.ravel()]), decay, steps)
        p = found.parameters
        along = HiddenError(form, pieces).paths(found.weights)
        for states, i, a in zip(along, window, sample, strict=True):
            paths[i, a : a + len(states)] = states[: paths.shape[1] - a]
    return np.concatenate([p, paths[:, 0].ravel()])


def starts_of(
    form: Form, parameters: Array, windows: Windows, tried: Iterable[Array] = ()
) -> Array:
    """States at the starts of windows that meet the first samples of each best.

    Parameters
    ----------
    form, parameters
        The equation.
    windows
        Records.
    tried
        States to begin from, ``(window, state)`` each, beside those that outputs tell.

    Returns
    -------
    Array
        Shape ``(window, state)``.
    """
    heads = windows.heads(_HEAD)
    begun = list(tried)
    for first in behind(form, parameters, windows.y[:, 0]):
        starts = np.zeros((len(first), form.states))
        starts[:, : form.outputs] = first
        begun.append(starts)
    found, errors = [], []
    for starts in begun:
        weights = _started(form, np.concatenate([parameters, starts.ravel()]), heads)
        apart = (HiddenError(form, heads).outputs(weights) - heads.y) * heads.used[..., None]
        found.append(weights[form.size :].reshape(-1, form.states))
        errors.append(np.sum(apart**2, axis=(1, 2)))
    least = np.argmin(errors, axis=0)
    return np.array(found)[least, np.arange(len(least))]


def _started(form: Form, weights: Array, windows: Windows) -> Array:
    """Weights whose states at the starts of windows fit these best, by damped Gauss-Newton."""
    error = HiddenError(form, windows)
    p, n = form.size, form.states
    before = error.cost(weights)
    for _ in range(_STEPS):
        JtJ, Jtr = error.normal_equations(weights)
        change = np.zeros_like(weights)
        for i in range(len(windows.y)):
            at = slice(p + n * i, p + n * (i + 1))
            own = JtJ[at, at]
            damping = 1e-3 + 1e-9 * np.trace(own)
            change[at] = -np.linalg.solve(own + damping * np.eye(n), Jtr[at])
        trial = weights + np.clip(change, -2, 2)
        after = error.cost(trial)
        if not after < before * (1 - 1e-6):
            break
        weights, before = trial, after
    return weights

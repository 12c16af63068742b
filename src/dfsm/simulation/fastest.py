"""How fast a model's states may move along a run, and what steps of RK4 that allows.

Classical Runge-Kutta steps of h follow a mode of eigenvalue λ while h |λ| is small; beyond 2.8 they
grow whatever the model does. A model that is fine may thus be called unstable for its step alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from dfsm.core.types import Array
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel

# Largest h |λ|: half of what is stable, where a mode is still followed and over in a few steps.
REACH = 1.5
# Samples of the inputs of a run at which a model is looked at.
_PLACES = 16
# Places that are looked at together: numbers that are compiled for.
_AT_ONCE = (16, 128, 1024)


def fastest_rates(model: DFSM, runs: Sequence[Array]) -> list[float]:
    """Largest absolute eigenvalue of ∂f̂/∂ξ along each run, in 1/s, but for modes that grow.

    What grows as fast as it moves leaves the data whatever the step is.

    Parameters
    ----------
    model
        The whole model, with its correction.
    runs
        Controls, disturbances and parameters along each, ``(time, exogenous)``. The states are
        not known before the rollout: those that are usual under the same schedule stand for them.

    Returns
    -------
    list of float
        0 where nothing is to be said.
    """
    some = [v[np.unique(np.linspace(0, len(v) - 1, _PLACES).astype(int))] for v in runs]
    begins = np.cumsum([0] + [len(v) for v in some[:-1]])
    fastest = _fastest(_matrices(model, np.concatenate(some)))
    # A run of which one place cannot be told is not told of at all.
    rates = np.maximum.reduceat(fastest, begins)
    return np.where(np.isnan(rates), 0.0, rates).tolist()


def _fastest(A: Array) -> Array:
    """Of matrices ``(place, state, state)``, one each; NaN where one is not finite."""
    finite = np.asarray(np.isfinite(A).all(axis=(1, 2)))
    values = np.linalg.eigvals(np.where(finite[:, None, None], A, 0.0))
    size = np.abs(values)
    fastest = np.where(values.real < size / 2, size, 0.0).max(axis=1, initial=0.0)
    return np.where(finite, fastest, np.nan)


def _matrices(model: DFSM, inputs: Array) -> Array:
    """∂f̂/∂ξ at exogenous inputs ``(place, exogenous)``, ``(place, state, state)``."""
    s = model.signals
    # In NumPy, but for what the model computes: each operation of JAX would be compiled.
    at = np.zeros((len(inputs), len(s.inputs)))
    at[:, s.order.driving_columns] = inputs[:, : len(s.driving)]
    at[:, s.order.columns("parameters")] = inputs[:, len(s.driving) :]
    column = model.f.schedule
    scheduled_by_state = column is not None and column in range(len(s.inputs))[s.state_columns]
    if model.e is None and model.terms is None and not scheduled_by_state:
        value = np.zeros(len(inputs)) if column is None else at[:, column]
        return _linear_fits(model.f, value)[:, :, s.state_columns]
    parts = []
    while len(at):
        size = next((n for n in _AT_ONCE if n >= len(at)), _AT_ONCE[-1])
        now, at = at[:size], at[size:]
        wide = np.concatenate([now, np.repeat(now[-1:], size - len(now), axis=0)])
        x = model.region.usual(wide[:, model.region.schedule or 0])[:, s.state_columns]
        u, w, p = (wide[:, s.order.columns(g)] for g in ("controls", "disturbances", "parameters"))
        parts.append(np.asarray(_state_matrices(model, x, u, w, p))[: len(now)])
    return np.concatenate(parts)


def _linear_fits(f: LinearModel, value: Array) -> Array:
    """L of a linear fit at schedule values ``(place,)``, ``(place, target, input)``."""
    grid, L = np.asarray(f.grid), np.asarray(f.coefficients)
    if f.schedule is None:
        return np.broadcast_to(L, (len(value), *L.shape[1:]))
    value = np.clip(value, grid[0], grid[-1])
    i = np.clip(np.searchsorted(grid, value, side="right") - 1, 0, len(grid) - 2)
    t = ((value - grid[i]) / (grid[i + 1] - grid[i]))[:, None, None]
    return (1 - t) * L[i] + t * L[i + 1]


@eqx.filter_jit
def _state_matrices(model: DFSM, x: Array, u: Array, w: Array, p: Array) -> jax.Array:
    """∂f̂/∂ξ at some places, ``(place, state, state)``."""
    model = model.prepared()
    slope = jax.jacfwd(model.derivative)
    return jax.vmap(slope)(x, u, w, p)

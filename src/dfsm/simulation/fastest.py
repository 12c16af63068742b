"""How fast a model's states may move along a run, and what steps of RK4 that allows.

Classical Runge-Kutta steps of h follow a mode of eigenvalue λ while h |λ| is small; beyond 2.8 they
grow whatever the model does. A model that is fine may thus be called unstable for its step alone.
"""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np

from dfsm.core.types import Array
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region

# Largest h |λ|: half of what is stable, where a mode is still followed and over in a few steps.
REACH = 1.5
# Samples of the inputs of a run at which a model is looked at.
_PLACES = 16


def fastest_rate(model: DFSM, inputs: Array) -> float:
    """Largest absolute eigenvalue of ∂f̂/∂ξ along a run, in 1/s, but for modes that grow.

    What grows as fast as it moves leaves the data whatever the step is.

    Parameters
    ----------
    model
        The whole model, with its correction.
    inputs
        Controls, disturbances and parameters along the run, ``(time, exogenous)``. The states are
        not known before the rollout: those that are usual under the same schedule stand for them.

    Returns
    -------
    float
        0 where nothing is to be said.
    """
    s = model.signals
    some = inputs[np.unique(np.linspace(0, len(inputs) - 1, _PLACES).astype(int))]
    # In NumPy, but for what the model computes: each operation of JAX would be compiled.
    at = np.zeros((len(some), len(s.inputs)))
    at[:, s.order.driving_columns] = some[:, : len(s.driving)]
    at[:, s.order.columns("parameters")] = some[:, len(s.driving) :]
    column = model.f.schedule
    scheduled_by_state = column is not None and column in range(len(s.inputs))[s.state_columns]
    if model.e is None and model.terms is None and not scheduled_by_state:
        value = np.zeros(len(some)) if column is None else at[:, column]
        A = _linear_fits(model.f, value)[:, :, s.state_columns]
    else:
        x = _usual(model.region, at)[:, s.state_columns]
        u, w, p = (at[:, s.order.columns(g)] for g in ("controls", "disturbances", "parameters"))
        A = np.asarray(_state_matrices(model, x, u, w, p))
    if not np.isfinite(A).all():
        return 0.0
    values = np.linalg.eigvals(A)
    size = np.abs(values)
    return float(size[values.real < size / 2].max(initial=0.0))


def _linear_fits(f: LinearModel, value: Array) -> Array:
    """L of a linear fit at schedule values ``(place,)``, ``(place, target, input)``."""
    grid, L = np.asarray(f.grid), np.asarray(f.coefficients)
    if f.schedule is None:
        return L
    value = np.clip(value, grid[0], grid[-1])
    i = np.clip(np.searchsorted(grid, value, side="right") - 1, 0, len(grid) - 2)
    t = ((value - grid[i]) / (grid[i + 1] - grid[i]))[:, None, None]
    return (1 - t) * L[i] + t * L[i + 1]


def _usual(region: Region, inputs: Array) -> Array:
    """Mean inputs of the training data at the schedule of some, ``(place, input)``."""
    grid, operating = np.asarray(region.grid), np.asarray(region.operating)
    value = inputs[:, region.schedule or 0]
    return np.stack([np.interp(value, grid, column) for column in operating.T], axis=1)


@eqx.filter_jit
def _state_matrices(model: DFSM, x: Array, u: Array, w: Array, p: Array) -> jax.Array:
    """∂f̂/∂ξ at some places, ``(place, state, state)``."""
    model = model.prepared()
    slope = jax.jacfwd(model.derivative)
    return jax.vmap(slope)(x, u, w, p)

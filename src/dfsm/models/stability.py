"""Stability with the schedule frozen: eigenvalues of A at and between schedule points."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import eig

from dfsm.core.types import Array, ComplexArray
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import at_rest

# Between two schedule points A is a mixture of theirs; that many mixtures are examined.
_MIXTURES = 9
# Cosine between left and right eigenvectors below which eigenvalues count as shared: eigenvalues
# that rounding has split lie its root apart.
_DEFECTIVE = float(np.sqrt(np.finfo(float).eps))
# A corrective function is examined at so many places from one operating point to the next.
_PLACES = 4


def fastest_growth(A: Array) -> float:
    """Largest real part in 1/s of the eigenvalues at all schedule values, each frozen.

    Parameters
    ----------
    A
        Of a linear model at its schedule points, shape ``(point, state, state)``.
    """
    at_points = max(float(np.linalg.eigvals(a).real.max()) for a in A)
    return max([at_points, *(growth_between(a, b) for a, b in pairwise(A))])


def growth_between(A: Array, B: Array) -> float:
    """Largest real part of the eigenvalues of mixtures of two matrices."""
    shares = np.linspace(0, 1, _MIXTURES + 2)[1:-1, None, None]
    return float(np.linalg.eigvals((1 - shares) * A + shares * B).real.max())


def eigen(A: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Eigenvalues with left and right eigenvectors, from which their slopes follow.

    dλ = wᴴ dA v with wᴴ v = 1. Where eigenvalues meet and share one eigenvector, as those of a
    double integrator do, wᴴ v = 0: they move like a root of the change, and have no slope. There,
    and as near to it as rounding can tell, w stops growing: a large but finite slope along the
    change that splits them.

    Parameters
    ----------
    A
        Shape ``(state, state)``.

    Returns
    -------
    tuple of ndarray
        λ, shape ``(state,)``, and w and v as rows, ``(state, state)``.
    """
    solution: Any = eig(A, left=True, right=True)
    eigenvalues, left, right = solution[0], solution[1].T, solution[2].T
    # Cosine of the angle between vectors of length one: the eigenvalue's reciprocal condition.
    cosine = np.sum(left.conj() * right, axis=1)
    size = np.abs(cosine)
    phase = np.where(size > 0, cosine, 1.0) / np.where(size > 0, size, 1.0)
    scale = phase * np.maximum(size, _DEFECTIVE)
    return eigenvalues, left / scale.conj()[:, None], right


def destabilised(model: DFSM) -> str | None:
    """Tell whether the corrective function makes an operating point, or one between two, unstable.

    Parameters
    ----------
    model
        Its linear fit is stable.

    Returns
    -------
    str or None
        What would go wrong, for the user; None where nothing does.
    """
    if model.e is None:
        return None
    grid, points = operating_points(model)
    growth = np.linalg.eigvals(state_matrices(model, points)).real.max(axis=1)
    worst = int(np.argmax(growth))
    if growth[worst] <= 0:
        return None
    place = f" at {model.schedule} = {grid[worst]:.4g}" if model.schedule else ""
    return f"with a correction the model would be unstable{place} (growth {growth[worst]:.2g} 1/s)"


def state_matrices(model: DFSM, points: Array) -> Array:
    """A at inputs ``(point, input)`` with latent states at rest, ``(point, state, state)``."""
    return np.asarray(_state_matrices(model, jnp.asarray(points)))


@eqx.filter_jit
def _state_matrices(model: DFSM, points: jax.Array) -> jax.Array:
    def at_point(inputs: jax.Array) -> jax.Array:
        x, *others = model.split(at_rest(model, inputs))
        return jax.jacfwd(lambda x: model.derivative(x, *others))(x)

    return jax.vmap(at_point)(points)


def operating_points(model: DFSM) -> tuple[Array, Array]:
    """Schedule values ``(point,)`` and inputs ``(point, input)`` where stability is looked at."""
    grid, operating = np.asarray(model.region.grid), np.asarray(model.region.operating)
    places = np.arange((len(grid) - 1) * _PLACES + 1) / _PLACES
    table = np.column_stack([grid, operating]).T
    points = np.stack([np.interp(places, np.arange(len(grid)), row) for row in table], axis=1)
    return points[:, 0], points[:, 1:]

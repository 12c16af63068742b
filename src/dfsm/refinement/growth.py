"""Keeps a model stable while refinement changes it: a wall, and a slope before it.

Least squares alone walks into the wall and stays there. From a margin on, growth at the operating
points therefore adds to the sum of squares, with the exact gradient of each point's fastest
eigenvalue, dλ = wᴴ dA v.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array, ComplexArray
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import at_rest
from dfsm.models.stability import eigen, fastest_growth, operating_points, state_matrices
from dfsm.refinement.parameters import Parametrization

# Growth in 1/s that adds nothing yet.
_MARGIN = 0.005
# The share of a rollout error as wrong as a constant that growth of one margin more adds.
_SHARE = 0.01


class StabilityKept:
    """What growth adds to a sum of squares; infinite where a model is unstable.

    Stable means with the schedule frozen: a linear model must be so at all schedule values, one
    with a corrective function at the operating points and between them. A start that
    is unstable, and meant to be, is left alone.

    Parameters
    ----------
    parameters
        Of the model; the start is at zero.
    samples
        Number of terms in the sum of squares.
    """

    def __init__(self, parameters: Parametrization, samples: int) -> None:
        self._parameters = parameters
        self._points = operating_points(parameters.model)[1]
        self._weight = np.sqrt(_SHARE * samples) / _MARGIN
        self._idle = False
        self._idle = not np.isfinite(self.cost(np.zeros(parameters.size)))

    def cost(self, weights: Array) -> float:
        """Sum of squares, infinite where the model is unstable."""
        if self._idle:
            return 0.0
        model, worst = self._parameters.at(from_host(weights)), -np.inf
        growth = self._eigen(model)[0]
        if model.e is None and model.terms is None:
            worst = fastest_growth(model.linear_state_matrices())
        if max(worst, growth.max()) > 0:
            return np.inf
        return float(np.sum(self._excess(growth) ** 2))

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ and Jᵀr."""
        if self._idle:
            return np.zeros((len(weights), len(weights))), np.zeros(len(weights))
        growth, left, right = self._eigen(self._parameters.at(from_host(weights)))
        r = self._excess(growth)
        vectors = from_host(left), from_host(right)
        slopes = _slopes(self._parameters, from_host(weights), from_host(self._points), *vectors)
        J = np.where(r > 0, self._weight, 0.0)[:, None] * np.asarray(slopes)
        return J.T @ J, J.T @ r

    def _excess(self, growth: Array) -> Array:
        return self._weight * np.maximum(growth + _MARGIN, 0.0)

    def _eigen(self, model: DFSM) -> tuple[Array, ComplexArray, ComplexArray]:
        """Fastest growth at every point, and the eigenvectors to it, scaled so that wᴴ v = 1."""
        growth, left, right = [], [], []
        for values, w, v in map(eigen, state_matrices(model, self._points)):
            k = int(np.argmax(values.real))
            growth.append(values[k].real)
            left.append(w[k])
            right.append(v[k])
        return np.array(growth), np.array(left), np.array(right)


@eqx.filter_jit
def _slopes(
    parameters: Parametrization,
    weights: jax.Array,
    points: jax.Array,
    left: jax.Array,
    right: jax.Array,
) -> jax.Array:
    """Slopes of the eigenvalues' real parts, shape ``(point, parameter)``."""

    def real_part(
        weights: jax.Array, inputs: jax.Array, left: jax.Array, right: jax.Array
    ) -> jax.Array:
        model = parameters.at(weights)
        x, *others = model.split(at_rest(model, inputs))
        turn = lambda v: jax.jvp(lambda x: model.derivative(x, *others), (x,), (v,))[1]  # noqa: E731
        return jnp.real(jnp.conj(left) @ (turn(right.real) + 1j * turn(right.imag)))

    return jax.vmap(jax.grad(real_part), (None, 0, 0, 0))(weights, points, left, right)

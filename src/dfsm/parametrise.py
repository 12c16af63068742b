"""The numbers of a model that refinement may change, as one well-scaled vector.

The vector holds deviations from the model that it was made of, so zero is that model. Coefficients
are scaled by what their input and their row typically are: a unit deviation of any of them changes
a derivative by about its own spread.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.corrective.functions import Corrective, GaussianUnits, Perceptron
from dfsm.derivatives import kinematic_rows
from dfsm.model import DFSM
from dfsm.types import Array, IntArray


@dataclass(frozen=True)
class Parametrisation:
    """Deviations from a model, and the model that they make.

    Attributes
    ----------
    model
        The model at zero.
    rows
        Rows of the linear fit that are not kinematic.
    spread
        Typical size of each of these derivatives, shape ``(row,)``, in its unit.
    """

    model: DFSM
    rows: IntArray
    spread: Array

    @classmethod
    def of(cls, model: DFSM, spread: Array) -> Parametrisation:
        """Make one; `spread` holds the typical size of every state derivative, ``(state,)``."""
        known = kinematic_rows(model.signals.specs)
        rows = np.array([i for i in range(len(model.signals.states)) if i not in known])
        return cls(model, rows, np.maximum(spread[rows], np.finfo(float).tiny))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(int(np.prod(shape)) for shape in self._shapes)

    @property
    def _shapes(self) -> list[tuple[int, ...]]:
        points, _, inputs = self.model.f.coefficients.shape
        return [(points, len(self.rows), inputs + 1), *self._corrective_shapes]

    @property
    def _corrective_shapes(self) -> list[tuple[int, ...]]:
        e = self.model.e
        if isinstance(e, GaussianUnits):
            return [e.weights.shape, e.bias.shape]
        if isinstance(e, Perceptron):
            return [a.shape for a in (*e.weights, *e.biases)]
        return []

    def at(self, deviations: jax.Array) -> DFSM:
        """The model at some deviations, shape ``(parameter,)``; JAX can follow it."""
        parts, start = [], 0
        for shape in self._shapes:
            count = int(np.prod(shape))
            parts.append(deviations[start : start + count].reshape(shape))
            start += count
        f, region = self.model.f, self.model.region
        std = jnp.where(region.std > 0, region.std, 1.0)
        change = parts[0] * self.spread[:, None]
        L = change[..., :-1] / std
        # The offset belongs to the middle of the data, where coefficients do not disturb it.
        b = change[..., -1] - L @ region.mean
        f = replace(
            f,
            coefficients=f.coefficients.at[:, self.rows].add(L),
            offsets=f.offsets.at[:, self.rows].add(b),
        )
        return replace(self.model, f=f, e=self._corrective(parts[1:]))

    def _corrective(self, parts: list[jax.Array]) -> Corrective | None:
        e = self.model.e
        if e is None:
            return None
        place = {row: k for k, row in enumerate(self.rows)}
        scale = jnp.asarray([self.spread[place[row]] for row in self.model.corrected])
        if isinstance(e, GaussianUnits):
            weights, bias = parts
            return replace(
                e, weights=e.weights + scale[:, None] * weights, bias=e.bias + scale * bias
            )
        n = len(e.weights)
        weights = [*parts[: n - 1], scale[:, None] * parts[n - 1]]
        biases = [*parts[n:-1], scale * parts[-1]]
        return replace(
            e,
            weights=tuple(a + b for a, b in zip(e.weights, weights, strict=True)),
            biases=tuple(a + b for a, b in zip(e.biases, biases, strict=True)),
        )

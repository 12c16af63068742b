"""Polynomials: they go on beyond the data as springs and drags do, and are linear in their weights.

Paduart et al. 2010, "Identification of nonlinear systems using polynomial nonlinear state space
models", Automatica 46(4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations_with_replacement
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.models.corrective.form import Corrective

# Beyond as many standard deviations from its middle, an input counts as if it were there, unless a
# fit says where its data ended: nothing that was recorded tells how a polynomial goes on.
REACH = 4.0


def monomials(inputs: int, degree: int) -> tuple[tuple[int, ...], ...]:
    """Columns that each product of two to `degree` inputs takes, an input several times if need be.

    Products of fewer than `degree` inputs are filled up with the column `inputs`, which is one.
    """
    return tuple(
        (*columns, *(inputs,) * (degree - order))
        for order in range(2, degree + 1)
        for columns in combinations_with_replacement(range(inputs), order)
    )


def products(z: jax.Array, factors: Sequence[Sequence[int]]) -> jax.Array:
    """Values of monomials, ``(monomial,)``, of inputs ``(input,)``; see `monomials`."""
    return jnp.prod(jnp.append(z, 1.0)[np.array(factors, dtype=int)], axis=1)


class Polynomial(Corrective):
    """Monomials of standardised inputs.

    Attributes
    ----------
    weights
        Of each monomial in each target, in the target's unit, shape ``(target, monomial)``.
    factors
        Columns that each monomial multiplies; the number of inputs stands for one.
    reach
        Standard deviations beyond which an input counts as if it were there.
    """

    kind = "polynomial"
    weights: jax.Array
    factors: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    reach: float = eqx.field(static=True, default=REACH)

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Evaluate at one input vector, shape ``(input,)`` to ``(target,)``."""
        z = jnp.clip((inputs - self.shift) / self.scale, -self.reach, self.reach)
        return self.weights @ products(z, self.factors)

    def select(self, rows: Sequence[int]) -> Polynomial:
        """Keep some of the targets."""
        return replace(self, weights=from_host(np.asarray(self.weights)[np.array(rows)]))

    def with_more_inputs(self, at: int, count: int) -> Polynomial:
        """The same function of more inputs, of which no monomial is made."""
        place = np.full(count, at)
        moved = tuple(tuple(c + count if c >= at else c for c in f) for f in self.factors)
        return replace(
            self,
            shift=from_host(np.insert(self.shift, place, 0.0)),
            scale=from_host(np.insert(self.scale, place, 1.0)),
            factors=moved,
        )

    @property
    def parameters(self) -> tuple[jax.Array, ...]:
        """The weights."""
        return (self.weights,)

    def moved(self, deviations: Sequence[jax.Array], spread: jax.Array) -> Polynomial:
        """The polynomial with other weights."""
        return replace(self, weights=self.weights + spread[:, None] * deviations[0])

    def structure(self) -> dict[str, Any]:
        """Kind, what the monomials multiply, and how far they go."""
        factors = [list(f) for f in self.factors]
        return {"kind": self.kind, "factors": factors, "reach": self.reach}

    def arrays(self) -> dict[str, jax.Array]:
        """Shift, scale and weights."""
        return {"shift": self.shift, "scale": self.scale, "weights": self.weights}

    @classmethod
    def restored(cls, arrays: Mapping[str, jax.Array], structure: Mapping[str, Any]) -> Polynomial:
        """The polynomial of which they came."""
        factors = tuple(tuple(int(c) for c in f) for f in structure["factors"])
        inputs = arrays["shift"].shape[0]
        if any(not 0 <= c <= inputs for f in factors for c in f):
            raise ValueError(f"factors, of which one is no column of {inputs} inputs")
        reach = float(structure.get("reach", REACH))
        return cls(arrays["shift"], arrays["scale"], arrays["weights"], factors, reach)

"""The equation of a model with hidden states, in standardised variables.

    ẋ = A x + B v + b + e(x, v),      y = what instruments make of the first of x

e is nothing, a polynomial, or a layer of tanh units W₂ tanh(W₁ [x, v] + c). Where stability is
asked for, A = P⁻¹ (S - R Rᵀ - ε P - |P W₂| |W₁| 1) with S skew, whatever R and S are: dᵀ P d of the
difference d of any two rollouts then falls by exp(-2 ε t) at least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.types import Array
from dfsm.models.corrective.polynomial import REACH, monomials, products
from dfsm.models.terms.sensor import Sensor
from dfsm.numerics.runge_kutta import rk4_step

Kind = Literal["none", "polynomial", "tanh"]
# Rollouts that run away end here, in standard deviations.
_FAR = 30.0


@dataclass(frozen=True)
class Form:
    """Sizes and structure; hashable, so that compiled code knows them.

    Attributes
    ----------
    states, outputs, inputs
        Numbers of x, y and v.
    kind
        Of e.
    units
        Tanh units.
    factors
        Monomials of the polynomial, see `models.corrective.polynomial`.
    metric
        P, row by row, where stability is asked for.
    margin
        ε per typical step, beside `metric`.
    reach
        Standard deviations beyond which an input of the polynomial counts as if it were there.
    room
        States that linear rollouts are computed with, so that systems of all sizes share compiled
        code; those that there are not stay at zero.
    sensors
        What makes y of the first of x, a level added where it folds; empty where they are y.
    """

    states: int
    outputs: int
    inputs: int
    kind: Kind = "none"
    units: int = 0
    factors: tuple[tuple[int, ...], ...] = ()
    metric: tuple[tuple[float, ...], ...] = ()
    margin: float = 0.0
    reach: float = REACH
    room: int = 0
    sensors: tuple[Sensor, ...] = ()

    @property
    def width(self) -> int:
        """Number of x and v."""
        return self.states + self.inputs

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Of the parameter arrays: [A, B, b] first, levels of outputs last where there are any."""
        shapes: list[tuple[int, ...]] = [(self.states, self.width + 1)]
        if self.kind == "polynomial":
            shapes.append((self.states, len(self.factors)))
        if self.kind == "tanh":
            shapes += [(self.units, self.width + 1), (self.states, self.units)]
        return [*shapes, (self.outputs,)] if self.sensors else shapes

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(int(np.prod(s)) for s in self.shapes)

    def parts(self, weights: jax.Array | Array) -> list[jax.Array]:
        """The parameter arrays as the equation takes them, A as it is in the equation."""
        raw, start = [], 0
        for shape in self.shapes:
            count = int(np.prod(shape))
            raw.append(jnp.reshape(weights[start : start + count], shape))
            start += count
        if self.metric:
            raw[0] = jnp.concatenate([self._contracting(raw), raw[0][:, self.states :]], axis=1)
        return raw

    def _contracting(self, raw: list[jax.Array]) -> jax.Array:
        n, P = self.states, np.array(self.metric)
        M = raw[0][:, :n]
        R, skew = jnp.tril(M), jnp.triu(M, 1) - jnp.triu(M, 1).T
        gain = 0.0
        if self.kind == "tanh":
            W1, W2 = raw[1][:, :n], raw[2]
            gain = jnp.sqrt(jnp.sum((P @ W2) ** 2) * jnp.sum(W1**2) + 1e-24)
        pull = R @ R.T + self.margin * P + gain * np.eye(n)
        return jnp.linalg.solve(P, skew - pull)

    def rate(self, parts: list[jax.Array], x: jax.Array, v: jax.Array) -> jax.Array:
        """ẋ at one point."""
        z = jnp.concatenate([x, v])
        total = parts[0][:, :-1] @ z + parts[0][:, -1]
        if self.kind == "polynomial":
            return total + parts[1] @ products(jnp.clip(z, -self.reach, self.reach), self.factors)
        if self.kind == "tanh":
            return total + parts[2] @ jnp.tanh(parts[1][:, :-1] @ z + parts[1][:, -1])
        return total

    def seen(self, levels: Any, x: Any) -> Any:
        """Outputs of states, ``(..., state)`` to ``(..., output)``, see `sensors`.

        Arrays of NumPy or JAX.
        """
        if not self.sensors:
            return x[..., : self.outputs]
        seen = [
            sensor.seen(x[..., k]) + (levels[k] if sensor.folds else 0.0)
            for k, sensor in enumerate(self.sensors)
        ]
        return (np if isinstance(x, np.ndarray) else jnp).stack(seen, axis=-1)

    @property
    def weighed(self) -> Array:
        """1 for parameters that are to be small and 0 for the others, ``(parameter,)``."""
        weights = np.ones(self.size)
        if self.sensors:
            weights[-self.outputs :] = 0.0
        return weights

    def interval(
        self, parts: list[jax.Array], x: jax.Array, h: jax.Array, v: jax.Array
    ) -> jax.Array:
        """States a sample later.

        Parameters
        ----------
        parts
            See `parts`.
        x
            ``(state,)``.
        h
            Length of the interval.
        v
            Inputs at the start, middle and end of every step in it, ``(step, 3, input)``.
        """
        rate = lambda x, v: self.rate(parts, x, v)  # noqa: E731

        def step(x: jax.Array, v: jax.Array) -> tuple[jax.Array, None]:
            return rk4_step(rate, x, h / steps, (v[0], v[1], v[2]))[0], None

        steps = v.shape[0]
        # One body, however many steps: what is compiled stays small.
        x = step(x, v[0])[0] if steps == 1 else jax.lax.scan(step, x, v)[0]
        return jnp.clip(x, -_FAR, _FAR)


def polynomial(form: Form, degree: int, most: int, reach: float) -> Form:
    """The form with a polynomial, of a lower degree where there would be too many monomials."""
    while degree > 2 and len(monomials(form.width, degree)) > most:
        degree -= 1
    factors = monomials(form.width, degree)
    return replace(form, kind="polynomial", factors=factors, reach=reach, room=0)

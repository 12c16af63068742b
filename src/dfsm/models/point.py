"""f̂ and ĝ at one point at a time, as plain functions: nothing in them is compiled or batched.

For whoever compiles more than the model, differentiates it with other functions, or writes it down
for other programs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import jax
import jax.numpy as jnp

from dfsm.models.dfsm import DFSM, derivative_row, output_row

PointFunction = Callable[..., jax.Array]


class Point:
    """A model at one point; what f̂ and ĝ share is computed once, and only where it is asked for.

    Parameters
    ----------
    model
        As `DFSM.prepared`.
    groups
        Vectors of states, controls, disturbances and parameters, as `DFSM.derivative` takes them.
    """

    def __init__(self, model: DFSM, *groups: jax.Array) -> None:
        self._model, self._groups = model, groups
        self._inputs = model.signals.order.join(*groups)

    @cached_property
    def _known(self) -> jax.Array | None:
        return None if self._model.terms is None else self._model.terms(self._inputs)

    def _element(self, column: int | None) -> jax.Array:
        return self._model.signals.order.element(column, *self._groups)

    @cached_property
    def derivative(self) -> jax.Array:
        """f̂, shape ``(state,)``."""
        value = self._element(self._model.f.schedule)
        return derivative_row(self._model, self._inputs, value, self._known)

    @cached_property
    def output(self) -> jax.Array:
        """ĝ without blade harmonics, shape ``(output,)``."""
        return self.turning_output()

    def turning_output(self, *turning: jax.Array) -> jax.Array:
        """ĝ at an azimuth in rad in a wind field, or at the mean over a revolution without them."""
        if self._model.g is None:
            return jnp.zeros(0)
        harmonics = self._model.harmonics(*(turning or (None, None)))
        inputs = jnp.concatenate([self._inputs, harmonics])
        value = self._element(self._model.g.schedule)
        return output_row(self._model, inputs, value, self._known)


def functions_of_points(model: DFSM) -> tuple[PointFunction, PointFunction]:
    """f̂ and ĝ as functions of one point.

    Both take the vectors of `DFSM.derivative` and `DFSM.output`, and ĝ in addition an azimuth and
    the wind field.
    """
    model = model.prepared()

    def derivative(*groups: jax.Array) -> jax.Array:
        return Point(model, *groups).derivative

    def output(
        x: jax.Array, u: jax.Array, w: jax.Array, p: jax.Array, *turning: jax.Array
    ) -> jax.Array:
        return Point(model, x, u, w, p).turning_output(*turning)

    return derivative, output

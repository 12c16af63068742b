"""A model for loops that ask for f̂ again and again, mostly where only the states have moved.

A Runge-Kutta step evaluates f̂ four times, twice at the same disturbances, and a controller that
reads accelerations once more. Here what follows from disturbances and parameters alone is computed
from them alone, so that a compiler does it once at each time instead of five times per step.
"""

from __future__ import annotations

from dataclasses import fields

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from dfsm.models.dfsm import DFSM, corrected
from dfsm.models.inputs import GROUPS
from dfsm.models.linear import SplitLinear


class Staged(DFSM):
    """A `DFSM` that evaluates like it, but for the last digits; it cannot be saved.

    Attributes
    ----------
    apart
        f̂_L with disturbances and parameters apart from states, controls and terms.
    """

    apart: SplitLinear | None = None

    def derivative(
        self,
        states: ArrayLike,
        controls: ArrayLike,
        disturbances: ArrayLike,
        parameters: ArrayLike = (),
    ) -> jax.Array:
        """Evaluate f̂ at one point, or at many as `DFSM.derivative`.

        Parameters
        ----------
        states, controls, disturbances, parameters
            Shapes ``(n,)``, or ``(..., n)``.
        """
        order = self.signals.order
        groups = order.arrays(states, controls, disturbances, parameters)
        if self.apart is None or any(group.ndim > 1 for group in groups):
            return super().derivative(states, controls, disturbances, parameters)
        x, u, w, p = groups
        moving = [u, x]
        if self.terms is not None:
            moving.append(self.terms.apart(lambda column: order.element(column, *groups)))
        value = order.element(self.f.schedule, *groups)
        total = self.apart(jnp.concatenate([w, p]), jnp.concatenate(moving), value)
        return corrected(total, (self.e, self.corrected), order.join(*groups))


def staged(model: DFSM) -> Staged:
    """The model as `DFSM.prepared`, without what has no effect, and in stages.

    Not within compiled code, where nobody knows what has an effect.
    """
    order = model.signals.order
    columns = {g: range(*order.columns(g).indices(len(order.names))) for g in GROUPS}
    terms = range(len(order.names), model.f.coefficients.shape[2])
    apart = SplitLinear.of(
        model.f,
        [*columns["disturbances"], *columns["parameters"]],
        [*columns["controls"], *columns["states"], *terms],
    )
    e = None if model.e is None else model.e.stripped()
    e_g = None if model.e_g is None else model.e_g.stripped()
    known = None if model.terms is None else model.terms.staged()
    parts = {field.name: getattr(model, field.name) for field in fields(DFSM)}
    return Staged(**{**parts, "e": e, "e_g": e_g, "terms": known}, apart=apart)

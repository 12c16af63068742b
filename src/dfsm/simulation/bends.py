"""Steps of adaptive solvers that end where the inputs bend or jump.

Imported only where such a solver is asked for: diffrax takes a second to load.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp


class EndingAtBends(diffrax.AbstractAdaptiveStepSizeController[Any, Any]):
    """Another controller's steps, cut where the next bend is.

    Diffrax's own `ClipStepSizeController` compares every step with all such times; here the next
    one is looked up, so that a step costs the same among 50,000 bends.

    Attributes
    ----------
    controller
        Decides on the steps.
    begins, ends
        Times in s, increasing, ``(bend,)``: steps end just before the first and go on just after
        the second, which may be the same. Times beyond the end change nothing.
    """

    controller: diffrax.PIDController
    begins: jax.Array
    ends: jax.Array

    @property
    def rtol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Relative tolerance, which implicit solvers ask for."""
        return self.controller.rtol

    @property
    def atol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Absolute tolerance."""
        return self.controller.atol

    @property
    def norm(self) -> Callable[[Any], Any]:  # pyright: ignore
        """Norm of errors."""
        return self.controller.norm

    def wrap(self, direction: Any) -> EndingAtBends:
        """Nothing to turn round: rollouts go forwards."""
        return replace(self, controller=self.controller.wrap(direction))

    def _cut(self, t0: jax.Array, t1: jax.Array) -> jax.Array:
        """End of a step from t0 that shall reach t1."""
        k = jnp.searchsorted(self.begins, t0, side="right")
        ahead = jnp.where(
            k < len(self.begins), self.begins[jnp.minimum(k, len(self.begins) - 1)], jnp.inf
        )
        return jnp.minimum(t1, eqxi.prevbefore(ahead))

    def init(
        self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any,
        error_order: Any,
    ) -> tuple[Any, Any]:  # fmt: skip
        """First step; arguments as in diffrax."""
        t1, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return self._cut(t0, t1), state

    def adapt_step_size(
        self, t0: Any, t1: Any, y0: Any, y1_candidate: Any, args: Any, y_error: Any,
        error_order: Any, controller_state: Any,
    ) -> tuple[Any, Any, Any, Any, Any, Any]:  # fmt: skip
        """Next step; arguments as in diffrax."""
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
        )
        # A step that ended just before a bend goes on just after it.
        after = eqxi.nextafter(next_t0)
        k = jnp.minimum(jnp.searchsorted(self.begins, next_t0), len(self.begins) - 1)
        here = self.begins[k] <= after
        moved = jnp.where(here, eqxi.nextafter(self.ends[k]), next_t0)
        next_t1 = jnp.maximum(next_t1 + (moved - next_t0), eqxi.nextafter(moved))
        return keep, moved, self._cut(moved, next_t1), jumped | here, state, result

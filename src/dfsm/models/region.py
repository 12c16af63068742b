"""Where the training data of a model lie: ranges, and Mahalanobis's distance along the schedule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dfsm.core.host import from_host, traced
from dfsm.core.types import Array
from dfsm.numerics.hats import hats


@jax.jit
def squared_distance(
    inputs: jax.Array, shares: jax.Array, middles: jax.Array, W: jax.Array
) -> jax.Array:
    """Σ_k h_k |W_k (I − μ_k)|² of inputs ``(..., input)`` and shares h ``(..., point)``."""
    apart = jnp.einsum("kri,...i->...kr", W, inputs) - jnp.einsum("kri,ki->kr", W, middles)
    return jnp.einsum("...k,...kr,...kr->...", shares, apart, apart)


# Of the squared distance that is usual: what disturbances leave to controls and states at least.
_LEFT = 0.2


class Region(eqx.Module):
    """Where the training data lie, and what they look like along the schedule.

    Attributes
    ----------
    low, high
        Range of every input over the training runs, widened by one quantisation step, shape
        ``(input,)``.
    mean, std
        Over all training samples, shape ``(input,)``.
    grid
        Schedule values of the operating points, shape ``(point,)``; one for an LTI model.
    operating
        Mean of every input at each, shape ``(point, input)``.
    whitening
        W at each, shape ``(point, input, input)``, see `distance`; empty where nothing is known of
        how the inputs occur together.
    fixed
        How many rows of W see only what nobody chooses: disturbances and parameters.
    schedule
        Column of the input that schedules, None for an LTI model.
    """

    low: jax.Array
    high: jax.Array
    mean: jax.Array
    std: jax.Array
    grid: jax.Array
    operating: jax.Array
    whitening: jax.Array = field(default_factory=lambda: from_host(np.zeros((0, 0, 0))))
    fixed: int = eqx.field(static=True, default=0)
    schedule: int | None = eqx.field(static=True, default=None)

    def without(self, columns: Sequence[int]) -> Region:
        """The region of fewer inputs: some count no more."""

        def fewer(values: jax.Array) -> jax.Array:
            return from_host(np.delete(values, columns, axis=-1))

        parts = {n: fewer(getattr(self, n)) for n in ("low", "high", "mean", "std", "operating")}
        whitening = fewer(self.whitening) if self.whitening.size else self.whitening
        schedule = self.schedule
        if schedule is not None:
            schedule -= sum(column < schedule for column in columns)
        return replace(self, **parts, whitening=whitening, schedule=schedule)

    def usual(self, values: Array) -> Array:
        """Mean inputs of the training data where the schedule has values ``(value,)``.

        Beyond the outermost operating points, those; shape ``(value, input)``.
        """
        grid, operating = np.asarray(self.grid), np.asarray(self.operating)
        return np.stack([np.interp(values, grid, column) for column in operating.T], axis=1)

    @property
    def scale(self) -> jax.Array:
        """What standardised inputs are divided by: `std`, and 1 for what does not vary."""
        if traced(self.std):
            return jnp.where(self.std > 0, self.std, 1.0)
        std = np.asarray(self.std)
        return from_host(np.where(std > 0, std, 1.0))

    def outside(self, inputs: ArrayLike) -> jax.Array:
        """Tell which samples of ``(..., input)`` are outside the training data.

        Either an input is outside its range, or all together are farther from what occurred
        together than samples of a new run usually are.
        """
        return self._outside(from_host(inputs))

    @eqx.filter_jit
    def _outside(self, inputs: jax.Array) -> jax.Array:
        return self.judged(inputs)[0]

    def judged(self, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """What `outside` and `distance` say of ``(..., input)``, for compiled code."""
        distance = self.distance(inputs)
        # An optimum that is kept inside meets the limit to a solver's tolerance.
        return jnp.any(self.beyond(inputs), axis=-1) | (distance > 1 + 1e-6), distance

    def beyond(self, inputs: ArrayLike) -> jax.Array:
        """Tell which of ``(..., input)`` are outside their own training range."""
        low, high = self.low, self.high
        if isinstance(inputs, np.ndarray | jax.Array) and not traced(inputs, low, high):
            low, high, inputs = map(np.asarray, (low, high, inputs))
        else:
            inputs = jnp.asarray(inputs)
        slack = 1e-9 * (high - low)
        return from_host((inputs < low - slack) | (inputs > high + slack))

    def distance(self, inputs: ArrayLike) -> jax.Array:
        """Squared distance of ``(..., input)`` from the training data: 1 is as far as is usual.

        Mahalanobis's, Σ_k h_k |W_k (I − μ_k)|² over the operating points k with hat functions h of
        the schedule. 98 % of the training samples are nearer, measured by the other runs.
        """
        return self._squared(from_host(inputs), slice(None))

    def distance_chosen(self, inputs: ArrayLike, value: jax.Array | None = None) -> jax.Array:
        """What controls and states add to the distance, over what the disturbances leave for them.

        1 where all of ``(..., input)`` are as far from the training data as is usual. Disturbances
        that are unusual themselves leave at least a fifth: somewhat more than controls and states
        of the training runs take on average. `value` is the schedule's, ``(...)``; None takes it
        from the inputs.
        """
        inputs = jnp.asarray(inputs)
        taken = self._squared(inputs, slice(self.fixed), value)
        added = self._squared(inputs, slice(self.fixed, None), value)
        return added / jnp.maximum(1 - taken, _LEFT)

    def _squared(self, inputs: jax.Array, rows: slice, value: jax.Array | None = None) -> jax.Array:
        if not self.whitening.size:
            return jnp.zeros(inputs.shape[:-1])
        W, schedule = self.whitening, inputs
        if not traced(inputs, W):
            W, schedule = np.asarray(W), np.asarray(inputs)
        shares = hats(self.grid, schedule[..., self.schedule or 0] if value is None else value)
        return squared_distance(inputs, shares, self.operating, W[:, rows])

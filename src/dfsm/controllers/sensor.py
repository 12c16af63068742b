"""Sensors in front of a controller: low-pass filter, delay, noise."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.wrapper import Wrapper
from dfsm.core.settings import require
from dfsm.errors import DfsmError, missing


class SensorState(NamedTuple):
    """The controller's state; filtered signals, now and before; number of steps."""

    inner: Any
    recent: jax.Array
    calls: jax.Array


class Sensor(Wrapper):
    """A `Controller` that sees its measurements through a sensor.

    First a low-pass ω / (s + ω), exact for a measurement that is held over the interval; then the
    delay, linear between samples; then white noise, which is the same for every run of one seed.

    Attributes
    ----------
    inner
        The controller.
    corner
        ω in rad/s; None for none.
    delay
        In s.
    noise
        Standard deviation in the measurement's unit.
    seed
        Of the noise.
    acts_on
        Measurements that it is for; None for all.

    Raises
    ------
    DfsmError
        A measurement that the controller does not read, or a negative delay.
    """

    corner: jax.Array | None = None
    noise: jax.Array = eqx.field(converter=jnp.asarray, default=0.0)  # pyright: ignore[reportAssignmentType]
    delay: float = eqx.field(static=True, default=0.0)
    seed: int = eqx.field(static=True, default=0)
    acts_on: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        require(self.delay >= 0, "delay", self.delay, "seconds, at least 0")
        if lost := [n for n in self.acts_on or () if n not in self.inner.measurements]:
            raise DfsmError(f"acts_on: the controller has {missing(lost, self.inner.measurements)}")

    def start(self, measurements: jax.Array, commands: jax.Array) -> SensorState:
        """The sensor has seen these for long; see `Controller.start`."""
        seen = measurements[self._columns]
        recent = jnp.tile(seen, (int(self.delay / self.interval * (1 + 1e-9)) + 2, 1))
        return SensorState(self.inner.start(measurements, commands), recent, jnp.zeros((), int))

    def step(
        self, state: SensorState, measurements: jax.Array, time: jax.Array
    ) -> tuple[SensorState, jax.Array]:
        """Next state, and commands; see `Controller.step`."""
        seen = jnp.asarray(measurements)[self._columns]
        if self.corner is not None:
            kept = jnp.exp(-self.corner * self.interval)
            seen = seen + kept * (state.recent[0] - seen)
        recent = jnp.concatenate([seen[None], state.recent[:-1]])
        steps = self.delay / self.interval
        first = int(steps * (1 + 1e-9))
        part = min(max(steps - first, 0.0), 1.0)
        late = (1 - part) * recent[first] + part * recent[first + 1]
        key = jax.random.fold_in(jax.random.key(self.seed), state.calls)
        late = late + self.noise * jax.random.normal(key, late.shape)
        told = jnp.asarray(measurements).at[self._columns].set(late)
        inner, commands = self.inner.step(state.inner, told, time)
        return SensorState(inner, recent, state.calls + 1), commands

    @property
    def _columns(self) -> Any:
        chosen = self.inner.measurements if self.acts_on is None else self.acts_on
        return np.array([self.inner.measurements.index(n) for n in chosen])

"""Sensors in front of a controller: low-pass filter, delay, noise."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.controller import require_texts
from dfsm.controllers.fields import numbers, require_numbers, require_shapes
from dfsm.controllers.traced import traced
from dfsm.controllers.wrapper import Wrapper
from dfsm.core.settings import require_number
from dfsm.errors import DfsmError, missing

# Calls that a delay may last: as many measurements are kept.
_MOST_CALLS = 100_000


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
        What is wrapped is no controller; a measurement that it does not read; a corner that is not
        above 0, a negative delay or noise, a delay longer than any run; or a seed that is no whole
        number.
    """

    corner: jax.Array | None = eqx.field(converter=numbers("corner", optional=True), default=None)
    noise: jax.Array = eqx.field(converter=numbers("noise"), default=0.0)  # pyright: ignore[reportAssignmentType]
    delay: float = eqx.field(static=True, default=0.0)
    seed: int = eqx.field(static=True, default=0)
    acts_on: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        longest = np.inf if traced(self.inner.interval) else _MOST_CALLS * self.inner.interval
        expected = f"seconds, at least 0 and at most {_MOST_CALLS:,} of its intervals, {longest:g}"
        require_number("delay", self.delay, expected, least=0, most=longest)
        seeds = "a whole number of at most 63 bits"
        require_number("seed", self.seed, seeds, whole=True, least=-(2**63), most=2**63 - 1)
        if self.acts_on is not None:
            require_texts("acts_on", self.acts_on)
        if lost := [n for n in self.acts_on or () if n not in self.inner.measurements]:
            raise DfsmError(f"acts_on: the controller has {missing(lost, self.inner.measurements)}")
        if traced(self):
            return
        require_numbers(self, "corner", "rad/s, more than 0, or None for none", above=0)
        require_numbers(self, "noise", "at least 0", least=0)

    def start(self, measurements: jax.Array, commands: jax.Array) -> SensorState:
        """The sensor has seen these for long; see `Controller.start`."""
        require_shapes(self, "corner noise", len(self._columns), "measurement that it is for")
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
        return np.array([self.inner.measurements.index(n) for n in chosen], dtype=int)

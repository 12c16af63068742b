"""Actuators behind a controller: second-order dynamics, limits of rate and range."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.controller import require_texts
from dfsm.controllers.fields import (
    numbers,
    pair_of,
    require_limits,
    require_numbers,
    require_shapes,
)
from dfsm.controllers.rosco_blocks import within
from dfsm.controllers.traced import traced
from dfsm.controllers.wrapper import Wrapper
from dfsm.errors import DfsmError, missing


class ActuatorState(NamedTuple):
    """The controller's state; position and velocity; what takes them over one interval."""

    inner: Any
    position: jax.Array
    velocity: jax.Array
    moves: jax.Array


class Actuator(Wrapper):
    """A `Controller` whose commands reach the plant through an actuator.

        p̈ = ω² (u - p) - 2 ζ ω ṗ,      |ṗ| and p within their limits

    exact over an interval for a command that is held, then limited. An actuator that only limits
    has no `corner`. Wrap twice for two commands with different actuators.

    Attributes
    ----------
    inner
        The controller.
    corner, damping
        ω in rad/s, None for none, and ζ.
    rate
        Largest rate of change, in the command's unit per s.
    limits
        Lowest and highest position.
    acts_on
        Commands that it is for; None for all.

    Raises
    ------
    DfsmError
        What is wrapped is no controller; a command that it does not set; a corner or rate that is
        not above 0, a negative damping; or limits the wrong way round.
    """

    corner: jax.Array | None = eqx.field(converter=numbers("corner", optional=True), default=None)
    damping: jax.Array = eqx.field(converter=numbers("damping"), default=0.7)  # pyright: ignore[reportAssignmentType]
    rate: jax.Array = eqx.field(converter=numbers("rate"), default=np.inf)  # pyright: ignore[reportAssignmentType]
    limits: tuple[Any, Any] = eqx.field(converter=pair_of, default=(-jnp.inf, jnp.inf))
    acts_on: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.acts_on is not None:
            require_texts("acts_on", self.acts_on)
        if lost := [n for n in self.acts_on or () if n not in self.inner.commands]:
            raise DfsmError(f"acts_on: the controller sets {missing(lost, self.inner.commands)}")
        if traced(self):
            return
        require_numbers(self, "corner", "rad/s, more than 0, or None for none", above=0)
        require_numbers(self, "damping", "at least 0", least=0)
        require_numbers(self, "rate", "more than 0", above=0, infinite=True)
        require_limits(self.limits)

    def start(self, measurements: jax.Array, commands: jax.Array) -> ActuatorState:
        """At rest where the plant's controls are; see `Controller.start`."""
        position = commands[self._columns]
        require_shapes(self, "corner damping", None)
        require_shapes(self, "rate limits", len(self._columns), "command that it is for")
        moves = jnp.zeros((2, 2))
        if self.corner is not None:
            square, slope = self.corner**2, 2 * self.damping * self.corner
            zero, one = jnp.zeros_like(square), jnp.ones_like(square)
            rate = jnp.stack([jnp.stack([zero, one]), jnp.stack([-square, -slope])])
            moves = jax.scipy.linalg.expm(rate * self.interval)
        inner = self.inner.start(measurements, commands)
        return ActuatorState(inner, position, jnp.zeros_like(position), moves)

    def step(
        self, state: ActuatorState, measurements: jax.Array, time: jax.Array
    ) -> tuple[ActuatorState, jax.Array]:
        """Next state, and commands; see `Controller.step`."""
        inner, commands = self.inner.step(state.inner, measurements, time)
        commands = jnp.asarray(commands, dtype=float)
        wanted = commands[self._columns]
        position, velocity = wanted, state.velocity
        if self.corner is not None:
            away = state.position - wanted
            position = wanted + state.moves[0, 0] * away + state.moves[0, 1] * velocity
            velocity = state.moves[1, 0] * away + state.moves[1, 1] * velocity
        most = self.rate * self.interval
        limited = within(position, state.position - most, state.position + most)
        limited = within(limited, *self.limits)
        # What runs into a limit goes on at the rate that it has there.
        velocity = jnp.where(
            limited == position, velocity, (limited - state.position) / self.interval
        )
        commands = commands.at[self._columns].set(limited)
        return ActuatorState(inner, limited, velocity, state.moves), commands

    @property
    def _columns(self) -> Any:
        chosen = self.inner.commands if self.acts_on is None else self.acts_on
        return np.array([self.inner.commands.index(n) for n in chosen], dtype=int)

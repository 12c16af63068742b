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

# Beyond, nothing moves.
_MOST_DAMPING = 1e6
# Distance from critical damping, times (ω h)², below which a series is more exact than roots.
_NEAR = 1e-3


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
        not above 0, a damping that is negative or beyond all use; or limits the wrong way round.
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
        most = f"at least 0, {_MOST_DAMPING:g} at most"
        require_numbers(self, "damping", most, least=0, most=_MOST_DAMPING)
        require_numbers(self, "rate", "more than 0", above=0, infinite=True)
        require_limits(self.limits)

    def start(self, measurements: jax.Array, commands: jax.Array) -> ActuatorState:
        """At rest where the plant's controls are; see `Controller.start`."""
        position = commands[self._columns]
        require_shapes(self, "corner damping", None)
        require_shapes(self, "rate limits", len(self._columns), "command that it is for")
        moves = jnp.zeros((2, 2))
        if self.corner is not None:
            moves = _moves(self.corner, self.damping, self.interval)
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


def _moves(corner: jax.Array, damping: jax.Array, interval: float) -> jax.Array:
    """What takes position, away from where it goes, and velocity over an interval, ``(2, 2)``.

    By its roots, however far the corner lies above what the interval resolves: a matrix exponential
    is no number there.
    """
    x, off = corner * interval, damping**2 - 1
    # e^{-ζx} cosh(√off x) and e^{-ζx} sinh(√off x) / √off, each where it can be computed.
    near = jnp.abs(off) * x**2 < _NEAR
    slow = jnp.sqrt(jnp.where((off < 0) & ~near, -off, 1.0))
    fast = jnp.sqrt(jnp.where((off > 0) & ~near, off, 1.0))
    decay = jnp.exp(-damping * x)
    ends = jnp.exp(-x / (damping + fast)), jnp.exp(-x * (damping + fast))
    y = jnp.where(near, off * x**2, 0.0)
    close = jnp.where(near, x, 0.0)
    even = decay * (1 + y / 2 * (1 + y / 12 * (1 + y / 30)))
    odd = decay * close * (1 + y / 6 * (1 + y / 20 * (1 + y / 42)))
    even = jnp.where(near, even, jnp.where(off < 0, decay * jnp.cos(slow * x), sum(ends) / 2))
    apart = (ends[0] - ends[1]) / (2 * fast)
    odd = jnp.where(near, odd, jnp.where(off < 0, decay * jnp.sin(slow * x) / slow, apart))
    rows = [[even + damping * odd, odd / corner], [-corner * odd, even - damping * odd]]
    return jnp.stack([jnp.stack(row) for row in rows])

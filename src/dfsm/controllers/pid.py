"""PI and PID with anti-windup, limits and gains that follow a schedule."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.controller import require_controller
from dfsm.controllers.fields import (
    numbers,
    pair_of,
    require_limits,
    require_numbers,
    require_shapes,
    texts,
)
from dfsm.controllers.rosco_blocks import lookup, unwound, within
from dfsm.controllers.traced import traced
from dfsm.core.settings import require, require_number


class PIDState(NamedTuple):
    """Integral part of the command, and the measurement behind the derivative's filter."""

    integral: jax.Array
    smooth: jax.Array


class PID(eqx.Module):
    """A `Controller` of one command by one measurement: u = kp e + ki ∫e dt - kd dy/dt.

    e is the setpoint less the measurement y; the integral takes the error of its own step (backward
    Euler). It takes the command up to a limit and waits there unless the error leads away, so that
    nothing winds up, and it stays within the limits itself.

    Attributes
    ----------
    kp, ki, kd
        Gains; with a schedule, one value per point, linear between and constant beyond.
    setpoint
        What the measurement is to be.
    points
        Values of the schedule of the rows of gains, rising, shape ``(point,)``; None without.
    limits
        Lowest and highest command.
    smoothing
        Time constant of the derivative's low-pass in s; 0 for none.
    measurements, measurement_units
        The measurement, and the schedule's if there is one.
    commands, command_units
        The command.
    interval
        Time between two calls in s.

    Raises
    ------
    DfsmError
        What `require_controller` refuses; other than one command, or one measurement and one that a
        schedule follows; numbers that are none or not finite, limits the wrong way round, or
        points that do not rise. Where a loop begins: gains that are not one per point.
    """

    kp: jax.Array = eqx.field(converter=numbers("kp"))
    ki: jax.Array = eqx.field(converter=numbers("ki"))
    measurements: tuple[str, ...] = eqx.field(static=True, converter=texts)
    measurement_units: tuple[str, ...] = eqx.field(static=True, converter=texts)
    commands: tuple[str, ...] = eqx.field(static=True, converter=texts)
    command_units: tuple[str, ...] = eqx.field(static=True, converter=texts)
    interval: float = eqx.field(static=True)
    setpoint: jax.Array = eqx.field(converter=numbers("setpoint"))
    kd: jax.Array = eqx.field(converter=numbers("kd"), default=0.0)  # pyright: ignore[reportAssignmentType]
    limits: tuple[Any, Any] = eqx.field(converter=pair_of, default=(-jnp.inf, jnp.inf))
    points: jax.Array | None = eqx.field(converter=numbers("points", optional=True), default=None)
    smoothing: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        require_controller(self)
        require_number("smoothing", self.smoothing, "seconds, at least 0", least=0)
        scheduled = self.points is not None
        require(
            len(self.measurements) == 1 + scheduled,
            "measurements",
            self.measurements,
            "what is controlled and, with points, what the gains follow",
        )
        require(len(self.commands) == 1, "commands", self.commands, "one")
        if traced(self):
            return
        require_numbers(self, "kp ki kd setpoint points", "a finite number")
        require_limits(self.limits)
        if self.points is not None:
            rising = self.points.ndim > 0 and bool((np.diff(np.asarray(self.points)) > 0).all())
            require(rising, "points", np.asarray(self.points).tolist(), "values that rise")

    def start(self, measurements: jax.Array, commands: jax.Array) -> PIDState:
        """State whose first step continues the command, as far as the limits allow.

        Parameters
        ----------
        measurements, commands
            Shapes ``(measurement,)`` and ``(1,)``.
        """
        require_shapes(self, "setpoint limits", None)
        points = None if self.points is None else len(self.points)
        require_shapes(self, "kp ki kd", points, "point of the schedule")
        y = measurements[0]
        kp = self._gain(self.kp, measurements)
        step = self.interval * self._gain(self.ki, measurements) * (self.setpoint - y)
        integral = commands[0] - (kp * (self.setpoint - y) + step)
        return PIDState(within(integral, *self.limits), y)

    def step(
        self,
        state: PIDState,
        measurements: jax.Array,
        time: jax.Array,  # noqa: ARG002
    ) -> tuple[PIDState, jax.Array]:
        """Next state, and the command, shape ``(1,)``; see `Controller.step`."""
        y, dt = measurements[0], self.interval
        kp, ki, kd = (self._gain(gain, measurements) for gain in (self.kp, self.ki, self.kd))
        error = self.setpoint - y
        slope = (y - state.smooth) / (self.smoothing + dt)
        smooth = state.smooth + dt * slope
        moved = within(state.integral + dt * ki * error, *self.limits)
        direct = kp * error - kd * slope
        integral = unwound(state.integral, moved, direct, self.limits)
        return PIDState(integral, smooth), within(direct + integral, *self.limits)[None]

    def _gain(self, gain: jax.Array, measurements: jax.Array) -> jax.Array:
        if self.points is None or gain.ndim == 0:
            return gain
        return lookup(jnp.asarray(self.points), gain, measurements[1])

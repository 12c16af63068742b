"""Linear controllers in discrete time: a state space, and state feedback with integral action."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from numpy.typing import ArrayLike

from dfsm.controllers.controller import INTERVAL, require_controller
from dfsm.controllers.fields import (
    numbers,
    pair_of,
    require_limits,
    require_numbers,
    require_shapes,
    texts,
)
from dfsm.controllers.rosco_blocks import unwound, within
from dfsm.controllers.traced import traced
from dfsm.core.settings import require, require_number
from dfsm.core.types import Array
from dfsm.errors import DfsmError


class StateSpace(eqx.Module):
    """A `Controller` in discrete time about an operating point.

        z' = A z + B (y - y₀),      u = u₀ + C z + D (y - y₀)

    Attributes
    ----------
    A, B, C, D
        Shapes ``(state, state)``, ``(state, measurement)``, ``(command, state)`` and
        ``(command, measurement)``.
    y0, u0
        Measurements and commands about which it is linear.
    limits
        Lowest and highest commands, numbers or shape ``(command,)``.
    measurements, measurement_units, commands, command_units, interval
        See `Controller`.

    Raises
    ------
    DfsmError
        What `require_controller` refuses, shapes that do not fit each other, numbers that are not
        finite, or limits the wrong way round.
    """

    A: jax.Array = eqx.field(converter=numbers("A"))
    B: jax.Array = eqx.field(converter=numbers("B"))
    C: jax.Array = eqx.field(converter=numbers("C"))
    D: jax.Array = eqx.field(converter=numbers("D"))
    measurements: tuple[str, ...] = eqx.field(static=True, converter=texts)
    measurement_units: tuple[str, ...] = eqx.field(static=True, converter=texts)
    commands: tuple[str, ...] = eqx.field(static=True, converter=texts)
    command_units: tuple[str, ...] = eqx.field(static=True, converter=texts)
    interval: float = eqx.field(static=True)
    y0: jax.Array = eqx.field(converter=numbers("y0"), default=0.0)  # pyright: ignore[reportAssignmentType]
    u0: jax.Array = eqx.field(converter=numbers("u0"), default=0.0)  # pyright: ignore[reportAssignmentType]
    limits: tuple[Any, Any] = eqx.field(converter=pair_of, default=(-jnp.inf, jnp.inf))

    def __check_init__(self) -> None:
        require_controller(self)
        n = len(self.A) if self.A.ndim else 0
        m, p = len(self.measurements), len(self.commands)
        for name, shape in (("A", (n, n)), ("B", (n, m)), ("C", (p, n)), ("D", (p, m))):
            matrix = getattr(self, name)
            require(matrix.shape == shape, f"{name} of shape", matrix.shape, f"shape {shape}")
        if not traced(self):
            require_numbers(self, "A B C D y0 u0", "a finite number")
            require_limits(self.limits, equal=True)

    def start(self, measurements: jax.Array, commands: jax.Array) -> jax.Array:
        """State whose command is this one, and among those the one nearest to rest."""
        require_shapes(self, "y0", len(self.measurements), "measurement")
        require_shapes(self, "u0 limits", len(self.commands), "command")
        y = measurements - self.y0
        push, away = self.B @ y, jnp.eye(len(self.A)) - self.A
        inverse = jnp.linalg.pinv(self.C)
        particular = inverse @ (commands - self.u0 - self.D @ y)
        free = jnp.eye(len(self.A)) - inverse @ self.C
        rest = jnp.linalg.pinv(away @ free) @ (push - away @ particular)
        return particular + free @ rest

    def step(
        self,
        state: jax.Array,
        measurements: jax.Array,
        time: jax.Array,  # noqa: ARG002
    ) -> tuple[jax.Array, jax.Array]:
        """Next state, and commands; see `Controller.step`."""
        y = measurements - self.y0
        commands = self.u0 + self.C @ state + self.D @ y
        return self.A @ state + self.B @ y, within(commands, *self.limits)


class StateFeedback(eqx.Module):
    """A `Controller` u = u₀ - K (x - x₀) - K_i ∫(x - x₀) dt of the measured states.

    Where a command is at a limit, integrals wait unless they lead away from it.

    Attributes
    ----------
    gain
        K, shape ``(command, measurement)``.
    integral_gain
        K_i of the same shape, zero in columns of states that are not integrated; None for static
        feedback.
    x0, u0
        States and controls of the operating point, in the controller's units.
    limits
        Lowest and highest commands, numbers or shape ``(command,)``.
    measurements, measurement_units, commands, command_units, interval
        See `Controller`.

    Raises
    ------
    DfsmError
        What `require_controller` refuses, a gain of another shape, numbers that are not finite, or
        limits the wrong way round.
    """

    gain: jax.Array = eqx.field(converter=numbers("gain"))
    x0: jax.Array = eqx.field(converter=numbers("x0"))
    u0: jax.Array = eqx.field(converter=numbers("u0"))
    measurements: tuple[str, ...] = eqx.field(static=True, converter=texts)
    measurement_units: tuple[str, ...] = eqx.field(static=True, converter=texts)
    commands: tuple[str, ...] = eqx.field(static=True, converter=texts)
    command_units: tuple[str, ...] = eqx.field(static=True, converter=texts)
    interval: float = eqx.field(static=True)
    integral_gain: jax.Array | None = eqx.field(
        converter=numbers("integral_gain", optional=True), default=None
    )
    limits: tuple[Any, Any] = eqx.field(converter=pair_of, default=(-jnp.inf, jnp.inf))

    def __check_init__(self) -> None:
        require_controller(self)
        shape = (len(self.commands), len(self.measurements))
        for name in ("gain", "integral_gain"):
            gain = getattr(self, name)
            if gain is not None:
                require(gain.shape == shape, f"{name} of shape", gain.shape, f"shape {shape}")
        if not traced(self):
            require_numbers(self, "gain integral_gain x0 u0", "a finite number")
            require_limits(self.limits, equal=True)

    def start(self, measurements: jax.Array, commands: jax.Array) -> jax.Array:
        """What integrals add to the commands, such that the first step continues these.

        As far as the limits allow: nothing is wound up beyond.
        """
        require_shapes(self, "x0", len(self.measurements), "measurement")
        require_shapes(self, "u0 limits", len(self.commands), "command")
        if self.integral_gain is None:
            return jnp.zeros(0)
        error = measurements - self.x0
        step = self.interval * self.integral_gain @ error
        return within(commands, *self.limits) - (self.u0 - self.gain @ error - step)

    def step(
        self,
        state: jax.Array,
        measurements: jax.Array,
        time: jax.Array,  # noqa: ARG002
    ) -> tuple[jax.Array, jax.Array]:
        """Next state, and commands; see `Controller.step`."""
        error = measurements - self.x0
        wanted = self.u0 - self.gain @ error
        if self.integral_gain is None:
            return state, within(wanted, *self.limits)
        by = -self.interval * self.integral_gain @ error
        state = unwound(state, state + by, wanted, self.limits)
        return state, within(wanted + state, *self.limits)


def regulator_gain(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, interval: float
) -> Array:
    """Gain K of the linear-quadratic regulator u = -K x, with u held over the interval.

    Parameters
    ----------
    A, B
        ẋ = A x + B u in continuous time, ``(state, state)`` and ``(state, control)``.
    Q, R
        Weights of Σ xᵀQ x + uᵀR u over the steps.
    interval
        Time between two steps in s.

    Returns
    -------
    ndarray
        Shape ``(control, state)``.

    Raises
    ------
    DfsmError
        An interval that is not above 0, or there is no such gain: a part that does not decay cannot
        be reached by the controls or is not weighted.
    """
    require_number("interval", interval, INTERVAL, above=0)
    F, G, q, r = (np.asarray(a, dtype=float) for a in (A, B, Q, R))
    n, m = G.shape
    # With the controls among the states, which hold.
    moves = scipy.linalg.expm(np.block([[F, G], [np.zeros((m, n + m))]]) * interval)
    Ad, Bd = moves[:n, :n], moves[:n, n:]
    try:
        P = scipy.linalg.solve_discrete_are(Ad, Bd, q, r)
    except (scipy.linalg.LinAlgError, ValueError) as error:
        raise DfsmError(
            f"there is no linear-quadratic regulator ({error}): weight every state that does not "
            "decay by itself, and leave out those that the controls do not reach"
        ) from None
    return np.linalg.solve(r + Bd.T @ P @ Bd, Bd.T @ P @ Ad)

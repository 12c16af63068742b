"""What a controller is: measurements and time in, commands out, and a state in between."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from dfsm.core.types import Array


@runtime_checkable
class Controller(Protocol):
    """A controller in discrete time.

    Implementations are equinox modules: immutable pytrees whose gains are leaves by name.

    Attributes
    ----------
    measurements, measurement_units
        Channels that it reads, and in which units.
    commands, command_units
        Channels that it sets, and in which units.
    interval
        Time between two calls in s.
    """

    measurements: tuple[str, ...]
    measurement_units: tuple[str, ...]
    commands: tuple[str, ...]
    command_units: tuple[str, ...]
    interval: float

    def start(self, measurements: Array, commands: Array) -> Any:
        """State consistent with running at these values: the first step changes nothing abruptly.

        Parameters
        ----------
        measurements
            Shape ``(measurement,)``.
        commands
            Shape ``(command,)``.
        """
        ...

    def step(self, state: Any, measurements: Array, time: Array) -> tuple[Any, Array]:
        """Next state, and commands, shape ``(command,)``; pure.

        Parameters
        ----------
        state
            From `start` or the step before.
        measurements
            Shape ``(measurement,)``.
        time
            In s.
        """
        ...

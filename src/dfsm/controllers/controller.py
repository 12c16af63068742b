"""What a controller is: measurements and time in, commands out, and a state in between."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable


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

    @property
    def measurements(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def measurement_units(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def commands(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def command_units(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def interval(self) -> float: ...  # noqa: D102

    def start(self, measurements: Any, commands: Any) -> Any:
        """State consistent with running at these values: the first step changes nothing abruptly.

        Parameters
        ----------
        measurements
            Shape ``(measurement,)``.
        commands
            Shape ``(command,)``.
        """
        ...

    def step(self, state: Any, measurements: Any, time: Any) -> tuple[Any, Any]:
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

"""What stands around a controller and has its channels: actuators behind it, sensors before it."""

from __future__ import annotations

from typing import Any

import equinox as eqx

from dfsm.controllers.controller import require_controller


def _controller(inner: Any) -> Any:
    require_controller(inner, "inner")
    return inner


class Wrapper(eqx.Module):
    """Channels and interval of a `Controller` that are those of another.

    Attributes
    ----------
    inner
        The controller.

    Raises
    ------
    DfsmError
        It is none.
    """

    inner: Any = eqx.field(converter=_controller)

    @property
    def measurements(self) -> tuple[str, ...]:
        """Those of the controller."""
        return self.inner.measurements

    @property
    def measurement_units(self) -> tuple[str, ...]:
        """Those of the controller."""
        return self.inner.measurement_units

    @property
    def commands(self) -> tuple[str, ...]:
        """Those of the controller."""
        return self.inner.commands

    @property
    def command_units(self) -> tuple[str, ...]:
        """Those of the controller."""
        return self.inner.command_units

    @property
    def interval(self) -> float:
        """That of the controller."""
        return self.inner.interval

"""What a controller is: measurements and time in, commands out, and a state in between."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any, Protocol, runtime_checkable

from dfsm.controllers.traced import traced
from dfsm.core.settings import require, require_list, require_number, shown
from dfsm.errors import DfsmError

# What an interval is, in the sentences about others.
INTERVAL = "seconds, more than 0"


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

    # Properties, since implementations are frozen.
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


_PARTS = (
    "measurements",
    "measurement_units",
    "commands",
    "command_units",
    "interval",
    "start",
    "step",
)


def require_texts(name: str, values: Any) -> None:
    """Refuse what is no list of texts; one text is none, whose letters would be taken for names.

    Raises
    ------
    DfsmError
        It is not.
    """
    expected = 'a list of texts, as in ["q", "v"]'
    require_list(name, values, expected)
    require(all(isinstance(value, str) for value in values), name, shown(values), expected)


def require_controller(found: Any, name: str = "") -> None:
    """Refuse what is no `Controller`, or one that no loop can be closed with.

    Parameters
    ----------
    found
        Anything.
    name
        How the sentence calls it; empty where nobody has to be told which it is.

    Raises
    ------
    DfsmError
        It is of another type, it lacks a part, names and units are not lists of as many texts, a
        command is set twice, or the interval is not above 0.
    """
    of, name = f"{name}: " if name else "", name or "the controller given"
    if isinstance(found, type):
        raise DfsmError(f"{name} is {shown(found)}, expected an object of it: {found.__name__}(…)")
    if isinstance(found, str | PurePath):
        raise DfsmError(
            f"{name} is {shown(found)}, expected a controller: dfsm.read_rosco reads a DISCON.IN, "
            "dfsm.BladedLibrary opens a library"
        )
    if lost := [part for part in _PARTS if not hasattr(found, part)]:
        raise DfsmError(
            f"{name} is no controller: {shown(found)} has no {', '.join(lost)}, and a controller "
            f"has {', '.join(_PARTS[:-1])} and {_PARTS[-1]}"
        )
    for part in ("start", "step"):
        # Not shown where it is one: it would tell of the whole controller.
        if not callable(method := getattr(found, part)):
            require(False, f"{of}{part}", shown(method), "a method")
    for names, units in (("measurements", "measurement_units"), ("commands", "command_units")):
        told, theirs = getattr(found, names), getattr(found, units)
        require_texts(f"{of}{names}", told)
        require_texts(f"{of}{units}", theirs)
        require(len(told) > 0, f"{of}{names}", "empty", "at least one")
        expected = f"one for each of the {names} {shown(told)}"
        require(len(theirs) == len(told), f"{of}{units}", shown(theirs), expected)
    commands = list(found.commands)
    once = len(set(commands)) == len(commands)
    require(once, f"{of}commands", shown(commands), "each one once")
    if not traced(found.interval):
        require_number(f"{of}interval", found.interval, INTERVAL, above=0)

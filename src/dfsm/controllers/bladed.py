"""Controllers in Bladed-style libraries (ROSCO's libdiscon, a user's own), each in its own process.

A library keeps its state in itself: it can be started once, and two turbines in one process would
share it. So each `start` has a process of its own, in which the library is loaded afresh; many may
run at once, and one that crashes takes nothing with it but its run.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
import weakref
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from dfsm.controllers.bladed_child import HEAD, NOT_LOADED
from dfsm.controllers.controller import INTERVAL
from dfsm.controllers.discon import FILES, Discon, read_discon, write_discon
from dfsm.controllers.discon_check import check_discon
from dfsm.controllers.signals import BY_ROLE, Signals, signals
from dfsm.core.files import existing_file
from dfsm.core.settings import require_kind, require_number
from dfsm.core.types import Array
from dfsm.errors import DfsmError, DfsmWarning, printable

_CHILD = Path(__file__).with_name("bladed_child.py")
# Records of the swap array (Bladed's user manual, appendix A) that change from call to call:
# status, time, blades' pitch, shaft and electrical power, speeds, torque, wind, accelerations.
_SET = (1, 2, 4, 33, 34, 14, 15, 20, 21, 23, 27, 53, 83)
# Collective pitch, torque, and whether the generator is on the grid.
_GET = (45, 47, 35)
_FIRST, _LATER, _LAST = 0, 1, -1
# Modes of ROSCO that pitch each blade.
_BY_BLADE = ("IPC_ControlMode", "OL_Mode", "AWC_Mode", "PF_Mode")
# Seconds that a library has for one call, and for its last.
_PATIENCE = 120.0
_FAREWELL = 5.0


class _Process:
    """A child with the library in it, and the folder with its input."""

    def __init__(self, library: BladedLibrary) -> None:
        self.library = library
        self.folder = Path(tempfile.mkdtemp(prefix="dfsm-bladed-"))
        self.calls = 0
        self.log = (self.folder / "printed.txt").open("wb")
        told = {
            "library": str(library.library.resolve()),
            "procedure": library.procedure,
            "input": library._brought(self.folder),
            "name": "dfsm",
            "size": 4000,
            "records": {
                **{3: library.interval, 28: library._blade_by_blade},
                **{35: 1.0, 61: library.blades, 129: 4000},
            },
            "set": _SET,
            "get": _GET,
        }
        self.popen = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_CHILD), json.dumps(told)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            bufsize=0,
            cwd=library._home(self.folder),
            env={**os.environ, "GFORTRAN_UNBUFFERED_ALL": "1"},
        )
        self.end = weakref.finalize(self, _end, self.popen, self.log, self.folder)
        fail, text = self._head("loading it")
        if fail == NOT_LOADED:
            self.end()
            raise DfsmError(
                f"{library._told} cannot be loaded ({text}): check that it is a library for this "
                f"machine with a procedure '{library.procedure}'"
            )

    def call(self, values: list[float], when: str) -> tuple[float, ...]:
        """One call, and the records that are asked for."""
        stream = self.popen.stdin
        assert stream is not None
        try:
            stream.write(np.asarray(values, dtype="<f8").tobytes())
        except OSError:
            self._ended(when)
        self.calls += 1
        fail, text, answer = self._answer(when)
        if fail < 0:
            self.end()
            raise DfsmError(
                f"{self.library._told} refused at {when}: {text or f'aviFAIL is {fail}'}"
            )
        if fail > 0 and text:
            warnings.warn(f"{self.library._told} at {when}: {text}", DfsmWarning, stacklevel=4)
        return answer

    def _head(self, when: str) -> tuple[int, str]:
        fail, length = HEAD.unpack(self._read(HEAD.size, when))
        return fail, _sentence(self._read(length, when)) if length else ""

    def _answer(self, when: str) -> tuple[int, str, tuple[float, ...]]:
        fail, length = HEAD.unpack(self._read(HEAD.size, when))
        answer = np.frombuffer(self._read(8 * len(_GET), when), dtype="<f8")
        return fail, _sentence(self._read(length, when)), tuple(float(a) for a in answer)

    def _read(self, size: int, when: str) -> bytes:
        stream, data = self.popen.stdout, b""
        assert stream is not None
        while len(data) < size:
            # Windows cannot wait for pipes.
            if os.name == "posix" and not select.select([stream], [], [], _PATIENCE)[0]:
                self.end()
                raise DfsmError(
                    f"{self.library._told} has not answered for {_PATIENCE:g} s at {when}: look "
                    "at what it waits for"
                )
            more = stream.read(size - len(data))
            if not more:
                self._ended(when)
            data += more or b""
        return data

    def _ended(self, when: str) -> None:
        """Tell how the library ended."""
        code = self.popen.wait()
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        said = [line.strip() for line in self.printed().splitlines() if line.strip()]
        last = next((line for line in reversed(said) if "rror" in line), "")
        self.end()
        raise DfsmError(
            f"{self.library._told} ended the process that it ran in at {when} ({how}"
            f"{f', {printable(last)}' if last else ''}): check its input, or the library"
        )

    def printed(self) -> str:
        """What the library has printed."""
        return (self.folder / "printed.txt").read_text("utf-8", errors="replace")


def _end(popen: subprocess.Popen[bytes], log: object, folder: Path) -> None:
    for stream in (popen.stdin, popen.stdout, log):
        stream.close()  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    try:
        # Without requests it ends by itself.
        popen.wait(timeout=_FAREWELL)
    except subprocess.TimeoutExpired:
        popen.kill()
        popen.wait()
    shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True)
class BladedState:
    """Where a library is: it goes forward only, so that each state can be used once.

    Attributes
    ----------
    process
        The process that the library runs in.
    calls
        Number of calls before.
    torque, pitch
        What is commanded, in N m and rad.
    """

    process: _Process
    calls: int
    torque: float
    pitch: float

    def printed(self) -> str:
        """What the library has printed; ROSCO says there when its wind estimator is off."""
        return self.process.printed()

    def close(self) -> None:
        """Make the last call and end the process; what is not closed ends with its last state."""
        process = self.process
        if process.end.alive and process.popen.poll() is None:
            values = [float(_LAST), *(0.0 for _ in _SET[1:])]
            process.call(values, "its end")
        process.end()


@dataclass(frozen=True)
class BladedLibrary:
    """A controller in a library with Bladed's interface; `start` and `step` run on the host.

    Attributes
    ----------
    library
        Its file.
    discon
        Its input: a `Discon` or the path of a file; None where it reads none. ROSCO's is checked
        as `check_discon` says, and read with LoggingLevel and Echo at 0: it writes nothing.
    interval
        Time between two calls in s.
    channels
        Channel, or channel and unit, by role: ``{"wind": "Wind1VelX"}``. Roles are
        generator_speed, wind, torque and pitch (the commands); nacelle_pitch_acceleration and
        nacelle_acceleration where floating feedback asks for one; and, where they are named here,
        rotor_speed, power and both accelerations. Without them the rotor's speed is the
        generator's through the gearbox, and the power torque times speed times efficiency.
    procedure
        Name in the library.
    gearbox, efficiency
        Ratio of generator and rotor speed, and of electrical and shaft power; None takes ROSCO's
        WE_GearboxRatio and VS_GenEff, or 1.
    blades
        Their number.

    Raises
    ------
    DfsmError
        The library or its input is missing, or `check_discon` refuses the input.
    """

    library: Path
    discon: Discon | Path | None = None
    _: KW_ONLY
    interval: float
    channels: Mapping[str, str | tuple[str, str]] = field(default_factory=dict)
    procedure: str = "DISCON"
    gearbox: float | None = None
    efficiency: float | None = None
    blades: int = 3

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        require_kind("library", self.library, str | PathLike, "the path of a library")
        deck = "a DISCON.IN: the path of a file, or dfsm.read_discon's"
        require_kind("discon", self.discon, Discon | str | PathLike | None, deck)
        require_kind("channels", self.channels, Mapping, BY_ROLE)
        set_(self, "library", existing_file(self.library))
        require_number("interval", self.interval, INTERVAL, above=0)
        for name in ("gearbox", "efficiency"):
            require_number(name, getattr(self, name), "more than 0", above=0, optional=True)
        require_number("blades", self.blades, "a whole number, at least 1", least=1, whole=True)
        if isinstance(self.discon, str | Path):
            set_(self, "discon", _input(self.discon))
        if isinstance(self.discon, Discon):
            check_discon(self.discon)
        _ = self._inputs, self._outputs

    @property
    def measurements(self) -> tuple[str, ...]:
        """Channels that it reads."""
        return self._inputs.names

    @property
    def measurement_units(self) -> tuple[str, ...]:
        """Their units."""
        return self._inputs.units

    @property
    def commands(self) -> tuple[str, ...]:
        """Channels that it sets: torque and collective pitch."""
        return self._outputs.names

    @property
    def command_units(self) -> tuple[str, ...]:
        """Their units."""
        return self._outputs.units

    def start(self, measurements: Array, commands: Array) -> BladedState:
        """Load the library in a new process and make its start call at these values.

        The call is at time 0: at any other, ROSCO 2.10 takes the acceleration of that moment as
        one that has always been, and its high-pass filter forgets it only after minutes.

        Parameters
        ----------
        measurements
            Shape ``(measurement,)``.
        commands
            Torque and pitch at which the turbine runs, shape ``(command,)``.

        Raises
        ------
        DfsmError
            The library cannot be loaded, refuses the start, crashes, or answers NaN.
        """
        torque, pitch = (float(c) * f for c, f in zip(commands, self._outputs.factors, strict=True))
        state = BladedState(_Process(self), 0, torque, pitch)
        values = self._values(_FIRST, state, measurements, 0.0)
        state.process.call(values, "its start")
        return BladedState(state.process, 1, torque, pitch)

    def step(
        self, state: BladedState, measurements: Array, time: float
    ) -> tuple[BladedState, Array]:
        """Next state and commands.

        Parameters
        ----------
        state
            From `start` or the step before; a state can be used once.
        measurements
            Shape ``(measurement,)``.
        time
            In s.

        Returns
        -------
        BladedState
        Array
            Torque and pitch, shape ``(command,)``.

        Raises
        ------
        DfsmError
            A measurement or an answer is not finite, the library refuses or crashes (with the
            time and its message), or the state was used before.
        """
        process, when = state.process, f"{float(time):g} s"
        if not process.end.alive:
            raise DfsmError(f"{self._told} has ended before {when}: start it again")
        if state.calls != process.calls:
            raise DfsmError(
                f"{self._told} is {process.calls - state.calls} calls ahead of the state at "
                f"{when}: it cannot go back, start it again"
            )
        answer = process.call(self._values(_LATER, state, measurements, float(time)), when)
        pitch, torque, on_grid = answer
        torque = torque if on_grid else 0.0
        found = np.array([torque, pitch]) / self._outputs.factors
        for name, value in zip(self.commands, found, strict=True):
            if not np.isfinite(value):
                raise DfsmError(f"{self._told} sets {name} to {value} at {when}: check its gains")
        return BladedState(process, process.calls, torque, pitch), found

    @cached_property
    def _inputs(self) -> Signals:
        roles = ["generator_speed", "wind"]
        discon = self.discon
        feedback = discon.integer("Fl_Mode", 0) if isinstance(discon, Discon) else 0
        if feedback:
            roles.append("nacelle_acceleration" if feedback == 1 else "nacelle_pitch_acceleration")
        more = (r for r in self.channels if r not in (*roles, "torque", "pitch"))
        return signals([*roles, *more], self.channels)

    @cached_property
    def _outputs(self) -> Signals:
        return signals(("torque", "pitch"), self.channels)

    @cached_property
    def _ratios(self) -> tuple[float, float]:
        """Gearbox and efficiency."""
        discon = self.discon if isinstance(self.discon, Discon) else None
        gearbox = discon.number("WE_GearboxRatio") if discon else 1.0
        efficiency = discon.number("VS_GenEff") / 100 if discon else 1.0
        return (
            gearbox if self.gearbox is None else self.gearbox,
            efficiency if self.efficiency is None else self.efficiency,
        )

    @property
    def _blade_by_blade(self) -> float:
        """1 where ROSCO asks for ServoDyn's Ptch_Cntrl 1; it then tells the collective pitch, too.

        Moments of the blades are not measured, so that their own pitch control adds nothing.
        """
        discon = self.discon if isinstance(self.discon, Discon) else None
        return float(discon is not None and any(discon.integer(k, 0) > 0 for k in _BY_BLADE))

    @property
    def _told(self) -> str:
        return printable(str(self.library))

    def _values(
        self, status: int, state: BladedState, measurements: Array, time: float
    ) -> list[float]:
        """The records of `_SET`."""
        found = dict[str, float]()
        known = self._inputs
        for role, name, value, factor in zip(
            known.roles, known.names, measurements, known.factors, strict=True
        ):
            if not np.isfinite(value):
                raise DfsmError(f"{name} is {value} at {time:g} s: the controller needs a number")
            found[role] = float(value) * factor
        gearbox, efficiency = self._ratios
        speed, pitch = found["generator_speed"], state.pitch
        shaft = state.torque * speed
        return [
            *(float(status), time, pitch, pitch, pitch, shaft),
            *(found.get("power", shaft * efficiency), speed),
            *(found.get("rotor_speed", speed / gearbox), state.torque, found["wind"]),
            found.get("nacelle_acceleration", 0.0),
            found.get("nacelle_pitch_acceleration", 0.0),
        ]

    def _brought(self, folder: Path) -> str:
        """Name of the input, copied to `folder` with the files that it names and logging off."""
        if not isinstance(self.discon, Discon):
            return "" if self.discon is None else str(self.discon.resolve())
        changes: dict[str, float | str] = {k: 0 for k in ("LoggingLevel", "Echo")}
        for key in FILES:
            if key in self.discon and self.discon.file(key).is_file():
                name = changes[key] = f"{key}.txt"
                shutil.copyfile(self.discon.file(key), folder / name)
        known = {key: value for key, value in changes.items() if key in self.discon}
        copy = self.discon.changed(known)
        write_discon(Discon(folder / "DISCON.IN", copy.lines), folder / "DISCON.IN")
        return "DISCON.IN"

    def _home(self, folder: Path) -> Path:
        """Working folder of the library: of its input, where that is not ROSCO's."""
        return self.discon.resolve().parent if isinstance(self.discon, Path) else folder


def _input(path: str | Path) -> Discon | Path:
    path = existing_file(path)
    if b"VS_ControlMode" in path.read_bytes():
        return read_discon(path)
    return path


def _sentence(text: bytes) -> str:
    return printable(" ".join(text.decode("utf-8", errors="replace").split()))

"""Optimal torque and pitch as an open-loop input file of ROSCO, to be repeated in OpenFAST.

ROSCO (`OL_Mode = 1`) joins the rows by straight lines; where a control is held and jumps, two rows
stand close together. Before the first row its own controllers are at work, so that a horizon which
begins at 100 s leaves 100 s for the turbine to settle.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.control.solution import Solution
from dfsm.core.files import write_file
from dfsm.core.settings import require
from dfsm.core.types import Array
from dfsm.core.units import factor
from dfsm.data.conversion import in_units_of
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning, near_matches, printable
from dfsm.exports.rosco_limits import (
    CUTS,
    broken,
    negative_torque,
    pitch_needs,
    read_numbers,
)

# More rows than this are a mistyped step.
_MOST_ROWS = 1_000_000
# Time in s between the two rows at which a held control jumps: less than a step of a controller.
_JUMP = 1e-3


@dataclass(frozen=True)
class _Kind:
    """What a control may be to ROSCO: the names and the unit by which it is known."""

    what: str
    counterpart: str
    names: re.Pattern[str]
    examples: str
    unit: str
    expected: str


_PITCH = _Kind(
    what="pitch",
    counterpart="torque",
    names=re.compile(r"Bl(d|ade)?_?Pitch(C|Com|Cmd)?_?\d?|PtchPMz[bc]\d", re.IGNORECASE),
    examples="BldPitch1, BlPitchC1, PtchPMzc1",
    unit="rad",
    expected="an angle (rad or deg)",
)
_TORQUE = _Kind(
    what="torque",
    counterpart="pitch",
    names=re.compile(r"Gen(erator)?_?(Tq|Trq|Torq|Torque)(C|Com|Cmd)?", re.IGNORECASE),
    examples="GenTq",
    unit="N m",
    expected="a torque (N m, kN m or MN m)",
)


@dataclass(frozen=True)
class RoscoInput:
    """A written file, and what ROSCO and ServoDyn must be told to use it.

    Attributes
    ----------
    path
        The file.
    rows
        Number of times in it.
    pitch, torque
        Control in the second and third column; None where the solution has no such control, whose
        column is then left out.
    discon
        Lines to set in ROSCO's DISCON file, value by name.
    notes
        What ROSCO does to the file that these lines do not show, a sentence each.
    """

    path: Path
    rows: int
    pitch: str | None
    torque: str | None
    discon: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """What to set, for people."""
        lines = ["DISCON.IN of ROSCO:"]
        lines += [f"  {value:<20} ! {name}" for name, value in self.discon.items()]
        lines.append("ServoDyn input file (ROSCO 2.10 gives every blade its pitch):")
        return [*lines, f"  {'1':<20} ! Ptch_Cntrl", *self.notes]


def write_rosco(
    solution: Solution,
    path: str | Path,
    *,
    pitch: str | None = None,
    torque: str | None = None,
    scenario: int = 1,
    step: float | None = None,
    discon: str | Path | None = None,
) -> RoscoInput:
    """Write optimal controls as an open-loop input file of ROSCO.

    Parameters
    ----------
    solution
        From `solve` or `load_solution`.
    path
        File to write: time in s, collective pitch in rad, generator torque in N m.
    pitch, torque
        Controls to take, in a unit of an angle or of a torque; None takes the one whose name says
        what it is (BldPitch1, BlPitchC1, PtchPMzc1; GenTq). With one of the two named and no such
        name for the other, that one is left out.
    scenario
        Which one, counted from 1.
    step
        Time between rows in s, the controls in between by the scheme's polynomials; None writes
        the nodes of the solution. Controls that are held have two rows at every jump instead.
    discon
        DISCON.IN that the file is to be flown with: every limit of it that the file breaks is told
        in `notes`, and limits that are wide enough are left as they are.

    Returns
    -------
    RoscoInput

    Raises
    ------
    DfsmError
        The solve did not succeed, no control is a pitch or a torque, a name that does not tell
        which, units of something else, or a file that cannot be written.

    Warns
    -----
    DfsmWarning
        The torque is negative somewhere, which ROSCO makes 0.
    """
    known = None if discon is None else read_numbers(discon)
    if not solution.solved:
        raise DfsmError(f"{printable(solution.name)} was not solved: {solution.message}")
    run = _controls(solution, scenario, step)
    chosen = {
        "pitch": _chosen(run, _PITCH, pitch, torque),
        "torque": _chosen(run, _TORQUE, torque, pitch),
    }
    if chosen["pitch"] is None and chosen["torque"] is None:
        told = ", ".join(f"{c.name} in '{c.unit}'" for c in run.channels) or "none"
        raise DfsmError(
            f"{printable(solution.name)}: no control is a blade pitch in rad or deg, or a torque "
            f"in N m, kN m or MN m; its controls are {told}"
        )
    columns, heads, number = [run.time], ["Time (s)"], dict.fromkeys(chosen, 0)
    for what, control in chosen.items():
        if control is not None:
            unit = "rad" if what == "pitch" else "N m"
            taken = in_units_of(run, [Channel(control.name, unit)], "ROSCO")
            columns.append(taken[control.name])
            heads.append(f"{control.name} ({unit})")
            number[what] = len(columns)
    rows = dict(zip(("time", *(w for w in chosen if chosen[w] is not None)), columns, strict=True))
    path = Path(path)
    _write(path, solution.name, heads, np.column_stack(columns))
    names = {what: None if control is None else control.name for what, control in chosen.items()}
    lines = {
        "OL_Mode": "1",
        "OL_Filename": f'"{path.name}"',
        "Ind_Breakpoint": "1",
        "Ind_BldPitch": " ".join(3 * [str(number["pitch"])]),
        "Ind_GenTq": str(number["torque"]),
    }
    more, notes = _limits(solution, rows, known)
    return RoscoInput(path, len(run), names["pitch"], names["torque"], lines | more, notes)


def _limits(
    solution: Solution, rows: Mapping[str, Array], known: Mapping[str, float] | None
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Lines of DISCON.IN that let the file pass, and what they do not show."""
    time, pitch, torque = (rows.get(k) for k in ("time", "pitch", "torque"))
    assert time is not None
    lines, notes = {}, [CUTS]
    notes += [f"outside the model's training range: {text}" for text in solution.departures]
    if pitch is not None:
        lines["PC_ControlMode"] = "1"
        actuator = [c.name for c in solution.trajectory.channels if _is_actuator(c)]
        if actuator:
            notes.append(
                f"the model has {', '.join(actuator)} as a state and so its own pitch actuator: "
                "leave PA_Mode and what belongs to it as the model has it"
            )
        else:
            lines["PA_Mode"] = "0"
        for key, needed in pitch_needs(time, pitch).items():
            own = needed if known is None else known.get(key, needed)
            wider = min(own, needed) if "Min" in key else max(own, needed)
            lines[key] = f"{wider:.6g}"
        if known is None:
            notes.append("wider limits of the pitch and its rate than these serve as well")
    if torque is not None and (negative := negative_torque(time, torque)):
        warnings.warn(f"{printable(solution.name)}: {negative}", DfsmWarning, stacklevel=3)
        notes.append(negative)
    return lines, (*notes, *(broken(known, time, pitch, torque) if known is not None else ()))


def _is_actuator(channel: Channel) -> bool:
    """Whether a channel is the pitch that an actuator in the model answers with."""
    return channel.role == "state" and _PITCH.names.fullmatch(channel.name) is not None


def _controls(solution: Solution, scenario: int, step: float | None) -> Trajectory:
    """Controls of one scenario, at the nodes or every `step` seconds and at the last time."""
    count = len(solution.trajectories)
    require(1 <= scenario <= count, "scenario", scenario, f"1 to {count}")
    run = solution.trajectories[scenario - 1]
    controls = run.select(c.name for c in run.channels if c.role == "control")
    if solution.grid.held is not None:
        return _held(controls, solution, scenario)
    if step is None:
        return controls
    require(0 < step < np.inf, "step", step, "seconds, more than 0")
    count = run.duration / step
    require(count < _MOST_ROWS, "step", step, f"one that gives less than {_MOST_ROWS} rows")
    since = np.append(step * np.arange(int(np.ceil(count - 1e-9))), run.duration)
    values = solution.at(since / run.duration, scenario - 1)[1]
    return Trajectory(run.time[0] + since, values, controls.channels, name=run.name)


def _held(controls: Trajectory, solution: Solution, scenario: int) -> Trajectory:
    """Two rows at every jump: what a control was before, and is after."""
    grid, begin, duration = solution.grid, controls.time[0], controls.duration
    assert grid.held is not None
    middles = (grid.held[1:] + grid.held[:-1]) / 2
    values = solution.at(middles, scenario - 1)[1]
    ends = begin + grid.held[1:] * duration
    starts = np.append(begin, ends[:-1] + np.minimum(_JUMP, np.diff(ends) / 2))
    time = np.stack([starts, ends], axis=1).ravel()
    return Trajectory(time, np.repeat(values, 2, axis=0), controls.channels, name=controls.name)


def _chosen(run: Trajectory, kind: _Kind, name: str | None, other: str | None) -> Channel | None:
    """The control that is the pitch or the torque.

    A unit tells what a control is not, and never what it is: yaw is an angle, too.
    """
    if name is not None:
        if name not in run:
            raise DfsmError(f"{kind.what}: no control '{name}'; {near_matches(name, run.names)}")
        if factor(run.channel(name).unit, kind.unit) is None:
            raise DfsmError(
                f"{kind.what}: '{name}' is in '{run.channel(name).unit}', expected {kind.expected}"
            )
        return run.channel(name)
    possible = [c for c in run.channels if factor(c.unit, kind.unit) is not None]
    known = [c for c in possible if kind.names.fullmatch(c.name)]
    if len(known) == 1 or not possible or (other is not None and not known):
        return known[0] if known else None
    named = " or ".join(c.name for c in known or possible)
    if known:
        raise DfsmError(
            f"the {kind.what} may be {named}, all in units of {kind.expected}: name one with "
            f"--{kind.what}, or {kind.what}= in Python"
        )
    raise DfsmError(
        f"{named} in '{possible[0].unit}' has no name by which ROSCO's {kind.what} is known "
        f"({kind.examples}), and {kind.expected} may be something else: name the control with "
        f"--{kind.what} ({kind.what}= in Python), or only the {kind.counterpart} with "
        f"--{kind.counterpart}"
    )


def _write(path: Path, name: str, heads: list[str], values: Array) -> None:
    lines = [f"! Open-loop controls of {printable(name)}, written by dfsm"]
    lines.append("! " + "  ".join(printable(h) for h in heads))
    lines += ["  ".join(f"{v:.9e}" for v in row) for row in values]
    with write_file(path) as temporary:
        # ROSCO reads bytes, not letters.
        temporary.write_text("\n".join(lines) + "\n", "ascii", errors="backslashreplace")

"""Optimal torque and pitch as an open-loop input file of ROSCO, to be repeated in OpenFAST.

ROSCO (`OL_Mode = 1`) joins the rows by straight lines. Before the first row its own controllers are
at work, so that a horizon which begins at 100 s leaves 100 s for the turbine to settle.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.control.solution import Solution
from dfsm.core.files import write_file
from dfsm.core.settings import require
from dfsm.core.types import Array
from dfsm.core.units import ANGLES, TORQUES, plain
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
# How the names of blade pitch angles begin; one among the states comes from an actuator.
_PITCHES = ("bldpitch", "blpitch", "bladepitch", "ptchpmz")


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
        Controls to take; None takes the only one whose unit is an angle (rad, deg), and the only
        one whose unit is a torque (N m, kN m, MN m).
    scenario
        Which one, counted from 1.
    step
        Time between rows in s, the controls in between by the scheme's polynomials; None writes
        the nodes of the solution.
    discon
        DISCON.IN that the file is to be flown with: every limit of it that the file breaks is told
        in `notes`, and limits that are wide enough are left as they are.

    Returns
    -------
    RoscoInput

    Raises
    ------
    DfsmError
        The solve did not succeed, no control is a pitch or a torque, units that are unknown, or a
        file that cannot be written.

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
        "pitch": _chosen(run, "pitch", "an angle (rad or deg)", pitch, ANGLES),
        "torque": _chosen(run, "torque", "a torque (N m, kN m or MN m)", torque, TORQUES),
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
            channel, factor = control
            columns.append(factor * run[channel.name])
            heads.append(f"{channel.name} ({'rad' if what == 'pitch' else 'N m'})")
            number[what] = len(columns)
    rows = dict(zip(("time", *(w for w in chosen if chosen[w] is not None)), columns, strict=True))
    path = Path(path)
    _write(path, solution.name, heads, np.column_stack(columns))
    names = {what: None if control is None else control[0].name for what, control in chosen.items()}
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
    return channel.role == "state" and channel.name.lower().startswith(_PITCHES)


def _controls(solution: Solution, scenario: int, step: float | None) -> Trajectory:
    """Controls of one scenario, at the nodes or every `step` seconds and at the last time."""
    count = len(solution.trajectories)
    require(1 <= scenario <= count, "scenario", scenario, f"1 to {count}")
    run = solution.trajectories[scenario - 1]
    controls = run.select(c.name for c in run.channels if c.role == "control")
    if step is None:
        return controls
    require(0 < step < np.inf, "step", step, "seconds, more than 0")
    count = run.duration / step
    require(count < _MOST_ROWS, "step", step, f"one that gives less than {_MOST_ROWS} rows")
    since = np.append(step * np.arange(int(np.ceil(count - 1e-9))), run.duration)
    values = solution.at(since / run.duration, scenario - 1)[1]
    return Trajectory(run.time[0] + since, values, controls.channels, name=run.name)


def _chosen(
    run: Trajectory, what: str, expected: str, name: str | None, units: Mapping[str, float]
) -> tuple[Channel, float] | None:
    """The control that is the pitch or the torque, and its unit in rad or N m."""
    if name is not None:
        if name not in run:
            raise DfsmError(f"{what}: no control '{name}'; {near_matches(name, run.names)}")
        known = [run.channel(name)]
        if plain(known[0].unit) not in units:
            raise DfsmError(f"{what}: '{name}' is in '{known[0].unit}', expected {expected}")
    else:
        known = [c for c in run.channels if plain(c.unit) in units]
    if len(known) > 1:
        raise DfsmError(
            f"the {what} may be {' or '.join(c.name for c in known)}, all in units of {expected}: "
            f"name one with --{what}, or {what}= in Python"
        )
    return (known[0], units[plain(known[0].unit)]) if known else None


def _write(path: Path, name: str, heads: list[str], values: Array) -> None:
    lines = [f"! Open-loop controls of {printable(name)}, written by dfsm"]
    lines.append("! " + "  ".join(printable(h) for h in heads))
    lines += ["  ".join(f"{v:.9e}" for v in row) for row in values]
    with write_file(path) as temporary:
        # ROSCO reads bytes, not letters.
        temporary.write_text("\n".join(lines) + "\n", "ascii", errors="backslashreplace")

"""What ROSCO does to an open-loop file: which limits cut it, which do not, and what it needs.

Seen by running ROSCO 2.10.6: the pitch is cut to PC_MinPit and PC_MaxPit, and its rate to PC_MinRat
and PC_MaxRat; with PC_ControlMode 0 it is 0 throughout; PA_Mode adds an actuator of its own. The
torque passes beyond VS_MaxTq and faster than VS_MaxRat, and is 0 where the file has it negative.
None of this earns a warning of ROSCO.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from dfsm.controllers.discon import read_discon
from dfsm.core.types import Array
from dfsm.errors import DfsmError

# Limits are printed with so many digits, rounded outwards: none is broken by rounding.
_DIGITS = 5
# Values beyond a limit by less than this share of it are rounding.
_SLACK = 1e-6

CUTS = (
    "ROSCO cuts the pitch to PC_MinPit and PC_MaxPit and its rate to PC_MinRat and PC_MaxRat, lets "
    "the torque pass beyond VS_MaxTq and faster than VS_MaxRat, and makes negative torque 0"
)


def pitch_needs(time: Array, pitch: Array) -> dict[str, float]:
    """Limits that let a pitch pass, by their names in DISCON.IN, in rad and rad/s.

    Parameters
    ----------
    time, pitch
        Rows of the file in s and rad, shape ``(row,)``.
    """
    rates = np.diff(pitch) / np.diff(time)
    fastest = _outwards(float(np.abs(rates).max(initial=0.0)), up=True)
    return {
        "PC_MinPit": _outwards(float(pitch.min()), up=False),
        "PC_MaxPit": _outwards(float(pitch.max()), up=True),
        "PC_MinRat": -fastest,
        "PC_MaxRat": fastest,
    }


def _outwards(value: float, up: bool) -> float:
    """Round to a few digits, never inwards."""
    if value == 0:
        return 0.0
    unit = 10.0 ** (np.floor(np.log10(abs(value))) - _DIGITS + 1)
    rounded = np.ceil(value / unit) if up else np.floor(value / unit)
    return float(f"{rounded * unit:.{_DIGITS}g}")


def negative_torque(time: Array, torque: Array) -> str:
    """Say where a torque in N m is negative; "" where it never is."""
    at = np.flatnonzero(torque < 0)
    if not at.size:
        return ""
    return (
        f"the torque is negative in {at.size} of {len(torque)} rows, first at {time[at[0]]:.4g} s "
        f"and down to {torque.min():.4g} N m: ROSCO makes it 0 there, so bound the torque below by "
        "0 and solve again"
    )


def read_numbers(path: str | Path) -> dict[str, float]:
    """Read the numbers of a DISCON.IN by name, the first of each line.

    Raises
    ------
    DfsmError
        The file is missing, or is no DISCON file of ROSCO with limits of the pitch.
    """
    discon, values = read_discon(path), dict[str, float]()
    for key in discon.keys:
        with suppress(DfsmError, IndexError):  # a name or a file
            values[key] = discon.number(key)
    if "PC_MaxPit" not in values:
        raise DfsmError(f"{path} has no line of PC_MaxPit, expected a DISCON file of ROSCO")
    return values


def broken(
    discon: Mapping[str, float], time: Array, pitch: Array | None, torque: Array | None
) -> list[str]:
    """Say which settings of a DISCON file keep ROSCO from flying a file, and which it passes.

    Parameters
    ----------
    discon
        Numbers by name, see `read_numbers`; those that are missing are not looked at.
    time, pitch, torque
        Rows of the file in s, rad and N m, shape ``(row,)``; None without a column.

    Returns
    -------
    list of str
        A sentence each, those that change what is flown first.
    """
    told = []
    if pitch is not None:
        if discon.get("PC_ControlMode", 1) == 0:
            told.append("PC_ControlMode is 0: ROSCO flies a pitch of 0 throughout, set it to 1")
        if discon.get("PA_Mode", 0) != 0:
            told.append(
                f"PA_Mode is {discon['PA_Mode']:g}: ROSCO's own actuator comes between the file "
                "and the blades, set it to 0 unless the model contains it"
            )
        cut, slowed = "rad, ROSCO cuts the pitch there", "rad/s, ROSCO slows the pitch there"
        rates = np.diff(pitch) / np.diff(time)
        middle = (time[1:] + time[:-1]) / 2
        told += _beyond(discon, "PC_MinPit", time, pitch, cut, -1)
        told += _beyond(discon, "PC_MaxPit", time, pitch, cut, 1)
        told += _beyond(discon, "PC_MinRat", middle, rates, slowed, -1)
        told += _beyond(discon, "PC_MaxRat", middle, rates, slowed, 1)
    if torque is not None:
        rates = np.abs(np.diff(torque) / np.diff(time))
        middle = (time[1:] + time[:-1]) / 2
        told += _beyond(discon, "VS_MaxTq", time, torque, "N m, which ROSCO lets pass", 1)
        told += _beyond(discon, "VS_MaxRat", middle, rates, "N m/s, which ROSCO lets pass", 1)
    return told


def _beyond(
    discon: Mapping[str, float], key: str, time: Array, values: Array, then: str, side: int
) -> list[str]:
    """A sentence where values are beyond a limit, above it for side 1 and below for -1."""
    limit = discon.get(key)
    if limit is None or not values.size:
        return []
    excess = side * (values - limit)
    if excess.max() <= _SLACK * max(abs(limit), 1e-3):
        return []
    k, share = int(excess.argmax()), float(np.mean(excess > 0))
    return [
        f"{key} is {limit:.5g}: the file goes to {values[k]:.5g} at {time[k]:.4g} s and is beyond "
        f"for {share:.0%} of its rows ({then})"
    ]

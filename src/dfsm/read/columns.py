"""Columns of a table: which one is time, and the unit that a header holds."""

from __future__ import annotations

import re
from pathlib import Path

from dfsm.errors import DfsmError
from dfsm.trajectory import Channel

# The name, one separator at most, and the unit in brackets at the end.
HEADER = re.compile(r"(.+?)[_ ]?(?:\[([^\[\]]*)\]|\(([^()]*)\))")
TIME_NAMES = ("time", "t")
SECONDS = ("", "s", "sec", "second", "seconds")


def split_header(text: str) -> tuple[str, str]:
    """Split ``Name [unit]``, ``Name (unit)`` or ``Name_[unit]`` into name and unit ("" if none)."""
    text = text.strip()
    match = HEADER.fullmatch(text)
    if match is None:
        return text, ""
    return match[1], (match[2] if match[2] is not None else match[3]).strip()


def time_column(path: Path, channels: list[Channel], names: tuple[str, ...] = TIME_NAMES) -> int:
    """Return the column that holds the time.

    Raises
    ------
    DfsmError
        There is none, or its unit is not s.
    """
    for i, channel in enumerate(channels):
        if channel.name.lower() in names:
            if channel.unit.lower() not in SECONDS:
                raise DfsmError(
                    f"{path}: its time '{channel.name}' is in '{channel.unit}', expected s: "
                    "convert it"
                )
            return i
    shown = ", ".join(c.name for c in channels[:12]) + (", …" if len(channels) > 12 else "")
    raise DfsmError(
        f"{path}: no time column, expected one called Time, time or t (in s), found: {shown[:400]}"
    )

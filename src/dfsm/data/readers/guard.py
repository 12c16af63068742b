"""Names from files are data: in a table no spreadsheet runs them, and none becomes a path."""

from __future__ import annotations

import re
from pathlib import Path

from dfsm.errors import DfsmError

# What spreadsheets take for the beginning of a formula, behind apostrophes of our own.
_FORMULA = re.compile(r"'*[=+\-@\t\r]")
_GUARDED = re.compile(r"'+[=+\-@\t\r]")


def guarded(text: str) -> str:
    """A header cell that a spreadsheet shows as it stands: an apostrophe before a formula."""
    return f"'{text}" if _FORMULA.match(text) else text


def unguarded(text: str) -> str:
    """What `guarded` was told."""
    return text[1:] if _GUARDED.match(text) else text


def check_run_name(path: Path, name: str) -> str:
    """Refuse the name of a run that could lead elsewhere, were it a part of a file's name.

    Raises
    ------
    DfsmError
        It has a folder separator or a character that no name holds, or means a folder.
    """
    if re.search(r"[/\\\0]", name) or name in (".", ".."):
        raise DfsmError(
            f"{path}: its run is called {name[:40]!r}, but a name cannot hold '/' or '\\' or be "
            "that of a folder: write the file again under another name"
        )
    return name

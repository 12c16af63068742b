"""A result that took long is not lost where it cannot be written: it is offered elsewhere."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from dfsm.errors import DfsmError


def write_or_keep(write: Callable[[Path], object], path: str | Path) -> None:
    """Write a result; where its disk is full or gone, write it to the temporary folder.

    Parameters
    ----------
    write
        Writes to a path; see `write_file` and `write_folder` for what it raises.
    path
        Where to.

    Raises
    ------
    DfsmError
        It could not be written to `path`; says where it is instead, if anywhere.
    """
    path = Path(path)
    try:
        write(path)
    except DfsmError as error:
        # Other mistakes than the system's would be made elsewhere, too.
        cause = error.__cause__
        if not isinstance(cause, OSError):
            raise
        kept = _elsewhere(write, path.name)
        if kept is None:
            raise
        raise DfsmError(
            f"{path} could not be written ({cause.strerror or cause}), so the result is in {kept}: "
            "make room and move it"
        ) from cause


def _elsewhere(write: Callable[[Path], object], name: str) -> Path | None:
    try:
        folder = Path(tempfile.mkdtemp(prefix="dfsm-"))
    except OSError:
        return None
    try:
        write(folder / name)
        return folder / name
    except DfsmError:
        return None
    finally:
        if not (folder / name).exists():
            shutil.rmtree(folder, ignore_errors=True)

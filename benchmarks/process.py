"""One command of dfsm in a process of its own, and what it took."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path


def usage(
    place: Path,
    command: Sequence[str],
    environment: Mapping[str, str],
    fine: Collection[int] = (0,),
) -> resource.struct_rusage:
    """Processor time and memory of a command run in a folder.

    Parameters
    ----------
    place
        The folder.
    command
        What follows ``dfsm``.
    environment
        Variables of the process.
    fine
        Exit codes that are no failure.

    Raises
    ------
    RuntimeError
        Another exit code; says what the command wrote to standard error.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "dfsm", *command],
        cwd=place,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    told = process.stderr.read() if process.stderr is not None else b""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in fine:
        raise RuntimeError(f"dfsm {' '.join(command)}: {told.decode(errors='replace')}")
    return used

"""Kill every command at every file event: is what stood at its target, or is to stand there, whole?

A command is run again and again, killed before its first, second, … event on a file, until it ends
by itself. Each time its target must be what it was or what it is to be, and the command must work
afterwards and leave nothing else behind. With `full`, the disk is full from that event on instead.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

# Run before a command: counts what Python does to files below the working folder.
INJECTED = """
import errno, os, signal, sys
LIMIT, FULL, BELOW = int(os.environ["DFSM_KILL_AT"]), os.environ["DFSM_KILL_FULL"], os.getcwd()
EVENTS = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.chmod", "os.truncate", "os.link",
          "os.symlink", "shutil.rmtree", "tempfile.mkstemp", "tempfile.mkdtemp", "open"}
seen = 0
def event(name, arguments):
    global seen
    if name not in EVENTS or not isinstance(arguments[0], (str, bytes, os.PathLike)):
        return
    if name == "open" and not (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        return
    if not os.path.abspath(os.fsdecode(arguments[0])).startswith(BELOW):
        return
    seen += 1
    if seen < LIMIT:
        return
    if FULL != "1":
        os.kill(os.getpid(), signal.SIGKILL)
    if name in ("os.mkdir", "os.rename", "open"):
        raise OSError(errno.ENOSPC, "No space left on device", os.fsdecode(arguments[0]))
sys.addaudithook(event)
"""
COMMAND = INJECTED + "from dfsm.cli import main\nmain()\n"


def content(path: Path) -> Mapping[str, bytes] | None:
    """What a file or folder holds but for what begins with a dot; None where there is nothing."""
    if path.is_file():
        return {"": path.read_bytes()}
    if not path.exists():
        return None
    files = (p for p in sorted(path.rglob("*")) if p.is_file())
    named = {str(p.relative_to(path)): p.read_bytes() for p in files}
    return {n: b for n, b in named.items() if not any(x.startswith(".") for x in Path(n).parts)}


def attempt(
    code: str, arguments: Sequence[str], folder: Path, at: int, full: bool
) -> subprocess.CompletedProcess[str]:
    """Run Python code in a folder, ended before an event on files."""
    environment = os.environ | {"DFSM_KILL_AT": str(at), "DFSM_KILL_FULL": str(int(full))}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def killed_everywhere(
    arguments: Sequence[str],
    source: Path,
    target: str,
    *,
    code: str = COMMAND,
    full: bool = False,
    whole: Mapping[str, object] | None = None,
) -> tuple[int, list[str]]:
    """End a command at every event, each time in a fresh copy of a folder.

    Parameters
    ----------
    arguments
        Of the command.
    source
        Folder to copy; the command runs in the copy.
    target
        What it writes.
    code
        Python code to run instead of the command line.
    full
        Whether the disk is full instead.
    whole
        By file name in the target what it may hold besides what stood there; anything by default,
        as long as the set of files is that of a finished run.

    Returns
    -------
    tuple
        Number of events, and one sentence per thing that went wrong.
    """
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as base:
        ended = Path(base) / "ended"
        shutil.copytree(source, ended, symlinks=True)
        before = content(ended / target)
        done = attempt(code, arguments, ended, 10**9, False)
        after = content(ended / target)
        if done.returncode not in (0, 1) or after is None:
            return 0, [f"{' '.join(arguments)} did not work: {done.stderr[-300:]}"]
        at = 0
        while True:
            at += 1
            folder = Path(base) / str(at)
            shutil.copytree(source, folder, symlinks=True)
            done = attempt(code, arguments, folder, at, full)
            if done.returncode in (0, 1):
                return at - 1, wrong
            where = f"{' '.join(arguments)}, event {at}"
            found = content(folder / target)
            if found != before and (found is None or set(found) != set(after)):
                wrong.append(f"{where}: the target is neither old nor new")
            if full and (done.returncode != 2 or done.stderr.count("\n") != 1):
                wrong.append(f"{where}: exit {done.returncode}, {done.stderr[-200:]!r}")
            if not full:
                again = attempt(code, arguments, folder, 10**9, False)
                if again.returncode not in (0, 1):
                    wrong.append(f"{where}: does not go on, {again.stderr[-200:]!r}")
            shutil.rmtree(folder)

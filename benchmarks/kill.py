"""Kill every command at every file event: is what stands at its target whole, old or new?

A command is run again and again in copies of one folder, killed before its first, second, … event
on a file, until it ends by itself. Each time its target must be what it was or what it is to be,
and the command must work afterwards and leave nothing else behind. Then the same with a disk that
is full from that event on: one sentence, exit code 2, and the target as it was.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dfsm
from dfsm.core.bundle import checksum
from dfsm.core.exchange import recover

# What Python does to files; writing itself is between the events, in temporary files.
EVENTS = {
    *("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.chmod", "os.truncate"),
    *("os.link", "os.symlink", "shutil.rmtree", "tempfile.mkstemp", "tempfile.mkdtemp"),
}
# Those that a full disk refuses.
_GROWS = {"open", "os.rename", "os.mkdir"}
_NEVER = 10**9


@dataclass(frozen=True)
class Ended:
    """How a run of a command ended: exit code, negative for a signal, and standard error."""

    code: int
    err: str


# A command in a folder, ended at an event, by a kill or by a full disk.
Attempt = Callable[[Path, int, bool], Ended]


def end_at(limit: int, full: bool) -> None:
    """End this process before an event on a file below its working folder.

    Parameters
    ----------
    limit
        Number of the event, from 1.
    full
        Let this event and all later ones find the disk full instead.
    """
    below, seen = str(Path.cwd()), 0

    def event(name: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if name not in EVENTS or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        changes = os.O_WRONLY | os.O_RDWR | os.O_CREAT
        if name == "open" and not (arguments[2] or 0) & changes:
            return
        where = os.path.abspath(os.fsdecode(arguments[0]))  # noqa: PTH100
        if not where.startswith(below):
            return
        seen += 1
        if seen < limit:
            return
        if not full:
            os.kill(os.getpid(), signal.SIGKILL)
        if name in _GROWS:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), where)

    sys.addaudithook(event)


def command(*arguments: str) -> Attempt:
    """A command of the command line, in a process of its own."""
    roots = [str(Path(__file__).parents[1]), str(Path(dfsm.__file__).parents[1])]

    def attempt(folder: Path, at: int, full: bool) -> Ended:
        code = (
            f"from benchmarks.kill import end_at; end_at({at}, {full}); "
            "from dfsm.cli import main; main()"
        )
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(roots)},
            capture_output=True,
            text=True,
            timeout=900,
            check=False,
        )
        return Ended(done.returncode, done.stderr)

    return attempt


def forked(work: Callable[[], object]) -> Attempt:
    """A function of this process, in a copy of it: quick, for processes without threads."""

    def attempt(folder: Path, at: int, full: bool) -> Ended:
        child = os.fork()
        if child:
            return Ended(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), "")
        code = 2
        try:
            os.chdir(folder)
            end_at(at, full)
            work()
            code = 0
        finally:
            os._exit(code)

    return attempt


def killed_everywhere(
    attempt: Attempt, source: Path, target: str, *, full: bool = False, in_steps: bool = False
) -> tuple[int, list[str]]:
    """End a command at every event, each time in a fresh copy of a folder.

    Parameters
    ----------
    attempt
        Runs it.
    source
        Folder to copy.
    target
        What it writes.
    full
        Whether the disk is full from that event on instead.
    in_steps
        Whether the target may be away until the next start, as without Linux's exchange.

    Returns
    -------
    tuple
        Number of events, and one sentence per thing that went wrong.
    """
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as base:
        whole = Path(base) / "whole"
        shutil.copytree(source, whole, symlinks=True)
        before = content(whole / target)
        done = attempt(whole, _NEVER, False)
        after = content(whole / target)
        if done.code not in (0, 1) or after is None:
            return 0, [f"exit {done.code} undisturbed: {done.err[-300:]}"]
        at = 0
        while True:
            at += 1
            folder = Path(base) / str(at)
            shutil.copytree(source, folder, symlinks=True)
            done = attempt(folder, at, full)
            if done.code in (0, 1):
                return at - 1, wrong
            if in_steps:
                recover(folder / target)
            found = content(folder / target)
            if found not in (before, after) and not (found and is_whole(found, after)):
                wrong.append(f"event {at}: the target is neither old nor new")
            if full and (done.code != 2 or done.err.count("\n") > 1):
                wrong.append(f"event {at}: exit {done.code}, {done.err[-300:]!r}")
            if not full:
                again = attempt(folder, _NEVER, False)
                left = sorted(p.name for p in folder.rglob(".*dfsm-*"))
                if again.code not in (0, 1) or left:
                    wrong.append(f"event {at}: then exit {again.code}, left {left}, {again.err!r}")
            shutil.rmtree(folder)


def content(path: Path) -> Mapping[str, bytes] | None:
    """What a file or folder holds but for what begins with a dot; None where there is nothing."""
    if path.is_file():
        return {"": path.read_bytes()}
    if not path.exists():
        return None
    files = (p for p in sorted(path.rglob("*")) if p.is_file())
    named = {str(p.relative_to(path)): p.read_bytes() for p in files}
    return {n: b for n, b in named.items() if not any(x.startswith(".") for x in Path(n).parts)}


def is_whole(found: Mapping[str, bytes], expected: Mapping[str, bytes]) -> bool:
    """Whether something is a complete result, though its wall times may be others."""
    if set(found) != set(expected):
        return False
    for name, raw in found.items():
        if name.endswith("manifest.json"):
            manifest = json.loads(raw)
            arrays = [b for n, b in found.items() if n.endswith(".safetensors")]
            digests = [hashlib.sha256(b).hexdigest() for b in arrays]
            if manifest["checksum"] != checksum(manifest) or manifest["sha256"] not in digests:
                return False
        elif raw[:1] == b"{":
            json.loads(raw)
        elif raw[-8:] != expected[name][-8:]:
            return False
    return True

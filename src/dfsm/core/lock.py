"""One process at a time writes to a place; the system lets go when a process is killed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dfsm.errors import DfsmError

try:
    import fcntl
except ImportError:  # Windows: without locks, as in version 0.1
    fcntl = None

# What this process has locked, and how often.
_held: dict[Path, int] = {}


@contextmanager
def locked(path: str | Path) -> Iterator[None]:
    """Keep other processes from writing to `path`, a file or folder that need not exist.

    The lock is a file ``.NAME.dfsm-lock`` beside it, gone afterwards. One that a killed process
    left behind locks nothing. Where no such file can be made, nobody is kept out. A process may
    take a lock again that it holds.

    Raises
    ------
    DfsmError
        Another process holds the lock.
    """
    place = Path(path).absolute()
    file = place.with_name(f".{place.name}.dfsm-lock")
    handle = None if fcntl is None or place in _held else _acquire(file, Path(path))
    _held[place] = _held.get(place, 0) + 1
    try:
        yield
    finally:
        _held[place] -= 1
        if not _held[place]:
            del _held[place]
        if handle is not None:
            file.unlink(missing_ok=True)
            os.close(handle)


def _acquire(file: Path, path: Path) -> int | None:
    """Handle of the locked file; None where the file system has no room, rights or locks."""
    assert fcntl is not None
    while True:
        try:
            handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            return None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Its last owner may have removed it since it was opened: then it locks nothing.
            current = file.stat().st_ino == os.fstat(handle).st_ino
        except BlockingIOError:
            owner = os.read(handle, 20).decode(errors="replace").strip()
            os.close(handle)
            raise DfsmError(
                f"{path} is being written by another process{f' ({owner})' if owner else ''}: "
                "wait until it has ended, or choose another name"
            ) from None
        except FileNotFoundError:
            current = False
        except OSError:
            os.close(handle)
            return None
        if current:
            os.truncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
            return handle
        os.close(handle)

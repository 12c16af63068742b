"""A new folder in the place of an old one: whenever a process ends, one of them is there, whole.

Linux exchanges two names in one step. Elsewhere the old folder steps aside first; a process that
is killed before the new one is in place leaves it there, and `recover` puts it back.
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import tempfile
from glob import escape
from pathlib import Path

from dfsm.core.lock import locked
from dfsm.errors import DfsmError

# Of Linux: paths are relative to the working folder; both names must exist and change places.
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
# What a kernel or a file system without the exchange answers.
_UNKNOWN = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP}
# What a file system answers that cannot make a folder's entries durable.
_NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES, errno.EISDIR}


def exchange(new: Path, path: Path) -> None:
    """Put the complete folder `new` in the place of `path`, which need not exist.

    What stood there is removed, or at `new`, for the caller to remove.

    Raises
    ------
    OSError
        It could not be done; `path` is what it was.
    """
    settle(new)
    if not path.exists():
        new.rename(path)
    elif not swap(new, path):
        _in_two_steps(new, path)
    settle_names(path.parent)


def swap(one: Path, other: Path) -> bool:
    """Exchange two names in one step; False where the system or the file system cannot.

    Raises
    ------
    OSError
        The system can, but did not.
    """
    if os.name == "nt":
        return False
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    first, second = (ctypes.c_char_p(os.fsencode(name)) for name in (one, other))
    if call(_AT_FDCWD, first, _AT_FDCWD, second, ctypes.c_uint(_RENAME_EXCHANGE)) == 0:
        return True
    number = ctypes.get_errno()
    if number in _UNKNOWN:
        return False
    raise OSError(number, os.strerror(number), str(other))


def _in_two_steps(new: Path, path: Path) -> None:
    aside = Path(tempfile.mkdtemp(prefix=_aside(path), dir=path.parent))
    old = aside / "replaced"
    try:
        path.rename(old)
        new.rename(path)
    except BaseException:
        if old.exists() and not path.exists():
            old.rename(path)
        raise
    finally:
        # What could not go back is all that there is: `recover` finds it.
        if path.exists():
            shutil.rmtree(aside, ignore_errors=True)


def beginning(path: Path) -> str:
    """How the names of temporary files and folders begin that are to take the place of `path`."""
    return f".{path.name}.dfsm-new-"


def _aside(path: Path) -> str:
    return f".{path.name}.dfsm-old-"


def recover(path: Path) -> None:
    """Put back the folder that a killed process left aside, and remove what else it left.

    Call it before `path` is read or replaced. Where another process is writing, or nothing was
    left, it does nothing.
    """
    if not _left(path):
        return
    try:
        with locked(path):
            for aside in sorted(path.parent.glob(f"{escape(_aside(path))}*")):
                if not path.exists() and (aside / "replaced").is_dir():
                    (aside / "replaced").rename(path)
            for left in _left(path):
                if left.is_dir():
                    shutil.rmtree(left, ignore_errors=True)
                else:
                    left.unlink(missing_ok=True)
    except (DfsmError, OSError):
        return


def _left(path: Path) -> list[Path]:
    try:
        starts = (escape(start) for start in (_aside(path), beginning(path)))
        found = [p for start in starts for p in path.parent.glob(f"{start}*")]
    except OSError:
        return []
    return [p for p in found if not p.is_symlink()]


def settle(path: Path) -> None:
    """Wait until a file, or a folder and all in it, is on the disk and not only on its way."""
    if path.is_dir():
        for entry in path.iterdir():
            if not entry.is_symlink():
                settle(entry)
        settle_names(path)
        return
    handle = os.open(path, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def settle_names(folder: Path) -> None:
    """The same for the names in a folder, where its file system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise
    finally:
        os.close(handle)

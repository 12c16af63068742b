"""Writing without ever leaving a half-written file: a temporary sibling, then a rename."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dfsm.errors import DfsmError


@contextmanager
def write_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes the place of `path`.

    On any failure, Ctrl-C included, the temporary file is removed and what stood at `path`
    before is untouched.

    Raises
    ------
    DfsmError
        The folder does not exist, cannot be written, or the disk is full.
    """
    path = Path(path)
    if path.is_dir():
        raise DfsmError(f"{path} is a folder, a file name was expected: give one, or remove it")
    with _sentences(path):
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            temporary.chmod(0o666 & ~_umask())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def write_folder(path: str | Path, *, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; on success it takes the place of `path`.

    An existing folder is replaced only where `is_ours` says that it holds nothing but what
    this package wrote, so that a mistyped `-o` never costs a user their results.

    Raises
    ------
    DfsmError
        `path` exists and is not ours, or cannot be written.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and (not any(path.iterdir()) or is_ours(path))):
        raise DfsmError(
            f"{path} exists and is not a folder that dfsm wrote: choose another name or remove it"
        )
    with _sentences(path):
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            yield temporary
            temporary.chmod(0o777 & ~_umask())
            if path.exists():
                old = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
                path.rename(old / "replaced")
                try:
                    temporary.rename(path)
                except BaseException:
                    (old / "replaced").rename(path)
                    raise
                finally:
                    shutil.rmtree(old, ignore_errors=True)
            else:
                temporary.rename(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _sentences(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DfsmError(
            f"{path} could not be written ({error.strerror or error}); nothing was left behind: "
            "make room or choose another place"
        ) from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

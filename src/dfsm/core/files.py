"""Writing without ever leaving a half-written file: a temporary sibling, then a rename."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dfsm.core.version import __version__
from dfsm.errors import DfsmError, near_matches


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
    _check_ordinary(path)
    # The file that a link points to is replaced, not the link.
    path = path.resolve() if path.is_symlink() else path
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
    check_folder(path, is_ours=is_ours)
    with _sentences(path):
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            yield temporary
            temporary.chmod(0o777 & ~_umask())
            for file in temporary.iterdir():
                file.chmod(0o666 & ~_umask())
            _exchange(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def check_file(path: str | Path, sources: Iterable[str | Path | None] = ()) -> None:
    """Fail where `write_file` would fail: call it before long work, not after.

    Parameters
    ----------
    path
        File to write.
    sources
        Files that the work reads, which must not be lost to its result.

    Raises
    ------
    DfsmError
        `path` is a folder or one of `sources`, or its parent is no folder or read-only.
    """
    path = Path(path)
    _check_ordinary(path)
    _check_parent(path)
    if path.exists() and any(s is not None and path.samefile(s) for s in sources):
        raise DfsmError(f"{path} is one of the files to read: choose another name to write to")


def check_format(path: Path, version: int, newest: int) -> None:
    """Refuse what a newer dfsm wrote.

    Raises
    ------
    DfsmError
        Names both numbers and the remedy.
    """
    if version > newest:
        raise DfsmError(
            f"{path} has format {version}, this dfsm {__version__} reads up to {newest}: "
            "upgrade with pip install -U dfsm"
        )


def check_folder(path: str | Path, *, is_ours: Callable[[Path], bool]) -> None:
    """Fail where `write_folder` would refuse: call it before long work, not after.

    Raises
    ------
    DfsmError
        `path` exists and is not ours, or its parent is no folder.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and (not any(path.iterdir()) or is_ours(path))):
        raise DfsmError(
            f"{path} exists and is not a folder that dfsm wrote: choose another name or remove it"
        )
    if path.exists() and (path.samefile(Path.cwd()) or path.is_mount()):
        raise DfsmError(
            f"{path} is the working folder or a mount point, which cannot be replaced in one step: "
            "give the name of a folder in it"
        )
    _check_parent(path)


def _check_ordinary(path: Path) -> None:
    if path.is_dir():
        raise DfsmError(f"{path} is a folder, a file name was expected: give one, or remove it")
    if path.exists() and not path.is_file():
        raise DfsmError(f"{path} is a device or a pipe, a file name was expected: give one")


def _check_parent(path: Path) -> None:
    if not path.parent.is_dir():
        raise DfsmError(
            f"{path} could not be written: there is no folder {path.parent}, make it first"
        )
    if not os.access(path.parent, os.W_OK):
        raise DfsmError(
            f"{path} could not be written: the folder {path.parent} is read-only, choose another"
        )


def _exchange(new: Path, path: Path) -> None:
    """Put `new` in the place of `path`; what stood there comes back if that fails."""
    if not path.exists():
        new.rename(path)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
    old = aside / "replaced"
    try:
        path.rename(old)
        new.rename(path)
    except BaseException:
        if old.exists() and not path.exists():
            old.rename(path)
        raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)


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


def write_json(path: str | Path, value: object) -> None:
    """Write JSON atomically; numbers that are not finite become null, which JSON can hold."""
    with write_file(path) as temporary:
        temporary.write_bytes(json_bytes(value))


def json_bytes(value: object) -> bytes:
    """Return what `write_json` writes."""
    text = json.dumps(json_value(value), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    # What UTF-8 cannot hold (bytes of a foreign file name) becomes an escape that JSON knows.
    return text.encode("utf-8", errors="backslashreplace")


def json_value(value: Any) -> Any:
    """Turn nested mappings, sequences and numbers into what strict JSON can hold."""
    if isinstance(value, Mapping):
        return {str(k): json_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def existing_file(path: str | Path) -> Path:
    """Return the path of a readable, non-empty file.

    Raises
    ------
    DfsmError
        Nothing is there (near names in the folder are suggested), it is a folder, it is empty,
        or it cannot be opened.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise DfsmError(f"{path} is a folder, a file was expected: give its files, as {path}/*")
        with path.open("rb") as stream:
            empty = not stream.read(1)
    except FileNotFoundError:
        raise DfsmError(f"{path}: no such file; {_siblings(path)}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise DfsmError(
            f"{path} cannot be read ({reason}): check the name and its rights"
        ) from None
    if empty:
        raise DfsmError(
            f"{path} is empty: the simulation wrote nothing, or the copy failed; redo it"
        )
    return path


def _siblings(path: Path) -> str:
    try:
        files = sorted(p.name for p in path.parent.iterdir() if p.is_file())
    except OSError:
        return f"its folder {path.parent} does not exist either: check the path"
    return f"in {path.parent}, {near_matches(path.name, files)}"

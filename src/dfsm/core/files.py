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

from dfsm.core.exchange import beginning, exchange, recover, settle, settle_names
from dfsm.core.lock import locked
from dfsm.core.version import __version__
from dfsm.errors import DfsmError, near_matches


@contextmanager
def write_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes the place of `path`.

    On any failure, Ctrl-C included, the temporary file is removed and what stood at `path`
    before is untouched. The new file is on the disk before it has the name.

    Raises
    ------
    DfsmError
        The folder does not exist, cannot be written, the disk is full, or another process is
        writing the file.
    """
    path = Path(path)
    _check_ordinary(path)
    # The file that a link points to is replaced, not the link.
    path = path.resolve() if path.is_symlink() else path
    with _sentences(path), locked(path):
        recover(path)
        handle, name = tempfile.mkstemp(prefix=beginning(path), dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            temporary.chmod(0o666 & ~_umask())
            settle(temporary)
            temporary.replace(path)
            settle_names(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def write_folder(path: str | Path, *, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; on success it takes the place of `path`.

    An existing folder is replaced only where `is_ours` says that it holds nothing but what
    this package wrote, so that a mistyped `-o` never costs a user their results. Whenever the
    process is killed, `path` is whole: the old folder or the new one. What the system or a file
    manager keeps in it, in names that begin with a dot, is copied into the new one.

    Raises
    ------
    DfsmError
        `path` exists and is not ours, is being written by another process, or cannot be written.
    """
    path = Path(path)
    check_folder(path, is_ours=is_ours)
    # The folder that a link points to is replaced, not the link.
    path = path.resolve() if path.is_symlink() else path
    with _sentences(path), locked(path):
        recover(path)
        temporary = Path(tempfile.mkdtemp(prefix=beginning(path), dir=path.parent))
        try:
            yield temporary
            temporary.chmod(0o777 & ~_umask())
            for file in temporary.iterdir():
                file.chmod(0o666 & ~_umask())
            _copy_hidden(path, temporary)
            exchange(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def write_together(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; on success `path` holds its files beside its own.

    For results of several files that belong together, in a folder where others may lie. Whenever
    the process is killed, all of them are the old ones or all are the new ones, and other files
    stay. Where the folder cannot be replaced (the working folder, a mount point, one in a
    read-only folder) or its file system has no hard links, each file is replaced in one step, one
    after the other.

    Raises
    ------
    DfsmError
        `path` is a file, is being written by another process, or cannot be written.
    """
    check_together(path)
    path = Path(path)
    # The folder that a link points to is replaced, not the link.
    path = path.resolve() if path.is_symlink() else path
    fixed = _is_fixed(path)
    with _sentences(path), locked(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        recover(path)
        beside = None if fixed else path.parent
        temporary = Path(tempfile.mkdtemp(prefix=beginning(path), dir=beside))
        try:
            yield temporary
            temporary.chmod(0o777 & ~_umask())
            files = sorted(temporary.iterdir())
            for file in files:
                file.chmod(0o666 & ~_umask())
            if fixed or not _link_others(path, temporary):
                _replace_each(files, path)
            else:
                exchange(temporary, path)
                _bring_back(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def check_together(path: str | Path, names: Iterable[str] = ()) -> None:
    """Fail where `write_together` would fail: call it before long work, not after.

    Parameters
    ----------
    path
        Folder of the results.
    names
        Files that will be written into it.

    Raises
    ------
    DfsmError
        `path` is a file, cannot be made, or holds a folder of one of these names.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise DfsmError(f"{path} is a file, a folder was expected: choose another name")
    recover(path)
    if path.is_dir():
        for name in names:
            _check_ordinary(path / name)
    # The folders on the way are made when there is something to write.
    above = path.absolute() if _is_fixed(path) else path.absolute().parent
    while not above.exists():
        above = above.parent
    _check_parent(above / path.name)


def _is_fixed(folder: Path) -> bool:
    """Whether a folder can be written to but not be replaced by another."""
    return folder.exists() and (
        folder.samefile(Path.cwd()) or folder.is_mount() or not os.access(folder.parent, os.W_OK)
    )


def _replace_each(files: Iterable[Path], folder: Path) -> None:
    for file in files:
        with write_file(folder / file.name) as temporary:
            shutil.copyfile(file, temporary)


def _link_others(old: Path, new: Path) -> bool:
    """Give what a folder holds another name in the one that replaces it; False where it cannot."""
    try:
        for entry in sorted(old.iterdir()) if old.is_dir() else ():
            if (new / entry.name).exists():
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.copytree(entry, new / entry.name, symlinks=True, copy_function=os.link)
            else:
                os.link(entry, new / entry.name, follow_symlinks=False)
    except (OSError, shutil.Error):
        return False
    return True


def _bring_back(old: Path, new: Path) -> None:
    """Move what was put into a folder while it was being replaced."""
    for entry in old.iterdir() if old.is_dir() else ():
        if not (new / entry.name).exists():
            entry.rename(new / entry.name)


def visible(folder: Path) -> set[str]:
    """Names in a folder but for those that begin with a dot, which systems put there."""
    return {p.name for p in folder.iterdir() if not p.name.startswith(".")}


def _copy_hidden(old: Path, new: Path) -> None:
    for entry in old.iterdir() if old.is_dir() else ():
        if not entry.name.startswith("."):
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, new / entry.name, symlinks=True)
        elif entry.is_file() or entry.is_symlink():
            shutil.copy2(entry, new / entry.name, follow_symlinks=False)


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
    recover(path)
    if path.exists() and not (path.is_dir() and (_is_empty(path) or is_ours(path))):
        raise DfsmError(
            f"{path} exists and is not a folder that dfsm wrote: choose another name or remove it"
        )
    if path.exists() and (path.samefile(Path.cwd()) or path.is_mount()):
        raise DfsmError(
            f"{path} is the working folder or a mount point, which cannot be replaced in one step: "
            "give the name of a folder in it"
        )
    _check_parent(path)


def _is_empty(folder: Path) -> bool:
    # A folder in it may be somebody's, whatever its name.
    return not any(p.is_dir() or not p.name.startswith(".") for p in folder.iterdir())


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


@contextmanager
def _sentences(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, DfsmError) as error:
        # What was to be a part of a folder is told of by the folder's name.
        cause = error.__cause__ if isinstance(error, DfsmError) else error
        if not isinstance(cause, OSError):
            raise
        raise DfsmError(
            f"{path} could not be written ({cause.strerror or cause}); nothing was left behind: "
            "make room or choose another place"
        ) from cause


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
        files = sorted(p.name for p in path.parent.iterdir() if p.is_file() and p.name[0] != ".")
    except OSError:
        return f"its folder {path.parent} does not exist either: check the path"
    return f"in {path.parent}, {near_matches(path.name, files)}"

"""Compiled code kept between processes, in the user's cache folder.

A rollout of 600 s takes hundredths of a second, and compiling it for the first time takes seconds.
JAX can keep what it compiles, but writes entries in place, so that a process that is killed leaves
half of one for good, and without a limit. `Entries` keeps them as files that are written beside and
renamed, bear a digest, and make room for one another.

``DFSM_CACHE`` names another folder, or switches this off (``off``). Where the user has set JAX's
own cache (``JAX_COMPILATION_CACHE_DIR``), nothing is done here.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
from jax._src import compilation_cache

# Bytes in the folder beyond which the entries that were not used for longest go, and what is left.
LIMIT, KEPT = 512_000_000, 384_000_000
_SUFFIX, _BESIDE = ".compiled", ".writing"
# Seconds after which a file that is still being written belongs to a process that was killed.
_ABANDONED = 3600.0
_OFF = ("off", "no", "false", "0", "none")
_DIGEST = hashlib.sha256().digest_size


def keep_compiled() -> None:
    """Let JAX keep what this process compiles, and take what others have compiled.

    Settings of the user's own are not touched, and a folder that cannot be used is none.
    """
    folder = cache_folder()
    chosen = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None or chosen is not None:
        return
    opened = getattr(compilation_cache, "get_file_cache", None)
    if opened is None:  # a JAX that does it in another way compiles every time
        return
    entries = Entries(folder)
    if not entries.usable:
        return

    def open_cache(path: str) -> Any:
        return (entries, path) if path == str(folder) else opened(path)

    compilation_cache.get_file_cache = open_cache
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # Small programs are many, and each takes longer to compile than to read.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def cache_folder() -> Path | None:
    """Where compiled code is kept; None where it is not.

    One folder for each kind of processor and version: code for one may not run on another, and a
    home folder may be shared by many.
    """
    chosen = os.environ.get("DFSM_CACHE", "").strip()
    if chosen.lower() in _OFF:
        return None
    try:
        base = Path(chosen).expanduser() if chosen else _user_cache() / "dfsm"
    except RuntimeError:  # a user without a home
        return None
    told = f"{platform.machine()} {_processor()} {sys.platform} {jax.__version__}"
    return base.absolute() / f"jax-{hashlib.sha256(told.encode()).hexdigest()[:16]}"


def _user_cache() -> Path:
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA")
        return Path(local) if local else Path.home() / "AppData" / "Local"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    return Path(chosen) if Path(chosen).is_absolute() else Path.home() / ".cache"


def _processor() -> str:
    """What a processor can do, as far as the system tells."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").split("\n\n")[0]
        told = [x for x in lines.splitlines() if x.startswith(("flags", "Features", "model name"))]
        return " ".join(told)
    return platform.processor()


class Entries:
    """Files by key, as JAX's cache wants them.

    Nothing that goes wrong here is an error: what cannot be read is compiled again, what cannot be
    written is not kept.

    Parameters
    ----------
    folder
        Where they are; made with access for the user alone.
    limit, kept
        Bytes beyond which old entries go, and how many stay.
    """

    def __init__(self, folder: Path, limit: int = LIMIT, kept: int = KEPT) -> None:
        # JAX looks at the name.
        self._path = self.folder = folder
        self.limit, self.kept = limit, kept
        self.usable = _private(folder)
        self._size: int | None = None

    def get(self, key: str) -> bytes | None:
        """The entry of a key; None where there is none, or none that is whole."""
        path = self._file(key)
        try:
            content = path.read_bytes()
        except OSError:
            return None
        value = content[_DIGEST:]
        if hashlib.sha256(value).digest() != content[:_DIGEST]:
            with suppress(OSError):
                path.unlink()
            return None
        with suppress(OSError):
            os.utime(path)  # used now
        return value

    def put(self, key: str, value: bytes) -> None:
        """Keep an entry; another process may be writing the same."""
        content = hashlib.sha256(value).digest() + value
        with suppress(OSError):
            self._make_room(len(content))
            handle, beside = tempfile.mkstemp(_BESIDE, dir=self.folder)
            try:
                with os.fdopen(handle, "wb") as stream:
                    stream.write(content)
                Path(beside).replace(self._file(key))
            except BaseException:
                Path(beside).unlink(missing_ok=True)
                raise

    def clear(self) -> None:
        """Drop all entries."""
        for path, *_ in self._listed():
            with suppress(OSError):
                path.unlink()

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}{_SUFFIX}"

    def _listed(self) -> list[tuple[Path, float, int]]:
        """Path, time of last use and size of every entry; what was left half-written goes."""
        listed = []
        with os.scandir(self.folder) as found:
            for entry in found:
                with suppress(OSError):  # another process may have been faster
                    told = entry.stat()
                    if entry.name.endswith(_SUFFIX):
                        listed.append((Path(entry.path), told.st_mtime, told.st_size))
                    elif entry.name.endswith(_BESIDE) and told.st_mtime < time.time() - _ABANDONED:
                        Path(entry.path).unlink()
        return listed

    def _make_room(self, more: int) -> None:
        if self._size is None or self._size + more > self.limit:
            # Other processes write, too: what is there is counted again.
            listed = sorted(self._listed(), key=lambda one: one[1])
            self._size = sum(size for *_, size in listed)
            if self._size + more > self.limit:
                for path, _, size in listed:
                    if self._size + more <= self.kept:
                        break
                    path.unlink(missing_ok=True)
                    self._size -= size
        self._size += more


def _private(folder: Path) -> bool:
    """Whether a folder is there and nobody else can write to it: its content is executed."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        told = folder.stat()
        return not hasattr(os, "getuid") or (
            told.st_uid == os.getuid() and not told.st_mode & 0o022
        )
    except OSError:
        return False

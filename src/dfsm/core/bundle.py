"""Arrays in safetensors and a readable JSON manifest, together in a folder.

Nothing in the folder is executed when it is read, and damage is told from the digests.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from dfsm.core.files import check_format, json_bytes, json_value, write_folder
from dfsm.core.types import Array
from dfsm.core.version import __version__
from dfsm.errors import DfsmError

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Bundle:
    """One kind of folder.

    Attributes
    ----------
    tensors
        Name of the file with the arrays.
    format
        Newest number of the manifest's layout that can be read.
    cure
        What else than restoring the folder helps when it is damaged.
    """

    tensors: str
    format: int
    cure: str

    def write(
        self,
        path: str | Path,
        tensors: Mapping[str, Array],
        content: Mapping[str, Any],
        is_ours: Callable[[Path], bool],
        pages: Mapping[str, Callable[[Path], object]] | None = None,
    ) -> None:
        """Write a folder in one step, in the place of one that `is_ours`.

        Parameters
        ----------
        path
            Folder to make.
        tensors, content
            Arrays by name, and what else the manifest says.
        is_ours
            See `write_folder`.
        pages
            By file name what writes a page about them, into the same folder in the same step.
        """
        # Made in memory: the library that writes them does not tell a full disk from a bug.
        arrays = save({name: np.asarray(a, order="C") for name, a in tensors.items()})
        with write_folder(path, is_ours=is_ours) as folder:
            (folder / self.tensors).write_bytes(arrays)
            manifest = {
                "format": self.format,
                "dfsm": __version__,
                "sha256": hashlib.sha256(arrays).hexdigest(),
                **content,
            }
            (folder / MANIFEST).write_bytes(json_bytes(signed(manifest)))
            for name, write in (pages or {}).items():
                write(folder / name)

    def read_manifest(self, path: Path) -> dict[str, Any]:
        """Read and check the manifest of a folder that holds one."""
        try:
            manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise self.damaged(path, f"{MANIFEST} cannot be read ({error})") from None
        version = manifest.get("format") if isinstance(manifest, dict) else None
        if not isinstance(version, int):
            raise self.damaged(path, f"{MANIFEST} states no format number")
        check_format(path, version, self.format)
        if manifest.get("checksum") != checksum(manifest):
            raise self.damaged(path, f"{MANIFEST} is not as it was written")
        return manifest

    def read_tensors(self, path: Path, manifest: Mapping[str, Any]) -> dict[str, Array]:
        """Read the arrays that the manifest was written for."""
        file = path / self.tensors
        try:
            content = file.read_bytes()
        except OSError as error:
            raise self.damaged(path, f"{file.name} cannot be read ({error.strerror})") from None
        if hashlib.sha256(content).hexdigest() != manifest.get("sha256"):
            raise self.damaged(path, f"{file.name} is not the file that {MANIFEST} was written for")
        try:
            return load(content)
        except (SafetensorError, ValueError, TypeError, KeyError) as error:
            raise self.damaged(path, f"{file.name} cannot be read ({error})") from None

    def damaged(self, path: Path, what: str) -> DfsmError:
        """The error about a folder that is not as it was written."""
        return DfsmError(f"{path} is damaged: {what}; {self.cure} or restore the folder")


def check_no_bundle(folder: Path) -> None:
    """Refuse to write files of other kinds among those of a model or a solution.

    Raises
    ------
    DfsmError
        `folder` is one.
    """
    arrays = sorted(folder.glob("*.safetensors")) if (folder / MANIFEST).exists() else []
    if arrays:
        raise DfsmError(
            f"{folder} holds {MANIFEST} and {arrays[0].name}, a model or a solution, which other "
            "files would damage: choose another folder"
        )


def checksum(content: Mapping[str, Any]) -> str:
    """Digest of all that a mapping of JSON values says, however its JSON is laid out."""
    said = {k: v for k, v in content.items() if k != "checksum"}
    return hashlib.sha256(json.dumps(json_value(said), sort_keys=True).encode()).hexdigest()


def signed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The same with its digest, for a file of JSON that is more than figures to look at."""
    return {**content, "checksum": checksum(content)}


def is_as_written(content: Mapping[str, Any], known: Collection[str]) -> bool:
    """Whether what `signed` made is unchanged.

    Parameters
    ----------
    content
        What the file holds.
    known
        The keys of such files in version 0.1, which had format 1 and no digest; no other file may
        lack it.
    """
    if "checksum" not in content:
        return content.get("format") == 1 and set(content) <= set(known)
    return content["checksum"] == checksum(content)

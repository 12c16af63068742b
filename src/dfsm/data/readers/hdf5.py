"""HDF5 files, read by h5py in a short-lived process of its own.

The library under h5py follows offsets that the file states, and on damaged ones can end the process
that calls it, or take all memory: here that is a child with a limit on its memory. This file is its
program, too, so that it starts without loading dfsm. MATLAB marks what its v7.3 holds with the
attribute ``MATLAB_class``, stores arrays transposed, characters as numbers, and cell arrays as
references (MathWorks, MAT-File Versions). An array of structs is a group whose members are arrays
of references without that attribute, one reference for each struct.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

# Bytes of address space on top of 20 times the file: compressed signals grow.
_MEMORY = 4 << 30
_SECONDS = 300
_NO_H5PY = 7
_DEEPEST = 32
# Values in a file; references of a damaged one may go round in circles.
_MOST = 100_000
_ELSE = "an array of another class"


def read_hdf5(path: Path) -> dict[str, Any]:
    """Everything in a file as nested dicts of arrays and texts; lists for arrays of structs.

    Cell arrays are arrays where all cells are texts, else lists. Attributes of a group stand under
    ``@name`` in it.

    Raises
    ------
    DfsmError
        h5py is not installed, or the file cannot be read.
    """
    from dfsm.errors import DfsmError

    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "content.npz"
        command = [sys.executable, "-P", __file__, str(path), str(target)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=False)
        except subprocess.TimeoutExpired:
            raise DfsmError(
                f"{path}: reading it took more than {_SECONDS} s: write it again"
            ) from None
        if done.returncode == _NO_H5PY:
            raise DfsmError(
                f"{path} is an HDF5 file (MAT of v7.3, gtsdf), which needs h5py: pip install "
                "'dfsm[hdf5]', or save with -v7 in MATLAB"
            )
        if done.returncode or not target.exists():
            said = done.stderr.decode(errors="replace").strip().splitlines()
            reason = said[-1][:160] if said else f"its reader ended with {done.returncode}"
            raise DfsmError(
                f"{path} is no readable HDF5 file ({reason}): it is damaged, write it again"
            )
        with np.load(target, allow_pickle=False) as stored:
            return _tree({name: stored[name] for name in stored.files})


def _tree(flat: dict[str, np.ndarray]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for name, value in flat.items():
        *folders, last = name.split("/")
        group = content
        for folder in folders:
            group = group.setdefault(folder, {})
        group[last] = str(value) if value.dtype.kind == "U" and value.ndim == 0 else value
    return {name: _with_lists(value) for name, value in content.items()}


def _with_lists(value: Any) -> Any:
    """Lists for the elements that `_collect_elements` has numbered."""
    if not isinstance(value, dict):
        return value
    inside = {name: _with_lists(v) for name, v in value.items()}
    if inside and all(name.startswith("#") for name in inside):
        return list(inside.values())
    return inside


# -- the child's program ------------------------------------------------------------------------


def _main(source: str, target: str) -> int:
    try:
        import h5py  # pyright: ignore[reportMissingImports]
    except ImportError:
        return _NO_H5PY
    try:
        import resource

        most = _MEMORY + 20 * Path(source).stat().st_size
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    except (ImportError, ValueError, OSError):
        pass  # not on every system
    flat: dict[str, np.ndarray] = {}
    with h5py.File(source, "r") as file:
        _collect(file, "", flat, 0)
    np.savez(target, **flat)  # pyright: ignore[reportArgumentType]
    return 0


def _collect(group: Any, prefix: str, flat: dict[str, np.ndarray], depth: int) -> None:
    if depth > _DEEPEST:
        raise ValueError("its groups are nested too deeply")
    for name, value in group.attrs.items():
        _keep(flat, f"{prefix}@{name}", np.asarray(value))
    for name in group:
        if not name.startswith("#"):  # where MATLAB keeps what references point to
            _collect_item(group[name], f"{prefix}{name}", flat, depth)


def _collect_item(item: Any, name: str, flat: dict[str, np.ndarray], depth: int) -> None:
    """A struct, an array of structs, a cell array or a value."""
    if depth > _DEEPEST or len(flat) > _MOST:
        raise ValueError("its parts are too many or nested too deeply")
    if hasattr(item, "keys"):
        members = dict(item.items())
        if not members or not all(_is_structs(m) for m in members.values()):
            _collect(item, f"{name}/", flat, depth + 1)
            return
        targets = {n: _targets(m) for n, m in members.items()}
        for place in range(max(map(len, targets.values()))):
            for field, found in targets.items():
                if place < len(found):
                    _collect_element(found[place], f"{name}/#{place:06d}/{field}", flat, depth)
    elif getattr(item, "shape", None) is not None and _is_references(item):
        found = _targets(item)
        if all(_class(target) == "char" for target in found):
            _keep(flat, name, np.array([str(_value(target)) for target in found]))
            return
        for place, target in enumerate(found):
            _collect_element(target, f"{name}/#{place:06d}", flat, depth)
    elif getattr(item, "shape", None) is not None:
        _keep(flat, name, _value(item))


def _collect_element(item: Any, name: str, flat: dict[str, np.ndarray], depth: int) -> None:
    """One of several, which keeps its place even where it holds nothing that is read."""
    before = len(flat)
    if item is not None:
        _collect_item(item, name, flat, depth + 1)
    if len(flat) == before:
        flat[name] = np.array(_ELSE)


def _class(item: Any) -> str:
    kind = b"" if item is None else item.attrs.get("MATLAB_class", b"")
    return kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)


def _is_references(item: Any) -> bool:
    kind = getattr(item, "dtype", None)
    return kind is not None and "ref" in (kind.metadata or {})


def _is_structs(item: Any) -> bool:
    """Whether a member of a group is that of an array of structs; cell arrays have a class."""
    return _is_references(item) and not _class(item)


def _targets(item: Any) -> list[Any]:
    """What references point to, in MATLAB's order; None where one points nowhere."""
    if item.attrs.get("MATLAB_empty", 0):
        return []
    return [item.file[r] if r else None for r in np.ravel(item[()])]


def _value(item: Any) -> np.ndarray:
    kind = _class(item)
    if item.attrs.get("MATLAB_empty", 0):
        return np.array("") if kind == "char" else np.empty(0)
    values = item[()]
    if kind == "char":
        return np.array("".join(chr(int(c)) for c in np.ravel(values)))
    return np.asarray(values).T if kind else np.asarray(values)


def _keep(flat: dict[str, np.ndarray], name: str, value: np.ndarray) -> None:
    if value.dtype.kind in "SO":
        decoded = [
            v.decode(errors="replace") if isinstance(v, bytes) else str(v) for v in value.ravel()
        ]
        value = np.array(decoded).reshape(value.shape)
    if value.dtype.kind in "fiubU":
        flat[name] = value


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))

"""MAT files up to v7: loose vectors, or what MATLAB's `ReadFASTbinary` leaves in a workspace."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import TIME_NAMES, kept_columns, time_column
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

MAT_TIME_NAMES = (*TIME_NAMES, "tout")
HDF5 = b"\x89HDF\r\n\x1a\n"


def read_mat(path: Path) -> Trajectory:
    """Read a run from an existing MAT file, see `dfsm.data.readers.tables.read_table`.

    Raises
    ------
    DfsmError
        v7.3 (HDF5), damaged, or without time and channels.
    """
    from scipy.io import loadmat

    with path.open("rb") as stream:
        start = stream.read(520)
    if start.startswith((HDF5, b"MATLAB 7.3")) or start[512:] == HDF5:
        raise DfsmError(f"{path} is a MAT file of v7.3 (HDF5), up to v7 is read: save with -v7")
    try:
        content = loadmat(str(path), simplify_cells=True)
    except Exception as error:  # SciPy raises a dozen unrelated types on damaged files
        raise DfsmError(
            f"{path} is no readable MAT file ({type(error).__name__}: {str(error)[:120]}): "
            "save it again with -v7"
        ) from error
    content = {k: v for k, v in content.items() if not k.startswith("__")}
    structs = [v for v in content.values() if isinstance(v, Mapping)]
    if not _is_run(content) and len(structs) == 1:
        content = dict(structs[0])
    if "Channels" in content:
        return _from_channels(path, content)
    return _from_vectors(path, content)


def _is_run(content: Mapping[str, Any]) -> bool:
    return "Channels" in content or any(k.lower() in MAT_TIME_NAMES for k in content)


def _from_channels(path: Path, content: Mapping[str, Any]) -> Trajectory:
    if "ChanName" not in content:
        raise DfsmError(
            f"{path}: it holds Channels but no ChanName: save ChanName and ChanUnit with it"
        )
    names = _strings(content["ChanName"])
    units = _strings(content["ChanUnit"]) if "ChanUnit" in content else [""] * len(names)
    try:
        table = np.atleast_2d(np.asarray(content["Channels"], dtype=np.float64))
    except (TypeError, ValueError):
        raise DfsmError(f"{path}: its Channels are no table of real numbers") from None
    if not table.shape[1:] == (len(names),) == (len(units),):
        raise DfsmError(
            f"{path}: Channels is {' x '.join(map(str, table.shape))}, but there are {len(names)} "
            f"ChanName and {len(units)} ChanUnit; expected one column each: save them again"
        )
    channels = [Channel(n, u.strip("()[]")) for n, u in zip(names, units, strict=True)]
    time = time_column(path, channels)
    keep, notes = kept_columns(path, channels, list(table.T), time)
    return assemble(path, table[:, time], table[:, keep], [channels[i] for i in keep], notes=notes)


def _from_vectors(path: Path, content: Mapping[str, Any]) -> Trajectory:
    vectors: dict[str, np.ndarray] = {}
    for name, value in content.items():
        array = np.squeeze(np.asarray(value))
        if array.ndim == 1 and array.dtype.kind in "fiub":
            vectors[name] = array.astype(np.float64)
    channels = [Channel(name) for name in vectors]
    time = vectors[channels[time_column(path, channels, MAT_TIME_NAMES)].name]
    used = [c for c in channels if len(vectors[c.name]) == len(time)]
    used = [c for c in used if vectors[c.name] is not time]
    left = [n for n in content if n not in {c.name for c in used} and vectors.get(n) is not time]
    notes = [
        f"'{name}' left out: it is no real vector of {len(time)} values, the length of the time"
        for name in left
    ]
    values = np.stack([vectors[c.name] for c in used], axis=1) if used else np.empty((len(time), 0))
    return assemble(path, time, values, used, notes=notes)


def _strings(value: Any) -> list[str]:
    # A cell array of strings, a padded character matrix, or one string alone.
    return [str(v).strip() for v in np.ravel(np.asarray(value, dtype=object))]

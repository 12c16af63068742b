"""Tables: CSV, Parquet and MAT files to trajectories, and trajectories to CSV and Parquet.

In Parquet, what a `Channel` knows is kept in the field's metadata (`unit`, `step`, `role`; `scale`
and `offset` of packed codes) and what a run knows in the schema's (`dfsm.…`).
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from dfsm.core.files import existing_file, write_file
from dfsm.data.readers.columns import split_header
from dfsm.data.readers.delimited import read_delimited
from dfsm.data.readers.guard import check_run_name, guarded
from dfsm.data.readers.mat import read_mat
from dfsm.data.readers.parquet import read_parquet, write_parquet
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError


def read_table(path: str | Path, step: float | None = None) -> Trajectory:
    """Read a run from a CSV, Parquet or MAT file.

    * CSV: the first row holds names, with units as ``PtfmPitch [deg]``, ``PtfmPitch (deg)`` or
      ``PtfmPitch_[deg]``, or in a row below; separated by comma, semicolon, tab or blanks; lines
      that begin with ``#`` are comments; empty cells and stars are NaN. LabVIEW's `.lvm` too.
    * Parquet: what `write_table` wrote, or any table with a time column or a float index.
    * MAT (v7.3 with ``dfsm[hdf5]``): a time vector and vectors or matrices as long, in structs of
      any depth, or `Channels`, `ChanName` and `ChanUnit` as MATLAB's ``ReadFASTbinary`` returns
      them.

    Time is the first column called ``Time`` in any case, else ``t`` (``tout`` too in MAT), in s, or
    holds time stamps, which become seconds since the first; see `dfsm.data.readers.times`.

    Parameters
    ----------
    path
        The file.
    step
        Interval between samples in s where the file holds no time; default what ``fs``, ``Ts`` or
        ``dt`` beside the signals tell.

    Returns
    -------
    Trajectory
        Values of shape ``(time, channel)``, in the units of the file.

    Raises
    ------
    DfsmError
        The file is missing, foreign or damaged; there is no time, or not in s; a row is ragged
        or holds something that is no number (the line is named).
    """
    path = existing_file(path)
    with path.open("rb") as stream:
        start = stream.read(8)
    suffix = path.suffix.lower()
    if suffix in (".parquet", ".pq") or start.startswith(b"PAR1"):
        return read_parquet(path, step)
    if suffix == ".mat" or start.startswith((b"MATLAB", b"\x89HDF")):
        return read_mat(path, step)
    return read_delimited(path, step)


def write_table(trajectory: Trajectory, path: str | Path, *, packed: bool = False) -> None:
    """Write a run to a `.parquet` or `.csv` file.

    Parquet keeps units, roles, quantisation steps, name, wall time and notes exactly, and pages
    have checksums; CSV keeps names, units and all digits. A name that a spreadsheet would run as
    a formula (it begins with =, +, - or @) has an apostrophe before it in CSV.

    Parameters
    ----------
    trajectory
        The run.
    path
        Where to; its suffix decides the kind.
    packed
        Parquet only: store channels that lie on the grid of their quantisation step as 16-bit
        codes, value = (code - offset) / scale, and an equidistant mesh as start and step. The
        codes and steps come back exactly; values as exactly as the grid allows (bit for bit where
        the run was decoded from 16-bit `.outb`).

    Raises
    ------
    DfsmError
        Another suffix, `packed` with CSV, names that the kind cannot hold, or a failed write.
    """
    path = Path(path)
    suffix = table_suffix(path, packed=packed)
    for name in trajectory.names:
        if name.lower() == "time":
            raise DfsmError(
                f"{trajectory.where}: a channel called '{name}' cannot be told from the time in a "
                "table: leave it out or rename it"
            )
        if not name.strip():
            raise DfsmError(
                f"{trajectory.where}: a channel has no name, by which a table could be read again: "
                "give it one"
            )
    if suffix == ".csv":
        _write_csv(trajectory, path)
    else:
        check_run_name(path, trajectory.name)
        write_parquet(trajectory, path, packed=packed)


def table_suffix(path: Path, *, packed: bool = False) -> str:
    """Suffix that decides the kind of table to write.

    Raises
    ------
    DfsmError
        It is none that `write_table` knows.
    """
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet") or (packed and suffix == ".csv"):
        kinds = ".parquet (the only kind that can be packed)" if packed else ".parquet or .csv"
        raise DfsmError(f"{path}: a table is written to {kinds}: choose a name that ends so")
    return suffix


def _write_csv(trajectory: Trajectory, path: Path) -> None:
    header = ["Time [s]"]
    for channel in trajectory.channels:
        plain = channel.name if not channel.unit else f"{channel.name} [{channel.unit}]"
        # A name that itself looks like 'name [unit]' needs an empty unit behind it.
        if split_header(plain) != (channel.name, channel.unit):
            plain = f"{channel.name} [{channel.unit}]"
        if split_header(plain) != (channel.name, channel.unit):
            raise DfsmError(
                f"{trajectory.where}: channel '{channel.name}' in '{channel.unit}' cannot be told "
                "apart into name and unit in a CSV header: write .parquet instead"
            )
        header.append(guarded(plain))
    with write_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        table = np.column_stack([trajectory.time, trajectory.values])
        writer.writerows([f"{v:.17g}" for v in row] for row in table.tolist())

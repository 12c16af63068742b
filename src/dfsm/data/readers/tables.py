"""Tables: CSV, Parquet and MAT files to trajectories, and trajectories to CSV and Parquet.

In Parquet, what a `Channel` knows is kept in the field's metadata (`unit`, `step`, `role`; `scale`
and `offset` of packed codes) and what a run knows in the schema's (`dfsm.…`).
"""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import numpy as np

from dfsm.core.files import existing_file, write_file
from dfsm.data.readers.assemble import assemble
from dfsm.data.readers.columns import kept_columns, split_header, time_column
from dfsm.data.readers.guard import check_run_name, guarded, unguarded
from dfsm.data.readers.mat import read_mat
from dfsm.data.readers.parquet import read_parquet, write_parquet
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError


def read_table(path: str | Path) -> Trajectory:
    """Read a run from a CSV, Parquet or MAT file.

    * CSV: the first row holds names, with units as ``PtfmPitch [deg]``, ``PtfmPitch (deg)`` or
      ``PtfmPitch_[deg]``; separated by comma, semicolon or tab; empty cells are NaN.
    * Parquet: what `write_table` wrote, or any table with a time column or a float index.
    * MAT (up to v7): a time vector and vectors as long, or `Channels`, `ChanName` and `ChanUnit`
      as MATLAB's ``ReadFASTbinary`` returns them, at the top or in one struct.

    Time is the first column called ``Time`` or ``t`` in any case (``tout`` too in MAT), in s.

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
        return read_parquet(path)
    if suffix == ".mat" or start.startswith((b"MATLAB", b"\x89HDF")):
        return read_mat(path)
    return _read_csv(path)


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


def _read_csv(path: Path) -> Trajectory:
    text = _decode(path)
    first = text.lstrip("\r\n").split("\n", 1)[0]
    delimiter = max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    rows: list[list[str]] = []
    numbers: list[int] = []
    try:
        for row in reader:
            if row:
                rows.append(row)
                numbers.append(reader.line_num)
    except csv.Error as error:
        raise DfsmError(f"{path}, line {reader.line_num}: {error}; it is no CSV table") from None
    if not rows:
        raise DfsmError(f"{path} holds blank lines only: check that it is the right file")
    channels = [Channel(*split_header(unguarded(cell))) for cell in rows[0]]
    time = time_column(path, channels)
    for row, number in zip(rows[1:], numbers[1:], strict=True):
        if len(row) != len(channels):
            raise DfsmError(
                f"{path}, line {number}: {len(row)} values, but the header names {len(channels)} "
                f"columns: {_cure(row, len(channels), delimiter)}"
            )
    cells = [[c.strip() or "nan" for c in row] for row in rows[1:]]
    try:
        data = np.array(cells, dtype=np.float64).reshape(len(cells), len(channels))
    except ValueError:
        raise _bad_cell(path, cells, numbers[1:]) from None
    keep, notes = kept_columns(path, channels, list(data.T), time)
    return assemble(path, data[:, time], data[:, keep], [channels[i] for i in keep], notes=notes)


def _decode(path: Path) -> str:
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings = ("utf-16",)
    elif b"\0" in raw:
        raise DfsmError(f"{path} is a binary file, a CSV table was expected: check the file")
    else:
        # What is not UTF-8 comes from a spreadsheet on Windows; there every byte means something.
        encodings = ("utf-8-sig", "latin-1")
    for encoding in encodings:
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise DfsmError(f"{path} is damaged UTF-16 text: save it as UTF-8")


def _cure(row: list[str], columns: int, delimiter: str) -> str:
    # A comma between digits that was meant as a decimal point makes two cells of one.
    whole = all(re.fullmatch(r"\s*[-+]?\d+\s*", cell) for cell in row)
    if delimiter == "," and whole and columns < len(row) <= 2 * columns:
        return "if its decimals have commas, save it with points; else correct or remove the line"
    return "correct or remove the line"


def _bad_cell(path: Path, cells: list[list[str]], numbers: list[int]) -> DfsmError:
    for row, number in zip(cells, numbers, strict=True):
        for column, text in enumerate(row, start=1):
            try:
                float(text)
            except ValueError:
                cure = "correct it"
                if re.fullmatch(r"[-+]?\d*,\d*(e[-+]?\d+)?", text, re.IGNORECASE):
                    cure = "decimals have a comma here, save the table with points"
                return DfsmError(
                    f"{path}, line {number}: {text[:24]!r} in column {column} is no number: {cure}"
                )
    return DfsmError(f"{path}: its rows make no table of numbers: check the file")


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

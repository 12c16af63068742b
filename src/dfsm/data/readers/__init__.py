"""Files to trajectories: OpenFAST `.outb` and `.out`, CSV, Parquet, MAT; tables written back."""

from __future__ import annotations

import glob
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from dfsm.core.files import existing_file
from dfsm.core.progress import track
from dfsm.data.info import ChannelInfo, RunInfo, describe, gap_warning
from dfsm.data.readers.bladed import is_bladed, read_bladed
from dfsm.data.readers.hawc2 import is_hawc2, read_hawc2
from dfsm.data.readers.long_run import LongRun
from dfsm.data.readers.openfast import long_openfast, read_openfast
from dfsm.data.readers.parquet import long_parquet
from dfsm.data.readers.tables import read_table, write_table
from dfsm.data.readers.turbsim import read_turbsim
from dfsm.data.trajectory import Trajectory
from dfsm.data.wind import undisturbed_rotor_wind, wind_warning
from dfsm.data.wind_field import WindField, disk_wind, with_field_wind
from dfsm.errors import DfsmError

__all__ = [
    "ChannelInfo",
    "RunInfo",
    "WindField",
    "describe",
    "describe_all",
    "disk_wind",
    "gap_warning",
    "read",
    "read_all",
    "read_openfast",
    "read_table",
    "read_turbsim",
    "undisturbed_rotor_wind",
    "wind_warning",
    "with_field_wind",
    "with_wall_times",
    "write_table",
]

OPENFAST = {".outb", ".out", ".dbg", ".dbg2", ".dbg3"}
TABLES = {".csv", ".txt", ".tsv", ".lvm", ".asc", ".parquet", ".pq", ".mat", ".hdf5", ".h5"}
# How files begin that are recognised under any name.
SIGNATURES = {b"PAR1": read_table, b"MATLAB": read_table, b"\x89HDF": read_table} | {
    bytes([n, 0]): read_openfast for n in (1, 2, 3, 4)
}


def read(path: str | Path, step: float | None = None) -> Trajectory:
    """Read one run, whatever kind of file it is.

    Parameters
    ----------
    path
        OpenFAST `.outb` or `.out`, ROSCO `.RO.dbg`, HAWC2 `.sel` or `.hdf5`, Bladed `.%NN` or
        `.$PJ`, `.csv` (`.txt`, `.tsv`, `.asc`), LabVIEW `.lvm`, `.parquet` or `.mat`; under
        another name, binary files are recognised by their first bytes.
    step
        Interval between samples in s for tables that hold no time.

    Returns
    -------
    Trajectory
        Named after the file, see `read_openfast` and `read_table`.

    Raises
    ------
    DfsmError
        The file is missing, of no known kind, or damaged.
    """
    path = existing_file(path)
    suffix = path.suffix.lower()
    if suffix in OPENFAST:
        return read_openfast(path)
    if is_hawc2(path):
        return read_hawc2(path)
    if is_bladed(path):
        return read_bladed(path)
    if suffix in TABLES:
        return read_table(path, step)
    with path.open("rb") as stream:
        start = stream.read(8)
    for signature, reader in SIGNATURES.items():
        if start.startswith(signature):
            return read_table(path, step) if reader is read_table else reader(path)
    raise DfsmError(
        f"{path}: '{path.suffix}' is no known kind of file; expected .outb, .out, .csv, .parquet "
        "or .mat: rename or convert it"
    )


def read_all(
    patterns: Iterable[str | Path],
    base: Path | None = None,
    step: float | None = None,
    keep: Callable[[Trajectory], Trajectory] | None = None,
) -> list[Trajectory]:
    """Read every file that the patterns name, each once, in the order named.

    Parameters
    ----------
    patterns
        File names or glob patterns (``runs/*.outb``, ``**`` for any depth); one alone will do.
    base
        Folder that relative patterns start from; default the working folder.
    step
        Interval between samples in s for tables that hold no time.
    keep
        What is kept of a run before the next one is read; default all of it.

    Returns
    -------
    list[Trajectory]
        One per file; the files of one pattern are sorted by name. Empty without patterns.

    Raises
    ------
    DfsmError
        A pattern matches nothing, a file is missing, or one cannot be read.
    """
    runs: list[Trajectory] = []
    for path in track(_paths(patterns, base), "Reading runs"):
        run = read(path, step) if keep is None else keep(read(path, step))
        runs.append(run.on_time_of(runs[-1]) if runs else run)
    return runs


def describe_all(
    patterns: Iterable[str | Path], base: Path | None = None, step: float | None = None
) -> list[RunInfo]:
    """Describe every file that the patterns name, holding one run at a time.

    Of a long binary `.outb` or Parquet file no more than one channel is held.

    Parameters
    ----------
    patterns, base, step
        As for `read_all`.

    Returns
    -------
    list[RunInfo]
        One per file, what `describe` says of it.

    Raises
    ------
    DfsmError
        As `read_all`.
    """
    paths = track(_paths(patterns, base), "Reading runs")
    return [describe((_long(path) if step is None else None) or read(path, step)) for path in paths]


def _long(path: Path) -> LongRun | None:
    suffix = path.suffix.lower()
    if suffix == ".outb":
        return long_openfast(path)
    return long_parquet(path) if suffix in (".parquet", ".pq") else None


def _paths(patterns: Iterable[str | Path], base: Path | None) -> list[Path]:
    """Files that the patterns name, each once."""
    if isinstance(patterns, str | Path):
        patterns = [patterns]
    paths: dict[Path, Path] = {}
    for pattern in patterns:
        for path in _expand(pattern, base):
            paths.setdefault(path.resolve(), path)
    return list(paths.values())


def with_wall_times(runs: Iterable[Trajectory], path: str | Path) -> list[Trajectory]:
    """Add the simulator's recorded wall times, for speed-ups.

    Parameters
    ----------
    runs
        Whole runs, as read.
    path
        JSON file that maps run names to seconds for the whole run; names it lacks stay as they
        are.

    Raises
    ------
    DfsmError
        The file is missing or holds something else, or a time is not positive.
    """
    path = existing_file(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        seconds = {str(name): float(value) for name, value in table.items()}
    except (ValueError, TypeError, AttributeError):
        raise DfsmError(f"{path} is not a JSON table of run names and seconds") from None
    for name, value in seconds.items():
        if not (math.isfinite(value) and value > 0):
            raise DfsmError(
                f"{path}: the wall time of '{name}' is {value:g} s, expected a positive number: "
                "correct it or leave the run out"
            )
    return [replace(r, wall_time=seconds.get(r.name, r.wall_time)) for r in runs]


def _expand(pattern: str | Path, base: Path | None) -> list[Path]:
    folder = Path() if base is None else base
    literal = folder / pattern
    # A name with brackets may be a file as it stands, so that is tried before globbing.
    if not glob.has_magic(str(pattern)) or literal.exists():
        return [existing_file(literal)]
    # Path.glob refuses absolute patterns, which is what a shell or a configuration may hold.
    matches = glob.glob(str(pattern), root_dir=base, recursive=True)  # noqa: PTH207
    paths = [folder / match for match in sorted(matches)]
    files = [p for p in paths if p.is_file()]
    if not files:
        raise DfsmError(
            f"no file matches '{pattern}' in {folder.absolute()}: check the folder and the pattern"
        )
    return files

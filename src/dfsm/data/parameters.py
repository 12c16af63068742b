"""Plant parameters of runs from a table, for result files that do not hold them as channels."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np

from dfsm.core.files import existing_file
from dfsm.data.readers.columns import split_header
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, printable

# Value by run, by parameter with or without a unit in brackets.
Table = Mapping[str, Mapping[str, float]]


def read_parameters(path: str | Path) -> dict[str, dict[str, float]]:
    """Read a table of parameters: a column with the names of runs, then one per parameter.

    Parameters
    ----------
    path
        CSV file, separated by comma, semicolon or tab; heads may hold units, ``Ballast [t]``.

    Raises
    ------
    DfsmError
        The file is missing or no such table, or holds what is no finite number.
    """
    path = existing_file(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise DfsmError(f"{path} is no text, expected a CSV table of runs and parameters") from None
    delimiter = max(",;\t", key=text.split("\n", 1)[0].count)
    rows = [row for row in csv.reader(text.splitlines(), delimiter=delimiter) if any(row)]
    if len(rows) < 2 or len(rows[0]) < 2:
        raise DfsmError(
            f"{path} is no table of parameters: a first row 'run,Ballast [t]' and one row per run "
            "are expected"
        )
    table: dict[str, dict[str, float]] = {head.strip(): {} for head in rows[0][1:]}
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(rows[0]):
            raise DfsmError(
                f"{path}, row {number}: {len(row)} values, expected {len(rows[0])}: complete it"
            )
        run = row[0].strip()
        for head, cell in zip(table, row[1:], strict=True):
            if run in table[head]:
                raise DfsmError(f"{path}, row {number}: '{run}' stands there twice: remove one")
            table[head][run] = _number(f"{path}, row {number}: {head}", cell)
    return table


def names_in(table: Table) -> list[str]:
    """Names of the parameters of a table, without units."""
    return [split_header(head)[0] for head in table]


def with_parameters(runs: Sequence[Trajectory], table: Table) -> list[Trajectory]:
    """Add parameters as constant channels.

    Parameters
    ----------
    runs
        As read.
    table
        By parameter the value of every run, by its file, with or without folders, or its name.

    Raises
    ------
    DfsmError
        A run without a value or with several, one that holds the channel itself, or a value that
        is not finite.
    """
    results = []
    for run in runs:
        for head, values in table.items():
            name, unit = split_header(head)
            if name in run:
                raise DfsmError(
                    f"{run.where}: parameter '{name}' is a channel of the run already: take it out "
                    "of the table, or name it as a channel only"
                )
            value = _value(run, name, values)
            run = run.with_channels([Channel(name, unit, role="parameter")], value)
        results.append(run)
    return results


def _value(run: Trajectory, name: str, values: Mapping[str, float]) -> float:
    known = {key: value for key, value in values.items() if _means(key, run)}
    if len({*known.values()}) != 1:
        told = f"{len(known)} values ({', '.join(known)})" if known else "no value"
        rest = "name it by more of its folders" if known else "add one under the file's name"
        raise DfsmError(
            f"{run.where}: {told} of parameter '{name}' for this run in the table of parameters: "
            f"{rest}"
        )
    return _number(f"{run.where}: parameter '{name}'", next(iter(known.values())))


def _means(key: str, run: Trajectory) -> bool:
    """Whether a key is the run's name, or the end of its path."""
    parts = PurePath(key).parts
    source = PurePath(run.source or "").parts
    return key == run.name or (bool(parts) and source[-len(parts) :] == parts)


def _number(where: str, value: object) -> float:
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        number = np.nan
    if isinstance(value, bool) or not np.isfinite(number):
        raise DfsmError(f"{where} is '{printable(str(value))}', expected a finite number")
    return number

"""Where the names of a text table stand, how its cells are separated, and which lines are rows."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dfsm.core.units import listed
from dfsm.data.readers.columns import rate_step
from dfsm.data.readers.labels import named_channels
from dfsm.data.readers.stamps import is_stamp, tells_time
from dfsm.data.readers.text import Row, blank_cells, number
from dfsm.data.readers.times import is_date_name, time_rank
from dfsm.errors import DfsmError

BLANKS = ""  # the separator of columns that blanks separate
_SEPARATORS = ",;\t"
_COMMENTS = ("#", "%", "!")
_HEADER_LINES = 200
# What a line holds that is empty but for the separators that spreadsheets write for empty cells.
_EMPTY = ' \t\r,;"'
NAME_AND_UNIT = re.compile(r"\S+?[ _]?(?:\([^()]*\)|\[[^\[\]]*\])|\S+")
RATE = re.compile(
    r"((?:[^\W\d]\w*[ _])?[^\W\d]\w*)\s*[=:,;\t]\s*([-+]?[.\d][.\deE+-]*) *([^\s,;]*)"
)
# What spreadsheets write above a table to say how its cells are separated.
_SEPARATED = re.compile(r"sep=(.)", re.IGNORECASE)


@dataclass(frozen=True)
class Header:
    """Where the names stand, how the cells of the rows are separated, and what the names are."""

    at: int
    separator: str
    names: list[str]


def find_header(path: Path, lines: list[str]) -> Header | None:
    """The line of the names: the first that names a time, else the first that is no comment.

    Names and rows may be separated in different ways, as NumPy's ``savetxt`` leaves them.

    Returns
    -------
    Header or None
        None for a file of blank lines.

    Raises
    ------
    DfsmError
        No line names a time, and the first one holds numbers.
    """
    seen = [(i, line) for i, line in enumerate(lines[: 5 * _HEADER_LINES]) if line.strip(_EMPTY)]
    told = _SEPARATED.fullmatch(seen[0][1].strip(' \t\r"')) if seen else None
    if told:
        seen = seen[1:]
    separators = told[1] if told else _SEPARATORS
    plain = [(i, line) for i, line in seen[:_HEADER_LINES] if not is_comment(line)]
    while len(plain) > 1 and _tells_rate(plain[0][1]):
        del plain[0]
    for i, line in seen[:_HEADER_LINES]:
        header = _header(i, line, separators)
        # "Time" beside a time of day is what is told of a measurement, no name of a column.
        if not _names_time(header.names) or any(map(is_stamp, header.names)):
            continue
        below = [text for j, text in plain if j > i]
        # A sentence may hold the word as well, but no row of as many cells stands below it.
        if plain and i == plain[0][0]:
            return _with_rows(header, below, separators) or header
        found = _with_rows(header, below[:1], separators)
        if found is None:
            continue
        # What is told of a table, and a title, may hold a t, too: its names then stand below.
        sure = _begins_record(below[0]) or found.separator == header.separator
        if sure and not (is_comment(line) and _is_header(below[0], separators)):
            return _with_rows(header, below, separators) or found
    if not plain:
        return None
    at, line = plain[0]
    header = _header(at, line, separators)
    below = [text for _, text in plain[1:]]
    header = _with_rows(header, below, separators) or header
    if _is_record(header, below):
        return _named_above(path, lines, header, separators)
    return header


def _is_record(header: Header, below: Sequence[str]) -> bool:
    """Whether what stands for the names has numbers where the row below it has numbers."""
    first = [_is_value(cell) for cell in header.names]
    if not any(first):
        return False
    second = (
        [_is_value(cell) for cell in split_cells(below[0], header.separator)] if below else first
    )
    return all(first) or first == second


def _is_value(cell: str) -> bool:
    cell = cell.strip().replace(",", ".")
    return bool(cell) and (number(cell) is not None or tells_time(cell))


def _header(at: int, line: str, separators: str) -> Header:
    names = line.lstrip(" " + "".join(_COMMENTS)) if is_comment(line) else line
    separator = max(separators, key=names.count)
    if separator in names:
        return Header(at, separator, split_cells(names, separator))
    return Header(at, BLANKS, NAME_AND_UNIT.findall(names))


def _with_rows(header: Header, below: Sequence[str], separators: str) -> Header | None:
    """A header with the separator of the first record; None where that has not as many cells."""
    if not below:
        return None
    row = next((line for line in below if _begins_record(line)), below[0])
    for separator in (header.separator, *separators, BLANKS):
        if _fits(split_cells(row, separator), header.names):
            return replace(header, separator=separator)
    return None


def _fits(cells: Sequence[str], names: Sequence[str]) -> bool:
    """Whether there is a name for every cell, but for empty ones at the end of either."""
    return len(cells) == len(names) or _filled(cells) == _filled(names)


def _filled(cells: Sequence[str]) -> int:
    """Number of cells up to the last that is not empty."""
    return max((i + 1 for i, cell in enumerate(cells) if cell.strip()), default=0)


def _begins_record(line: str) -> bool:
    return _is_value(re.split(r"[,;\t ]", line.strip(' \t"'), maxsplit=1)[0].strip('"'))


def _is_header(line: str, separators: str) -> bool:
    """Whether a line below a comment holds names: one of a time, or neither numbers nor units."""
    names = _header(0, line, separators).names
    if _names_time(names) or any(map(_is_value, names)):
        return _names_time(names)
    return 2 * sum(listed(name.strip("()[]")) for name in names) < len(names)


def _named_above(path: Path, lines: list[str], header: Header, separators: str) -> Header:
    """Names in the comment right above a table of numbers.

    Raises
    ------
    DfsmError
        There is none that has a word for every column.
    """
    above = lines[header.at - 1] if header.at else ""
    if is_comment(above):
        names = _header(header.at - 1, above, separators)
        words = names.separator != BLANKS and "=" not in above
        words = words and all(n.strip() and number(n) is None for n in names.names)
        if words and (found := _with_rows(names, [lines[header.at]], separators)):
            return found
    raise DfsmError(
        f"{path}, line {header.at + 1}: numbers stand where the names of the columns were "
        "expected: add a line with a name for every column above them"
    )


def _tells_rate(line: str) -> bool:
    match = RATE.fullmatch(line.strip(" ,;\t"))
    return match is not None and rate_of(match) is not None


def rate_of(match: re.Match[str]) -> tuple[float, str] | None:
    """Interval in s that ``fs = 50 Hz`` and the like tell, and its name; None for other words."""
    value = number(match[2]) or 0.0
    for name in (match[1], match[1].split(" ")[-1]):
        step = rate_step(name, value, match[3])
        if step is not None:
            return step, name
    return None


def is_comment(line: str) -> bool:
    """Whether a line begins with a sign of comments."""
    return line.lstrip().startswith(_COMMENTS)


def _names_time(names: list[str]) -> bool:
    channels = named_channels(names)
    return any(time_rank(c.name) is not None or is_date_name(c.name) for c in channels)


def split_cells(line: str, separator: str) -> list[str]:
    """Cells of one line."""
    if separator == BLANKS:
        return blank_cells(line)
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])


def rows_below(path: Path, lines: list[str], header: Header) -> list[Row]:
    """All rows below the header, without blank lines, comments and empty rows of spreadsheets.

    Raises
    ------
    DfsmError
        A quoted cell has no end.
    """
    numbered = [
        (i + 1, line)
        for i, line in enumerate(lines)
        if i > header.at and line.strip() and not is_comment(line)
    ]
    if header.separator == BLANKS:
        return [Row(n, blank_cells(line)) for n, line in numbered]
    # A quoted cell may go over several lines.
    reader = csv.reader(
        (line for _, line in numbered), delimiter=header.separator, skipinitialspace=True
    )
    try:
        rows = [Row(numbered[reader.line_num - 1][0], cells) for cells in reader]
    except csv.Error as error:
        line = numbered[min(reader.line_num, len(numbered)) - 1][0]
        raise DfsmError(f"{path}, line {line}: {error}; it is no CSV table") from None
    return [row for row in rows if any(cell.strip() for cell in row.cells)]


def without_empty_ends(names: list[str], rows: list[Row]) -> tuple[list[str], list[Row]]:
    """Names and rows without the empty cell that a separator at their end leaves.

    It is nothing where all rows have it and the names do not, and the other way round.
    """
    usual = Counter(len(row.cells) for row in rows).most_common(1)
    width, filled = usual[0][0] if usual else len(names), _filled(names)
    # How many cells the lines have that end with an empty one.
    longer, kept = (width, len(names)) if width > len(names) else (len(names), width)
    nothing = all(_filled(row.cells) <= kept for row in rows if len(row.cells) == longer)
    if longer == kept or filled > kept or not nothing:
        return names, rows
    tidy = [Row(r.line, r.cells[:kept]) if len(r.cells) == longer else r for r in rows]
    return names[:kept], tidy


def without_repeats(
    rows: list[Row], names: Sequence[str], labels: Sequence[Sequence[str]]
) -> tuple[list[Row], str]:
    """Rows without those that repeat the header, and a note on them.

    Parameters
    ----------
    rows
        Below the header.
    names, labels
        Cells of the header, and of the rows of words below it.
    """
    again = [row for row in rows if _same(row.cells, names)]
    if not again:
        return rows, ""
    lines = {row.line for row in again}
    # What stands below the names stands below them here, too.
    lines |= {row.line for row in rows if any(_same(row.cells, label) for label in labels)}
    where = ", ".join(map(str, sorted(lines)[:3])) + (", …" if len(lines) > 3 else "")
    told = f"line {where} repeats" if len(lines) == 1 else f"lines {where} repeat"
    kept = [row for row in rows if row.line not in lines]
    return kept, f"{told} the header: passed over"


def _same(cells: Sequence[str], other: Sequence[str]) -> bool:
    if len(cells) != len(other) or cells[0].strip() != other[0].strip():
        return False
    return [c.strip() for c in cells] == [c.strip() for c in other]

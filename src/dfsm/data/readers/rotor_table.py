"""Rotor performance tables: power, thrust and torque coefficients over blade pitch and speed.

Read from ROSCO's ``Cp_Ct_Cq.*.txt``, or from a CSV table with one row per blade pitch and tip speed
ratio as CCBlade and AeroDyn users export it.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.files import existing_file
from dfsm.core.types import Array, IntArray
from dfsm.data.readers.columns import split_header
from dfsm.errors import DfsmError

BETZ = 16 / 27
# Fewer values on an axis make no surface with continuous curvature.
_FEWEST = 4
# Largest difference of Cq and Cp / tip speed ratio, as a share of the largest Cq.
_CONSISTENT = 0.02
# A table within so many "degrees" that holds the whole decline of the power is in rad.
_RADIANS = 1.6

# Header names by what they hold, without case and anything but letters.
_NAMES = {
    "pitch": ("pitch", "bladepitch", "pitchangle", "bldpitch", "bpitch", "theta", "beta"),
    "tip_speed_ratio": ("tsr", "tipspeedratio", "rttsr", "lambda", "λ"),
    "cp": ("cp", "rtaerocp", "powercoefficient"),
    "ct": ("ct", "rtaeroct", "thrustcoefficient"),
    "cq": ("cq", "rtaerocq", "torquecoefficient"),
}
_UNITS = {"deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad"}
_SECTIONS = {
    "pitch angle": "pitch",
    "tsr": "tip_speed_ratio",
    "tip speed ratio": "tip_speed_ratio",
    "wind speed": "wind",
    "power coef": "cp",
    "thrust coef": "ct",
    "torque coef": "cq",
}


_TABLES = ("cp", "ct", "cq")
_BRACKETS = re.compile(r"\([^()]*\)|\[[^\[\]]*\]")
_AXIS = re.compile(r"\b(vector|axis)\b")


@dataclass(frozen=True, eq=False)
class RotorTable:
    """Quasi-steady coefficients of a rotor.

    Attributes
    ----------
    pitch
        Blade pitch in deg, increasing, shape ``(n,)``.
    tip_speed_ratio
        Speed of the blade tips over that of the wind, increasing, shape ``(m,)``.
    cp, ct, cq
        Coefficients of power, thrust and torque (Cp / tip speed ratio), shape ``(m, n)``.
    source
        How messages call the table.

    Raises
    ------
    DfsmError
        Axes that do not rise or are too short, sizes that do not fit, entries that are not
        finite, more power than Betz allows, no power at all, signs that are turned around, torque
        that disagrees with power, or a pitch in rad.
    """

    pitch: Array
    tip_speed_ratio: Array
    cp: Array
    ct: Array
    cq: Array
    source: str = "the rotor table"

    def __post_init__(self) -> None:
        for field in _NAMES:
            array = np.array(getattr(self, field), dtype=np.float64)
            array.flags.writeable = False
            object.__setattr__(self, field, array)
        _check_axis(self.source, "blade pitch", self.pitch)
        _check_axis(self.source, "tip speed ratio", self.tip_speed_ratio)
        size = (len(self.tip_speed_ratio), len(self.pitch))
        for name in _TABLES:
            _check_entries(self.source, name.capitalize(), getattr(self, name), size)
        _check_physics(self)

    @property
    def optimum(self) -> tuple[float, float]:
        """Tip speed ratio and blade pitch in deg at which the power is largest."""
        row, column = np.unravel_index(np.argmax(self.cp), self.cp.shape)
        return float(self.tip_speed_ratio[row]), float(self.pitch[column])


# Settings may hold a table itself beside the name of its file.
RotorTable.__pydantic_config__ = {  # pyright: ignore[reportAttributeAccessIssue]
    "arbitrary_types_allowed": True,
    "extra": "forbid",
}


def read_rotor_table(path: str | Path) -> RotorTable:
    """Read the performance table of a rotor.

    Parameters
    ----------
    path
        ROSCO's ``Cp_Ct_Cq.*.txt``; or CSV with one row per blade pitch and tip speed ratio in any
        order, columns called pitch, TSR, Cp, Ct and, if it is there, Cq: ``Pitch (deg)``,
        ``pitch_deg`` or ``pitch_rad``, ``TSR``, ``RtTSR``, ``RtAeroCp``, …

    Returns
    -------
    RotorTable
        Pitch in deg; Cq is Cp / tip speed ratio where the file has none.

    Raises
    ------
    DfsmError
        The file is missing, holds something else, is incomplete, or its values are refused by
        `RotorTable`.
    """
    path = existing_file(path)
    raw = path.read_bytes()
    if b"\0" in raw:
        raise DfsmError(f"{path} is a binary file, {_EXPECTED}: check the file")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise DfsmError(f"{path} holds blank lines only, {_EXPECTED}: check the file")
    heads = [line for line in lines if line.lstrip().startswith("#")]
    if any(_section(line) for line in heads):
        return _rosco(path, lines)
    return _long(path, lines[sum(line.lstrip().startswith("#") for line in lines) :])


_EXPECTED = (
    "expected ROSCO's Cp_Ct_Cq table or CSV with columns for pitch, tip speed ratio, Cp and Ct"
)


# -- ROSCO --------------------------------------------------------------------------------------


def _section(line: str) -> str | None:
    """What the lines behind a comment hold, if it says so.

    A coefficient may be told with its axes: "Power coefficient (rows: TSR, columns: pitch angle)".
    """
    folded = line.casefold()
    for text in (_BRACKETS.sub(" ", folded), folded):
        places = {text.find(words): field for words, field in _SECTIONS.items() if words in text}
        found = [places[at] for at in sorted(places)]
        tables = [field for field in found if field in _TABLES]
        if found:
            return tables[0] if tables and not _AXIS.search(text) else found[0]
    return None


def _rosco(path: Path, lines: Sequence[str]) -> RotorTable:
    rows: dict[str, list[list[float]]] = {}
    section: str | None = None
    for line in lines:
        if line.lstrip().startswith("#"):
            section = _section(line)
            continue
        if section is None:
            raise DfsmError(
                f"{path}: '{line.strip()[:40]}' stands under no heading that says what it is: "
                "write the table again with the ROSCO toolbox"
            )
        rows.setdefault(section, []).append(_numbers(path, line.split()))
    for field in ("pitch", "tip_speed_ratio", "cp", "ct"):
        if field not in rows:
            raise DfsmError(
                f"{path}: it has no {_TOLD[field]}, {_EXPECTED}: write it again with the ROSCO "
                "toolbox"
            )
    pitch, ratio = (
        np.array([v for row in rows[field] for v in row]) for field in ("pitch", "tip_speed_ratio")
    )
    tables: dict[str, Array] = {}
    for field in _TABLES:
        if field in rows:
            tables[field] = _matrix(path, field, rows[field], (len(ratio), len(pitch)))
    return _table(path, pitch, ratio, tables)


_TOLD = {
    "pitch": "blade pitch",
    "tip_speed_ratio": "tip speed ratio",
    "cp": "power coefficient",
    "ct": "thrust coefficient",
    "cq": "torque coefficient",
}


def _numbers(path: Path, cells: Sequence[str]) -> list[float]:
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        shown = " ".join(cells)[:40]
        raise DfsmError(f"{path}: '{shown}' is no row of numbers: correct it") from None


def _matrix(path: Path, field: str, rows: list[list[float]], size: tuple[int, int]) -> Array:
    lengths = {len(row) for row in rows}
    if len(rows) != size[0] or lengths != {size[1]}:
        columns = " or ".join(str(n) for n in sorted(lengths))
        raise DfsmError(
            f"{path}: the {_TOLD[field]} has {len(rows)} rows of {columns} numbers, expected "
            f"{size[0]} (tip speed ratios) of {size[1]} (pitch angles) for one wind speed: write "
            "it again with the ROSCO toolbox"
        )
    return np.array(rows)


# -- long tables --------------------------------------------------------------------------------


def _long(path: Path, lines: Sequence[str]) -> RotorTable:
    first = lines[0] if lines else ""
    delimiter = max(",;\t", key=first.count)
    if delimiter in first:
        rows = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter))
    else:
        rows = [line.split() for line in lines]
    columns, unit = _columns(path, rows[0] if rows else [])
    body = rows[1:]
    if body and all(re.fullmatch(r"\s*(\(.*\)|\[.*\]|-)\s*", cell) for cell in body[0]):
        # OpenFAST's second line of units.
        unit = unit or _UNITS.get(body[0][columns["pitch"]].strip("()[] ").casefold(), "")
        body = body[1:]
    for row in body:
        if len(row) != len(rows[0]):
            raise DfsmError(
                f"{path}: a row has {len(row)} values, but the header names {len(rows[0])} "
                "columns: correct or remove the row"
            )
    if not body:
        raise DfsmError(f"{path} has a header and no rows, {_EXPECTED}: export it again")
    data = np.array([_numbers(path, row) for row in body])
    fields = {field: data[:, column] for field, column in columns.items()}
    if unit == "rad":
        fields["pitch"] = np.rad2deg(fields["pitch"])
    pitch, at_pitch = _axis(fields["pitch"])
    ratio, at_ratio = _axis(fields["tip_speed_ratio"])
    size = (len(ratio), len(pitch))
    counts = np.zeros(size, dtype=np.int64)
    np.add.at(counts, (at_ratio, at_pitch), 1)
    if (counts != 1).any():
        row, column = np.argwhere(counts != 1)[0]
        raise DfsmError(
            f"{path}: {counts[row, column] or 'no'} rows have pitch {pitch[column]:g} deg and tip "
            f"speed ratio {ratio[row]:g}, expected one for each of {size[1]} pitch angles and "
            f"{size[0]} ratios: export a complete table"
        )
    tables = {field: np.zeros(size) for field in _TABLES if field in fields}
    for field, table in tables.items():
        table[at_ratio, at_pitch] = fields[field]
    return _table(path, pitch, ratio, tables)


def _columns(path: Path, header: Sequence[str]) -> tuple[dict[str, int], str]:
    """Column of everything that a header names, and the unit of the pitch."""
    columns, unit = dict[str, int](), ""
    for i, cell in enumerate(header):
        name, told = split_header(cell.strip().strip("\"'"))
        words = [w for w in re.split(r"[\W_]+", name.casefold()) if w]
        if words and words[-1] in _UNITS:
            told = told or words.pop()
        # AeroDyn's BldPitch1: a number tells blades apart.
        plain = "".join(words).rstrip("0123456789")
        field = next((f for f, names in _NAMES.items() if plain in names), None)
        if field is None or field in columns:
            continue
        columns[field] = i
        if field == "pitch" and told:
            unit = _UNITS.get(told.casefold(), told)
            if unit not in ("deg", "rad"):
                raise DfsmError(
                    f"{path}: blade pitch is in '{told}', expected deg or rad: convert it"
                )
    for field in ("pitch", "tip_speed_ratio", "cp", "ct"):
        if field not in columns:
            shown = ", ".join(cell.strip() for cell in header[:12])[:200]
            raise DfsmError(
                f"{path}: no column for the {_TOLD[field]} among '{shown}', {_EXPECTED}: "
                "name the columns in the first line"
            )
    return columns, unit


def _axis(values: Array) -> tuple[Array, IntArray]:
    """The different values, increasing, and which of them each one is.

    Values that differ by rounding, as 0.1 + 0.2 and 0.3, are one.
    """
    order = np.sort(values)
    slack = 1e-6 * max(float(order[-1] - order[0]), 1e-12)
    new = np.concatenate([[True], np.diff(order) > slack])
    axis = order[new]
    return axis, np.abs(values[:, None] - axis).argmin(axis=1)


# -- checks -------------------------------------------------------------------------------------


def _table(path: Path, pitch: Array, ratio: Array, tables: Mapping[str, Array]) -> RotorTable:
    if "cq" not in tables and (ratio <= 0).any():
        raise DfsmError(
            f"{path}: tip speed ratios from {ratio.min():g} on and no torque coefficient, which "
            "is Cp / tip speed ratio only above 0: add Cq or leave those rows out"
        )
    cq = tables["cq"] if "cq" in tables else tables["cp"] / ratio[:, None]
    return RotorTable(pitch, ratio, tables["cp"], tables["ct"], cq, str(path))


def _check_axis(where: str, what: str, axis: Array) -> None:
    if axis.ndim != 1 or len(axis) < _FEWEST:
        raise DfsmError(
            f"{where}: {axis.size} values of the {what}, at least {_FEWEST} are needed: compute "
            "the table at more"
        )
    if not np.isfinite(axis).all():
        raise DfsmError(f"{where}: a {what} is not finite: correct it")
    if not (np.diff(axis) > 0).all():
        at = int(np.argmax(np.diff(axis) <= 0))
        raise DfsmError(
            f"{where}: the {what} goes from {axis[at]:g} to {axis[at + 1]:g}, expected values "
            "that rise: sort the table"
        )


def _check_entries(where: str, name: str, values: Array, size: tuple[int, int]) -> None:
    if values.shape != size:
        shape = " x ".join(str(n) for n in values.shape)
        raise DfsmError(
            f"{where}: {name} is {shape}, expected {size[0]} tip speed ratios x {size[1]} pitch "
            "angles: transpose or compute it again"
        )
    if bad := int((~np.isfinite(values)).sum()):
        raise DfsmError(
            f"{where}: {name} is not finite at {bad} of {values.size} places: leave out "
            "pitch angles or tip speed ratios at which the rotor code did not converge"
        )


def _check_physics(table: RotorTable) -> None:
    where, ratio = table.source, table.tip_speed_ratio
    if ratio[0] < 0:
        raise DfsmError(
            f"{where}: tip speed ratios begin at {ratio[0]:g}, expected 0 or more: turn the sign, "
            "or check which axis is which"
        )
    best = np.unravel_index(np.argmax(table.cp), table.cp.shape)
    at = f"at pitch {table.pitch[best[1]]:g} deg and tip speed ratio {ratio[best[0]]:g}"
    cp, ct = table.cp[best], table.ct[best]
    if cp > BETZ:
        raise DfsmError(
            f"{where}: Cp is {cp:.4g} {at}, above the Betz limit 16/27 = 0.593: check which "
            "coefficient is which"
        )
    if cp <= 0:
        raise DfsmError(
            f"{where}: Cp is nowhere positive, a rotor that takes power from the wind was "
            "expected: check its sign"
        )
    if ct <= 0:
        raise DfsmError(
            f"{where}: Ct is {ct:.4g} {at}, where the power is largest; expected a positive "
            "thrust, downwind: turn its sign"
        )
    difference = np.abs(table.cq * ratio[:, None] - table.cp) / np.maximum(ratio[:, None], 1.0)
    largest = np.unravel_index(np.argmax(difference), difference.shape)
    allowed = _CONSISTENT * float(np.abs(table.cq).max())
    if difference[largest] > allowed:
        here = f"pitch {table.pitch[largest[1]]:g} deg and tip speed ratio {ratio[largest[0]]:g}"
        raise DfsmError(
            f"{where}: Cq is {table.cq[largest]:.4g} at {here}, but Cp / tip speed ratio is "
            f"{table.cp[largest] / max(ratio[largest[0]], 1e-9):.4g}: check which coefficient and "
            "which axis is which, or leave Cq out"
        )
    # In degrees, a degree or two around the optimum cost a few per cent; radians reach feather.
    if np.abs(table.pitch).max() <= _RADIANS and table.cp[best[0]].min() < 0.5 * cp:
        raise DfsmError(
            f"{where}: blade pitch goes from {table.pitch[0]:g} to {table.pitch[-1]:g} deg, over "
            f"which Cp falls from {cp:.3g} to {table.cp[best[0]].min():.3g}: that looks like rad, "
            "convert it to deg"
        )

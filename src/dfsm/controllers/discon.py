"""ROSCO's DISCON.IN, line by line: what is not changed stays as it was, byte by byte.

A line holds values, then the key: ``1.0081  ! F_LPFCornerFreq - Corner frequency``. Words end at
blanks, tabs, commas, semicolons, quotes and exclamation marks, keys are read without case, and
where a key stands twice the library takes the last line. Numbers are written with as many digits as
they have.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np

from dfsm.core.files import existing_file, write_file
from dfsm.core.settings import require_kind
from dfsm.core.types import Array
from dfsm.errors import DfsmError, near_matches, printable

Value: TypeAlias = "float | int | str | Sequence[float] | Array"

# Keys whose value is a file; a relative name counts from the folder of the DISCON.IN.
FILES = ("PerfFileName", "OL_Filename", "DLL_FileName", "DLL_InFile")
# ROSCO reads lines up to here and drops the rest without a word.
LONGEST_LINE = 2048

_WORD = re.compile(r"[^\s,;!'\"]+")
# What stands before the first exclamation mark outside quotes, and behind it.
_LINE = re.compile(r"((?:\"[^\"]*\"|'[^']*'|[^!\"'])*)(.*)", re.DOTALL)
_QUOTED = re.compile(r"\s*(\"[^\"]*\"|'[^']*')")
# Keys that choose or count.
_WHOLE = re.compile(r"(mode|_n|type|_ind|_comm|filts|level|echo)$|^ind_", re.IGNORECASE)
_INTEGER = re.compile(r"[+-]?\d+")


@dataclass(frozen=True)
class Discon:
    """A DISCON.IN.

    Attributes
    ----------
    path
        Where it was read; relative names in it count from its folder.
    lines
        Its lines with their ends; bytes that are no UTF-8 as surrogates.
    """

    path: Path
    lines: tuple[str, ...]

    @cached_property
    def _at(self) -> dict[str, tuple[str, int]]:
        """Key as it is written and its line, by the key without case; the last line counts."""
        found: dict[str, tuple[str, int]] = {}
        for i, line in enumerate(self.lines):
            key = _parted(line)[1]
            if key:
                found[key.casefold()] = (key, i)
        return found

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys, as they are written."""
        return tuple(key for key, _ in self._at.values())

    @property
    def repeated(self) -> tuple[str, ...]:
        """Keys that stand in more than one line."""
        seen = [key.casefold() for line in self.lines if (key := _parted(line)[1])]
        return tuple(key for folded, (key, _) in self._at.items() if seen.count(folded) > 1)

    def __contains__(self, key: str) -> bool:
        return key.casefold() in self._at

    def words(self, key: str) -> list[str]:
        """Values of a key as they are written.

        Raises
        ------
        DfsmError
            There is no such key.
        """
        if key not in self:
            raise DfsmError(
                f"{printable(str(self.path))} has no key {key}; {near_matches(key, self.keys)}"
            )
        return _WORD.findall(_parted(self.lines[self._at[key.casefold()][1]])[0])

    def array(self, key: str) -> Array:
        """Values of a key as numbers, shape ``(value,)``.

        Raises
        ------
        DfsmError
            There is no such key, or a value is no number.
        """
        words = self.words(key)
        try:
            return np.array([_number(w) for w in words])
        except ValueError:
            raise DfsmError(
                f"{printable(str(self.path))}: {key} is '{printable(' '.join(words))}', expected "
                "numbers: correct it"
            ) from None

    def number(self, key: str) -> float:
        """First value of a key.

        Raises
        ------
        DfsmError
            There is no such key, or its value is no number.
        """
        return float(self.array(key)[0])

    def integer(self, key: str, default: int | None = None) -> int:
        """First value of a key, a whole number.

        Raises
        ------
        DfsmError
            There is no such key and no default, or its value is no whole number.
        """
        if default is not None and key not in self:
            return default
        word = self.words(key)[0]
        if not _INTEGER.fullmatch(word):
            raise DfsmError(
                f"{printable(str(self.path))}: {key} is '{printable(word)}', expected a whole "
                "number: correct it"
            )
        return int(word)

    def file(self, key: str) -> Path:
        """The file that a key names.

        Raises
        ------
        DfsmError
            There is no such key.
        """
        self.words(key)
        text = _parted(self.lines[self._at[key.casefold()][1]])[0].strip()
        return self.path.parent / text.strip("\"'").strip()

    def changed(self, values: Mapping[str, Value]) -> Discon:
        """The same file with other values; all lines but theirs stay as they are.

        Parameters
        ----------
        values
            By key, without case: a number, a text, or as many numbers as the key has.

        Raises
        ------
        DfsmError
            There is no such key, a value is not finite or none for this key, the number of values
            is not what the key that counts them says, or a line becomes longer than ROSCO reads.
        """
        lines = list(self.lines)
        for key, value in values.items():
            new = _written(self, key, value)
            if new is None:
                continue
            at = self._at[key.casefold()][1]
            before, _, behind = _parted(lines[at])
            # What stands behind keeps its column where there is room.
            lines[at] = new.ljust(len(before) - 1) + (" " if before[-1:].isspace() else "") + behind
            if len(lines[at].rstrip("\r\n")) > LONGEST_LINE:
                raise DfsmError(
                    f"{key} would make a line of {len(lines[at])} letters, and ROSCO reads "
                    f"{LONGEST_LINE}: give it fewer digits or fewer values"
                )
        new = replace(self, lines=tuple(lines))
        for counted, count in COUNTS.items():
            told = {counted.casefold(), count.casefold()} & {k.casefold() for k in values}
            if told and counted in new and count in new:
                check_count(new, counted, count)
        return new

    def moved(self, path: str | Path) -> Discon:
        """The same file elsewhere: relative names in it are changed so that they name the same."""
        path = Path(path)
        if path.parent.resolve() == self.path.parent.resolve():
            return replace(self, path=path)
        names = {
            key: os.path.relpath(self.file(key), path.parent)
            for key in FILES
            if key in self and self._names_a_relative_file(key)
        }
        return replace(self.changed(names), path=path)

    def _names_a_relative_file(self, key: str) -> bool:
        file = self.file(key)
        words = self.words(key)
        return bool(words) and not Path(words[0]).is_absolute() and file.is_file()


# Keys of several values, and the key that says how many.
COUNTS = {
    **dict.fromkeys(
        ("PC_GS_angles", "PC_GS_KP", "PC_GS_KI", "PC_GS_KD", "PC_GS_TF"),
        "PC_GS_n",
    ),
    **dict.fromkeys(("VS_KP", "VS_KI"), "VS_n"),
    **dict.fromkeys(("VS_FBP_U", "VS_FBP_Omega", "VS_FBP_Tau"), "VS_FBP_n"),
    **dict.fromkeys(("WE_FOPoles_v", "WE_FOPoles"), "WE_FOPoles_N"),
    **dict.fromkeys(("PS_WindSpeeds", "PS_BldPitchMin"), "PS_BldPitchMin_N"),
    **dict.fromkeys(("Fl_Kp", "Fl_U"), "Fl_n"),
    **dict.fromkeys(("F_NotchFreqs", "F_NotchBetaNum", "F_NotchBetaDen"), "F_NumNotchFilts"),
    "F_GenSpdNotch_Ind": "F_GenSpdNotch_N",
    "F_TwrTopNotch_Ind": "F_TwrTopNotch_N",
}


def read_discon(path: str | Path) -> Discon:
    """Read a DISCON.IN.

    Raises
    ------
    DfsmError
        There is no such file, or it holds no keys of ROSCO.
    """
    require_kind("path", path, str | os.PathLike, "the path of a DISCON.IN")
    path = existing_file(path)
    text = path.read_bytes().decode("utf-8", errors="surrogateescape")
    discon = Discon(path, tuple(re.findall(r"[^\n]*\n|[^\n]+", text)))
    if "VS_ControlMode" not in discon and "PC_ControlMode" not in discon:
        raise DfsmError(
            f"{printable(str(path))} has neither VS_ControlMode nor PC_ControlMode, expected "
            "ROSCO's DISCON.IN, with lines as '2 ! VS_ControlMode': check the name"
        )
    return discon


def write_discon(discon: Discon, path: str | Path) -> None:
    """Write a DISCON.IN, in one step.

    What was not changed is the same to the byte; in another folder, relative names of files are
    changed so that they name the same files.

    Parameters
    ----------
    discon
        What to write.
    path
        Where.

    Raises
    ------
    DfsmError
        The file cannot be written.
    """
    with write_file(path) as temporary:
        temporary.write_bytes(discon_bytes(discon, path))


def discon_bytes(discon: Discon, path: str | Path) -> bytes:
    """Return what `write_discon` writes to a path."""
    text = "".join(discon.moved(path).lines)
    return text.encode("utf-8", errors="surrogateescape")


def check_count(discon: Discon, counted: str, count: str) -> None:
    """Refuse a key with another number of values than the key that counts them says.

    Where none are counted anything may stand: ROSCO's own decks have a value there.

    Raises
    ------
    DfsmError
        Names both keys.
    """
    found, expected = len(discon.words(counted)), discon.integer(count)
    if found != expected and expected > 0:
        raise DfsmError(
            f"{printable(str(discon.path))}: {counted} has {found} values, expected {count} = "
            f"{expected}: make them agree"
        )


def _parted(line: str) -> tuple[str, str, str]:
    """Text of the values of a line, its key ('' where it has none), and the text behind them."""
    before, behind = _LINE.fullmatch(line).groups()  # pyright: ignore[reportOptionalMemberAccess]
    quoted = _QUOTED.match(before)
    words = list(_WORD.finditer(before, quoted.end() if quoted else 0))
    # ROSCO asks for no exclamation mark: a word behind numbers, or behind a text, is the key.
    if quoted or (words and _is_number(words[0].group())):
        key = next((w for w in words if not _is_number(w.group())), None)
        if key is not None:
            return line[: key.start()], key.group(), line[key.start() :]
    first = _WORD.search(behind) if behind.startswith("!") and _WORD.search(before) else None
    return (before, first.group(), behind) if first else (line, "", "")


def _is_number(word: str) -> bool:
    try:
        _number(word)
    except ValueError:
        return False
    return True


def _number(word: str) -> float:
    """A number as Fortran writes it, 1.0D+05."""
    return float(re.sub("[dD]", "e", word))


def _written(discon: Discon, key: str, value: Value) -> str | None:
    """Values as text, at full precision; None where they are there already."""
    before = discon.words(key)
    if isinstance(value, str):
        return f'"{value}"'
    numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if numbers.ndim > 1 or not np.isfinite(numbers).all():
        raise DfsmError(f"{key} is to become {value}, expected finite numbers in one row")
    if _WHOLE.search(key) and (numbers != np.round(numbers)).any():
        raise DfsmError(f"{key} is to become {value}, expected whole numbers")
    whole = all(_INTEGER.fullmatch(word) for word in before)
    words = [
        str(int(number)) if whole and number == int(number) else repr(float(number))
        for number in numbers
    ]
    if len(words) == len(before):
        # What has the value already keeps its digits.
        same = [
            _is_number(old) and _number(old) == new
            for old, new in zip(before, numbers, strict=True)
        ]
        words = [old if kept else new for old, new, kept in zip(before, words, same, strict=True)]
        if all(same):
            return None
    return "  ".join(words)

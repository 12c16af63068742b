"""One decorator for every settings class: frozen, keyword-only, checked when read from YAML."""

from __future__ import annotations

import math
import operator
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import UnionType
from typing import TypeVar, dataclass_transform

from dfsm.errors import DfsmError, printable

T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def settings_class(cls: type[T]) -> type[T]:
    """Turn a class into a frozen, keyword-only dataclass that rejects unknown keys.

    Python callers get a plain dataclass. When pydantic validates one (`config.py`), an unknown
    key or a wrong type is an error that carries the key's path.
    """
    new = dataclass(frozen=True, kw_only=True)(cls)
    new.__pydantic_config__ = {"extra": "forbid"}  # pyright: ignore[reportAttributeAccessIssue]
    return new


def require(holds: bool, name: str, value: object, expected: str) -> None:
    """Refuse the value of a setting unless `holds`, in one sentence."""
    if not holds:
        raise DfsmError(f"{name} is {value}, expected {expected}")


def shown(value: object) -> str:
    """A value of any type as a sentence tells it: short, and text as text."""
    if value is None or isinstance(value, bool | int | float | complex):
        return str(value)
    if isinstance(value, str):
        return f"'{printable(value)}'"
    if isinstance(value, PurePath):
        return f"the path '{printable(str(value))}'"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    text = printable(str(value))
    # What stands for an object's address says nothing, what fills a page says too much.
    plain = type(value).__str__ is not object.__str__ or type(value).__repr__ is not object.__repr__
    if plain and len(text) <= 60:
        return text
    count = f" with {len(value)} entries" if isinstance(value, list | tuple | dict) else ""
    return f"an object of type {type(value).__name__}{count}"


def require_number(
    name: str,
    value: object,
    expected: str,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
    whole: bool = False,
    infinite: bool = False,
    optional: bool = False,
) -> None:
    """Refuse a setting that is no number, not finite or beyond its limits.

    Parameters
    ----------
    name, value
        The setting, and what it was given: anything. Arrays without axes are numbers.
    expected
        What is, for the sentence.
    above, least, most
        The number lies above the first, and reaches the others at most.
    whole
        Whether it is of a type that counts: 2.0 is none.
    infinite
        Whether it may be infinite.
    optional
        Whether None will do, too.

    Raises
    ------
    DfsmError
        It is not.
    """
    if optional and value is None:
        return
    number = _number(value)
    holds = above < number and least <= number <= most
    holds = holds and (infinite or math.isfinite(number)) and not (whole and not _counts(value))
    if not holds:
        require(False, name, shown(value), expected)


def _number(value: object) -> float:
    """A value as a number; not a number for what is none."""
    # Text that reads like a number, and yes and no, which Python counts as 1 and 0.
    if isinstance(value, str | bytes | bool) or getattr(value, "ndim", 0):
        return math.nan
    if getattr(getattr(value, "dtype", None), "kind", "f") not in "iuf":
        return math.nan
    try:
        return float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _counts(value: object) -> bool:
    try:
        operator.index(value)  # pyright: ignore[reportArgumentType]
    except TypeError:
        return False
    return True


def require_list(name: str, values: object, expected: str) -> None:
    """Refuse what is not several values; a text is one, and names with values are no list.

    Raises
    ------
    DfsmError
        What came, and what was `expected`.
    """
    several = isinstance(values, Collection) and not isinstance(values, str | bytes | Mapping)
    # An array without axes has no entries.
    if not (several and getattr(values, "ndim", 1) > 0):
        require(False, name, shown(values), expected)


def require_kind(name: str, value: object, kind: type | UnionType, expected: str) -> None:
    """Refuse an argument that is of another type, or of none of several.

    Raises
    ------
    DfsmError
        What came, and what was `expected`.
    """
    # To show a model takes longer than many a call that is given one.
    if not isinstance(value, kind):
        require(False, name, shown(value), expected)

"""One decorator for every settings class: frozen, keyword-only, checked when read from YAML."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, dataclass_transform

from dfsm.errors import DfsmError

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

"""Numbers of a controller by name: read, and replaced in a form that JAX can differentiate.

A name is that of a field, ``kp``, of a field of what a wrapper holds, ``inner.kp``, or a key of a
DISCON.IN. One value of several is ``PC_GS_KP[3]``, all of them times a factor
``PC_GS_KP.factor``, which begins at 1.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from dfsm.controllers.rosco import ROSCO
from dfsm.errors import DfsmError, near_matches

_FACTOR = ".factor"
_INDEXED = re.compile(r"(.*?)\[(\d+(?:\s*,\s*\d+)*)\]")


@dataclass(frozen=True)
class Gain:
    """One number of a controller, or a factor on several.

    Attributes
    ----------
    name
        As it was written.
    leaf
        Which of the controller's numbers.
    index
        Which of several; None takes all.
    factor
        Whether it multiplies them.
    start
        Its value in the controller.
    """

    name: str
    leaf: str
    index: tuple[int, ...] | None
    factor: bool
    start: float

    def replaced(self, values: Any, value: Any) -> Any:
        """The numbers with this one replaced; `value` may be traced."""
        array = jnp.asarray(values, dtype=float)
        if self.factor:
            return array * value
        return array.at[self.index].set(value) if self.index else 0 * array + value


def numbers_of(controller: Any) -> dict[str, Any]:
    """All numbers of a controller that can be tuned, by name."""
    if isinstance(controller, ROSCO):
        return dict(controller.parameters)
    found: dict[str, Any] = {}
    for field in fields(controller) if is_dataclass(controller) else ():
        value = getattr(controller, field.name)
        if field.metadata.get("static", False):
            continue
        if is_dataclass(value):
            found |= {f"{field.name}.{name}": leaf for name, leaf in numbers_of(value).items()}
        elif _is_number(value):
            found[field.name] = value
    return found


def find_gain(controller: Any, name: str) -> Gain:
    """The number that a name stands for.

    Raises
    ------
    DfsmError
        The controller has no such number, or it has several values and the name says not which.
    """
    known = numbers_of(controller)
    leaf, factor, index = name, name.endswith(_FACTOR), None
    if factor:
        leaf = name.removesuffix(_FACTOR)
    elif (indexed := _INDEXED.fullmatch(name)) is not None:
        leaf, index = indexed.group(1), tuple(int(i) for i in indexed.group(2).split(","))
    if not known:
        raise DfsmError(
            f"{type(controller).__name__} has no numbers that could be replaced by name, as "
            f"'{leaf}': declare them as fields of an equinox module, `{leaf}: float = 1.0`, or of "
            "a dataclass, which a sweep takes too"
        )
    if leaf not in known:
        raise DfsmError(f"the controller has no gain '{leaf}'; {near_matches(leaf, known)}")
    values = np.asarray(known[leaf], dtype=np.float64)
    if factor:
        return Gain(name, leaf, None, True, 1.0)
    if index is not None and (
        len(index) != values.ndim or any(i >= n for i, n in zip(index, values.shape, strict=True))
    ):
        raise DfsmError(
            f"{name}: {leaf} has values of shape {values.shape}, and an index counts from 0: "
            "correct it"
        )
    if index is None and values.size != 1:
        raise DfsmError(
            f"{leaf} has {values.size} values: name one, as {leaf}[0], or a factor on all of "
            f"them, {leaf}{_FACTOR}"
        )
    return Gain(name, leaf, index, False, float(values[index] if index else values.ravel()[0]))


def with_numbers(controller: Any, values: Mapping[str, Any]) -> Any:
    """The same controller with other numbers by name, which may be traced."""
    if isinstance(controller, ROSCO):
        return replace(controller, parameters={**controller.parameters, **values})
    own: dict[str, Any] = {}
    inner: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        first, point, rest = name.partition(".")
        if point:
            inner.setdefault(first, {})[rest] = value
        else:
            own[first] = value
    for name, parts in inner.items():
        own[name] = with_numbers(getattr(controller, name), parts)
    return replace(controller, **own)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool | str) or value is None:
        return False
    try:
        return np.issubdtype(np.asarray(value).dtype, np.number)
    except (TypeError, ValueError):
        return False

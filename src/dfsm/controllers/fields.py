"""What the fields of controllers may hold: numbers, limits, names; told in one sentence if not."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np

from dfsm.core.settings import require, require_number, shown


def numbers(name: str, optional: bool = False) -> Callable[[Any], Any]:
    """What makes the value of a field an array of numbers, which may be traced.

    Parameters
    ----------
    name
        Of the field.
    optional
        Whether None stays None.
    """

    def converted(value: Any) -> Any:
        if optional and value is None:
            return None
        try:
            found = None if value is None else jnp.asarray(value)
        except (TypeError, ValueError):
            found = None
        good = found is not None and found.dtype.kind in "iuf"
        require(good, name, shown(value), "a number, or numbers")
        return found

    return converted


def texts(value: Any) -> Any:
    """Several texts as a tuple; what are none stays, for `require_controller` to refuse."""
    listed = isinstance(value, Iterable) and not isinstance(value, str)
    return tuple(value) if listed else value


def require_numbers(controller: Any, names: str, expected: str, **limits: Any) -> None:
    """Refuse fields of which a number is not what it must be; None will do.

    Parameters
    ----------
    controller
        Whose fields they are.
    names
        Of the fields, with spaces between.
    expected, limits
        See `require_number`.

    Raises
    ------
    DfsmError
        Names the field and the number.
    """
    for name in names.split():
        value = getattr(controller, name)
        for number in () if value is None else np.ravel(np.asarray(value)).tolist():
            require_number(name, number, expected, **limits)


def require_limits(limits: Any, equal: bool = False) -> None:
    """Refuse limits of a command that are no pair of numbers, the lower one first.

    Parameters
    ----------
    limits
        Lowest and highest command, which may be infinite; numbers or shape ``(command,)``.
    equal
        Whether both may be the same.

    Raises
    ------
    DfsmError
        They are not.
    """
    try:
        low, high = (np.asarray(numbers("limits")(limit)) for limit in limits)
    except (TypeError, ValueError):
        rising = False
    else:
        rising = bool(((low <= high) if equal else (low < high)).all())
        limits = (low.tolist(), high.tolist())
    require(rising, "limits", shown(limits), "the lower one first, then the higher one")


def pair_of(limits: Any) -> Any:
    """Limits of which each may be a list; what is no pair stays, for `require_limits` to refuse."""
    if not isinstance(limits, list | tuple) or len(limits) != 2:
        return limits
    return tuple(numbers("limits")(x) if isinstance(x, list | tuple) else x for x in limits)


def require_shapes(controller: Any, names: str, count: int | None, of_what: str = "") -> None:
    """Refuse fields that are neither a number nor one number for each of some things.

    To be asked where a loop begins, not where a controller is made: fields of one that a function
    is mapped over have an axis more.

    Parameters
    ----------
    controller
        Whose fields they are.
    names
        Of the fields, with spaces between; None will do, and of a pair of limits each counts.
    count
        How many things there are; None for a number alone.
    of_what
        What they are.

    Raises
    ------
    DfsmError
        Names the field and its shape.
    """
    expected = "a number" if count is None else f"a number or shape ({count},): one per {of_what}"
    for name in names.split():
        value = getattr(controller, name)
        for part in value if isinstance(value, tuple) else (value,):
            shape = np.shape(part) if part is not None else ()
            good = shape == () or (count is not None and shape == (count,))
            require(good, f"{name} of shape", shape, expected)

"""Controllers that keep their state in themselves, each loop with one of its own."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from threading import Lock
from typing import Any

import equinox as eqx

# A library that several copies call holds one state for all of them.
_ONE_AT_A_TIME = Lock()


def is_frozen(controller: Any) -> bool:
    """Whether neither a controller nor what it wraps can write into itself."""
    inner = getattr(controller, "inner", None)
    frozen = isinstance(controller, eqx.Module) or (
        is_dataclass(controller) and controller.__dataclass_params__.frozen  # pyright: ignore[reportAttributeAccessIssue]
    )
    return frozen and (inner is None or is_frozen(inner))


@contextmanager
def own_to_a_loop(controller: Any) -> Iterator[Any]:
    """A controller for one loop: as if nobody had used it before, or used it at the same time.

    What is frozen is what `start` and `step` return, and serves any number of loops at once. Any
    other is copied, and has the process to itself; where it cannot be copied, `start` alone can
    make it new.

    Parameters
    ----------
    controller
        Steps on the host.

    Yields
    ------
    object
        The same controller, or its copy.
    """
    if is_frozen(controller):
        yield controller
        return
    with _ONE_AT_A_TIME:
        try:
            own = copy.deepcopy(controller)
        # What an object of somebody else's raises here is not known.
        except Exception:
            own = controller
        yield own

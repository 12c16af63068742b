"""Digests of what a closed loop depends on: model, controller, run; equal ones give equal loops."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path, PurePath
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.bladed import BladedLibrary
from dfsm.controllers.discon import FILES, Discon
from dfsm.controllers.traced import as_arrays, is_compiled
from dfsm.core.files import json_value
from dfsm.core.version import __version__
from dfsm.data.trajectory import Trajectory
from dfsm.models.dfsm import DFSM

# Code that the version of this package tells of, or that is the same for everybody.
_OURS = ("dfsm", "equinox", "typing", "abc")


class _UnknownError(Exception):
    """What something does depends on more than can be told."""


def recorded_code(function: Callable[..., Any], *arguments: Any) -> tuple[Any, ...]:
    """What a function computes, step by step as JAX records it, and constants therein.

    Numbers say too little of a controller: its delays and filters may be written into its code,
    and a code that was edited is another controller of the same name.
    """
    recorded, *_ = eqx.filter_make_jaxpr(function)(*arguments)
    # Where a function stood in memory says nothing of it.
    return re.sub(r"0x[0-9a-f]+", "", str(recorded)), *_constants(recorded)


def _constants(recorded: Any) -> Iterator[Any]:
    """Arrays that code brought along, of functions within functions too; its text has scalars."""
    yield from getattr(recorded, "consts", ())
    for step in getattr(recorded, "jaxpr", recorded).eqns:
        yield from (v.val for v in step.invars if np.ndim(getattr(v, "val", 0.0)))
        for part in jax.tree.leaves(step.params, is_leaf=_is_recorded):
            if _is_recorded(part):
                yield from _constants(part)


def _is_recorded(part: Any) -> bool:
    return hasattr(part, "eqns") or hasattr(part, "consts")


def digest(*parts: Any) -> str:
    """Of JSON values, bytes, and pytrees of numbers and texts."""
    h = hashlib.sha256()
    for part in parts:
        for leaf in [part] if isinstance(part, bytes) else jax.tree.leaves(part):
            if hasattr(leaf, "dtype") or isinstance(leaf, bool | int | float):
                array = np.asarray(leaf)
                h.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
            elif isinstance(leaf, str | bytes):
                raw = leaf if isinstance(leaf, bytes) else leaf.encode(errors="backslashreplace")
                h.update(f"{len(raw)}:".encode() + raw)
    return h.hexdigest()


def run_digest(run: Trajectory) -> str:
    """Of all that a run holds, and its name; what was computed counts as what was recorded."""
    channels = [f"{c.name}\0{c.unit}" for c in run.channels]
    return digest(run.name, run.time, run.values, channels)


def model_digest(model: DFSM) -> str:
    """Of what a model computes, and what its signals are called."""
    s = model.signals
    groups = ("states", "controls", "disturbances", "parameters", "outputs", "field")
    names = [[[c.name, c.unit] for c in getattr(s, g)] for g in groups]
    more = [s.step, s.startup, list(s.between_samples()), repr(s.azimuth)]
    said = json.dumps(json_value([__version__, names, more]))
    zeros = [jnp.zeros(len(getattr(s, g))) for g in groups[:4]]
    code = (recorded_code(type(model).derivative, model, *zeros),)
    if model.g is not None:
        code += (recorded_code(type(model).output, model, *zeros),)
    return digest(said, model, *code)


class ControllerDigests:
    """Digests of controllers; those that differ in numbers only are recorded once."""

    def __init__(self) -> None:
        self._code: dict[Any, str] = {}

    def of(self, controller: Any, measurements: Mapping[str, str] | None) -> str | None:
        """Digest of a controller, and of the signals that stand for what it reads.

        None where what it does depends on more than can be told: code that was typed and is in no
        file, a library that reads files which only it knows.
        """
        wires = [
            *(list(getattr(controller, name)) for name in ("measurements", "measurement_units")),
            *(list(getattr(controller, name)) for name in ("commands", "command_units")),
            [float(controller.interval)],
            sorted((measurements or {}).items()),
        ]
        try:
            if is_compiled(controller):
                return digest(json.dumps(wires), controller, self._compiled(controller))
            return digest(json.dumps(wires), *_told(controller, set()))
        except _UnknownError:
            return None

    def _compiled(self, controller: Any) -> str:
        arrays = as_arrays(controller)
        leaves, structure = jax.tree.flatten(arrays)
        key = (structure, tuple(getattr(leaf, "shape", None) for leaf in leaves))
        try:
            known = self._code.get(key)
        except TypeError:  # a field that cannot be hashed
            return digest(_code_of(arrays))
        if known is None:
            known = self._code[key] = digest(_code_of(arrays))
        return known


def _code_of(controller: Any) -> tuple[Any, ...]:
    """What the start and a step of a controller that JAX can follow compute."""

    def once(controller: Any, seen: Any, commands: Any, time: Any) -> Any:
        return controller.step(controller.start(seen, commands), seen, time)

    seen, commands = jnp.zeros(len(controller.measurements)), jnp.zeros(len(controller.commands))
    return recorded_code(once, controller, seen, commands, jnp.zeros(()))


def _told(value: Any, above: set[int]) -> Iterator[bytes]:
    """All that an object which steps on the host is made of: its values, and the files of its code.

    Raises
    ------
    _UnknownError
        There is a part that cannot be told.
    """
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | PurePath):
        yield repr(value).encode(errors="backslashreplace")
    elif hasattr(value, "dtype") and hasattr(value, "shape"):
        array = np.asarray(value)
        if array.dtype.kind not in "biufcSU":
            raise _UnknownError
        yield f"{array.dtype}{array.shape}".encode() + array.tobytes()
    elif id(value) in above:
        raise _UnknownError
    elif isinstance(value, list | tuple):
        yield f"{type(value).__name__}{len(value)}".encode()
        for part in value:
            yield from _told(part, above | {id(value)})
    elif isinstance(value, dict):
        yield from _told(list(value.items()), above | {id(value)})
    elif isinstance(value, BladedLibrary):
        yield from _of_library(value)
    elif isinstance(value, FunctionType):
        yield value.__qualname__.encode()
        yield _file_of(value)
        yield from _told([value.__defaults__, value.__closure__ is None], above | {id(value)})
        if value.__closure__:
            cells = [cell.cell_contents for cell in value.__closure__]
            yield from _told(cells, above | {id(value)})
    else:
        yield from _of_object(value, above | {id(value)})


def _of_object(value: Any, above: set[int]) -> Iterator[bytes]:
    kind = type(value)
    yield kind.__qualname__.encode()
    classes = [c for c in kind.__mro__ if c is not object]
    own = [c for c in classes if c.__module__.partition(".")[0] not in _OURS]
    for part in own:
        functions = [f for f in vars(part).values() if isinstance(f, FunctionType)]
        if not functions:
            raise _UnknownError
        yield from {_file_of(f) for f in functions}
    values = {f.name: getattr(value, f.name) for f in fields(value)} if is_dataclass(value) else {}
    values |= getattr(value, "__dict__", {})
    if not values and not own:
        raise _UnknownError
    yield from _told(values, above)


def _file_of(function: FunctionType) -> bytes:
    try:
        return Path(function.__code__.co_filename).read_bytes()
    except OSError:
        raise _UnknownError from None


def _of_library(library: BladedLibrary) -> Iterator[bytes]:
    """A library, its deck and the files that the deck names."""
    deck = library.discon
    if not isinstance(deck, Discon | None):
        raise _UnknownError  # an input of somebody else's, which may name other files
    numbers = (library.interval, library.gearbox, library.efficiency, library.blades)
    yield repr((numbers, library.procedure, sorted(library.channels.items()))).encode()
    try:
        yield library.library.read_bytes()
        if deck is not None:
            yield "".join(deck.lines).encode("utf-8", errors="surrogateescape")
            for key in FILES:
                if key in deck and deck.file(key).is_file():
                    yield key.encode() + deck.file(key).read_bytes()
    except OSError:
        raise _UnknownError from None

"""A function of numbers as a short list of simple steps, which other programs can repeat.

Every value is a flat array; what shape it had is told by the steps that read it. There are seven
kinds of steps, so that whatever is to evaluate a model elsewhere need know no more than these:

    apply name(a[, b])   elementwise; an operand of one element goes with all of the other
    select c ? a : b     elementwise, where c is not 0
    take a[k]            at places that are fixed
    lookup a[k]          at places that are computed, whole numbers from 0
    join [a, b, …]       one behind the other
    matmul A @ B         two matrices, row after row
    reduce name(A)       along every row of a matrix: sum, max, min or prod
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array, IntArray

UNARY = (
    *("neg", "abs", "sign", "floor", "ceil", "sqrt", "exp", "log", "log1p", "expm1", "sin"),
    *("cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
    *("erf", "not"),
)
BINARY = (
    *("add", "sub", "mul", "div", "pow", "atan2", "max", "min", "rem"),
    *("lt", "le", "gt", "ge", "eq", "ne", "and", "or"),
)
REDUCTIONS = ("sum", "max", "min", "prod")


@dataclass(frozen=True)
class Step:
    """One step; its result gets the next number.

    Attributes
    ----------
    kind
        ``"apply"``, ``"select"``, ``"take"``, ``"lookup"``, ``"join"``, ``"matmul"`` or
        ``"reduce"``.
    of
        Numbers of the values that it takes.
    name
        Of the function that is applied, or of the reduction.
    places
        Of a take, ``(element,)``.
    shape
        Of a matmul, ``(rows, inner, columns)``; of a reduction, ``(rows, columns)``.
    """

    kind: str
    of: tuple[int, ...]
    name: str = ""
    places: IntArray | None = None
    shape: tuple[int, ...] = ()


@dataclass(frozen=True)
class Program:
    """Inputs, constants, steps and a result.

    Values are numbered: the inputs, then the constants, then the results of the steps.

    Attributes
    ----------
    inputs
        Name and number of elements of every argument.
    constants
        Flat arrays.
    steps
        In the order in which they are done.
    result
        Number of the value that is the result.
    """

    inputs: tuple[tuple[str, int], ...]
    constants: tuple[Array, ...]
    steps: tuple[Step, ...]
    result: int


class Recorder:
    """Collects the steps of a program; a step that was there already is not repeated."""

    def __init__(self, inputs: Sequence[tuple[str, int]]) -> None:
        self.inputs = tuple(inputs)
        self.sizes: list[int] = [size for _, size in inputs]
        # What a value is: an input's number, a constant, or a step.
        self._what: list[int | Array | Step] = list(range(len(inputs)))
        self._known: dict[object, int] = {}

    def constant(self, values: Array) -> int:
        """Number of a constant."""
        flat = np.ascontiguousarray(values, dtype=np.float64).ravel()
        return self._number(("constant", flat.tobytes()), flat, flat.size)

    def apply(self, name: str, *of: int) -> int:
        """Number of ``name(a)`` or ``name(a, b)``."""
        size = max(self.sizes[k] for k in of)
        return self._number((name, of), Step("apply", of, name), size)

    def select(self, condition: int, yes: int, no: int) -> int:
        """Number of `yes` where a condition holds, of `no` elsewhere."""
        of = (condition, yes, no)
        size = max(self.sizes[k] for k in of)
        return self._number(("select", of), Step("select", of), size)

    def take(self, value: int, places: IntArray) -> int:
        """Number of some elements of a value."""
        places = np.asarray(places, dtype=np.int64).ravel()
        if places.size == self.sizes[value] and (places == np.arange(places.size)).all():
            return value
        what = self._what[value]
        if isinstance(what, np.ndarray):
            return self.constant(what[places])
        if isinstance(what, Step) and what.kind == "take" and what.places is not None:
            return self.take(what.of[0], what.places[places])
        step = Step("take", (value,), places=places)
        return self._number(("take", value, places.tobytes()), step, places.size)

    def lookup(self, value: int, places: int) -> int:
        """Number of the elements of a value whose places another value tells."""
        of = (value, places)
        return self._number(("lookup", of), Step("lookup", of), self.sizes[places])

    def join(self, values: Sequence[int]) -> int:
        """Number of values one behind the other."""
        values = tuple(v for v in values if self.sizes[v])
        if len(values) == 1:
            return values[0]
        size = sum(self.sizes[v] for v in values)
        return self._number(("join", values), Step("join", values), size)

    def matmul(self, left: int, right: int, shape: tuple[int, int, int]) -> int:
        """Number of a product of matrices ``(rows, inner)`` and ``(inner, columns)``."""
        step = Step("matmul", (left, right), shape=shape)
        return self._number(("matmul", left, right, shape), step, shape[0] * shape[2])

    def reduce(self, name: str, value: int, shape: tuple[int, int]) -> int:
        """Number of the reduction of every row of a matrix ``(rows, columns)``."""
        step = Step("reduce", (value,), name, shape=shape)
        return self._number(("reduce", name, value, shape), step, shape[0])

    def program(self, result: int) -> Program:
        """What is needed for one value."""
        needed, todo = set[int](), [result]
        while todo:
            value = todo.pop()
            what = self._what[value]
            if value not in needed and isinstance(what, Step):
                todo += what.of
            needed.add(value)
        kept = sorted(needed)
        constants = [v for v in kept if isinstance(self._what[v], np.ndarray)]
        steps = [v for v in kept if isinstance(self._what[v], Step)]
        first = list(range(len(self.inputs)))
        new = {old: k for k, old in enumerate([*first, *constants, *steps])}

        def renumbered(step: Step) -> Step:
            of = tuple(new[v] for v in step.of)
            return Step(step.kind, of, step.name, step.places, step.shape)

        return Program(
            self.inputs,
            tuple(self._what[v] for v in constants),  # pyright: ignore[reportArgumentType]
            tuple(renumbered(self._what[v]) for v in steps),  # pyright: ignore[reportArgumentType]
            new[result],
        )

    def _number(self, key: object, what: Array | Step, size: int) -> int:
        if key not in self._known:
            self._known[key] = len(self.sizes)
            self._what.append(what)
            self.sizes.append(size)
        return self._known[key]

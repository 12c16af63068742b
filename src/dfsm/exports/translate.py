"""What JAX records of a function of vectors, as a `Program`.

JAX writes a function down as primitives on arrays of any shape; a program has flat arrays. What
only moves elements (slices, transposes, broadcasts) becomes one `take`, by moving their
numbers instead; what does not depend on the inputs is computed here; loops of known length are
written out; complex numbers are pairs of real ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.exports.program import Program, Recorder

# Longest loop that is written out.
_MOST_TURNS = 1000


class UntranslatableError(Exception):
    """A primitive has no counterpart; the text names it."""


@dataclass(frozen=True)
class Traced:
    """An array that depends on the inputs.

    Attributes
    ----------
    shape
        Its shape.
    real, imag
        Numbers of its parts in the recorder; a value of one element stands for equal elements,
        whatever the shape. No imaginary part in a real array.
    """

    shape: tuple[int, ...]
    real: int
    imag: int | None = None


Value = Traced | np.ndarray
# How a primitive of JAX is said in steps: for its equation and operands, its results.
Rule = Callable[["Translator", Any, list[Value]], list[Value]]


def shape_of(equation: Any) -> tuple[int, ...]:
    """Shape of an equation's first result."""
    return tuple(equation.outvars[0].aval.shape)


def is_whole(variable: Any) -> bool:
    """Whether a variable holds whole numbers."""
    return np.issubdtype(variable.aval.dtype, np.integer)


def real_of(to: Translator, value: Value, name: str, shape: tuple[int, ...] | None = None) -> int:
    """Number of a value without imaginary part, as an operand of a shape where one is given."""
    traced = to.traced(value) if shape is None else to.spread(value, shape)
    if traced.imag is not None:
        raise UntranslatableError(f"{name} of complex numbers")
    return traced.real


def translated(function: Callable[..., jax.Array], inputs: Sequence[tuple[str, int]]) -> Program:
    """The program of a function that takes vectors and returns one.

    Parameters
    ----------
    function
        JAX can follow it.
    inputs
        Name and number of elements of every argument.

    Raises
    ------
    UntranslatableError
        It uses a primitive that a program has no steps for.
    """
    closed = jax.make_jaxpr(function)(*(from_host(np.zeros(size)) for _, size in inputs))
    translator = Translator(Recorder(inputs))
    arguments = [Traced((size,), k) for k, (_, size) in enumerate(inputs)]
    (result,) = translator.run(closed, arguments)
    return translator.steps.program(translator.full(result))


class Translator:
    """Goes through a jaxpr and records its steps."""

    def __init__(self, steps: Recorder) -> None:
        self.steps = steps

    # -- jaxprs ---------------------------------------------------------------------------------

    def run(self, closed: Any, arguments: Sequence[Value]) -> list[Value]:
        """Values of the results of a closed jaxpr."""
        jaxpr = closed.jaxpr
        values: dict[Any, Value] = dict(zip(jaxpr.invars, arguments, strict=True))
        values |= {v: np.asarray(c) for v, c in zip(jaxpr.constvars, closed.consts, strict=True)}

        def read(atom: Any) -> Value:
            return np.asarray(atom.val) if hasattr(atom, "val") else values[atom]

        for equation in jaxpr.eqns:
            results = self.equation(equation, [read(v) for v in equation.invars])
            values |= dict(zip(equation.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, equation: Any, operands: list[Value]) -> list[Value]:
        """Values of the results of one equation."""
        # The rules import this module.
        from dfsm.exports.rules import RULES

        name = equation.primitive.name
        inner = _inner(equation)
        if name in ("scan", "cond"):
            return (
                self._scan(equation.params, operands)
                if name == "scan"
                else self._cond(equation.params, operands)
            )
        if inner is not None and name != "while":
            return self.run(inner, operands)
        if all(isinstance(v, np.ndarray) for v in operands):
            return computed(equation, operands)
        if name not in RULES:
            raise UntranslatableError(name)
        return RULES[name](self, equation, operands)

    def _scan(self, params: Any, operands: list[Value]) -> list[Value]:
        """A loop of known length, written out."""
        length, (consts, carries) = params["length"], _scanned(params)
        if length > _MOST_TURNS:
            raise UntranslatableError(f"scan of {length} turns")
        fixed, carry = operands[:consts], operands[consts : consts + carries]
        along, turns = operands[consts + carries :], list[list[Value]]()
        order = range(length)[::-1] if params["reverse"] else range(length)
        for k in order:
            results = self.run(params["jaxpr"], [*fixed, *carry, *(self.row(v, k) for v in along)])
            carry = results[:carries]
            turns.append(results[carries:])
        if params["reverse"]:
            turns.reverse()
        return [*carry, *(self.stacked(list(each)) for each in zip(*turns, strict=True))]

    def _cond(self, params: Any, operands: list[Value]) -> list[Value]:
        """All branches, and of their results those of the one that is chosen."""
        which, *rest = operands
        branches = params["branches"]
        if isinstance(which, np.ndarray):
            return self.run(branches[int(np.clip(which, 0, len(branches) - 1))], rest)
        results = [self.run(branch, rest) for branch in branches]
        return [self.chosen(which, list(cases)) for cases in zip(*results, strict=True)]

    # -- values ---------------------------------------------------------------------------------

    def traced(self, value: Value) -> Traced:
        """The value as one that is recorded."""
        if isinstance(value, Traced):
            return value
        flat: Any = value.ravel()
        # Equal elements are one.
        if flat.size > 1 and (flat == flat[0]).all():
            flat = flat[:1]
        imag = self.steps.constant(flat.imag) if np.iscomplexobj(flat) else None
        return Traced(value.shape, self.steps.constant(flat.real), imag)

    def spread(self, value: Value, shape: tuple[int, ...]) -> Traced:
        """The value as the operand of an elementwise function with a result of this shape."""
        traced = self.traced(value)
        if traced.shape == shape or self.steps.sizes[traced.real] == 1:
            return traced
        numbers = np.arange(np.prod(traced.shape), dtype=np.float64).reshape(traced.shape)
        return self.taken([traced], np.broadcast_to(numbers, shape))

    def full(self, value: Value) -> int:
        """Number of the real value with all its elements."""
        traced = self.traced(value)
        if traced.imag is not None:
            raise UntranslatableError("complex numbers")
        return self.expanded(traced.real, traced.shape)

    def expanded(self, number: int, shape: tuple[int, ...]) -> int:
        """Number of a value with as many elements as a shape has."""
        size = int(np.prod(shape))
        if self.steps.sizes[number] == size:
            return number
        return self.steps.take(number, np.zeros(size, dtype=np.int64))

    def taken(self, values: Sequence[Value], places: Array) -> Traced:
        """Elements of several values, one behind the other, at places in any shape.

        A place that is not a number takes a NaN.
        """
        parts = [self.traced(v) for v in values]
        absent, total = np.isnan(places), sum(int(np.prod(p.shape)) for p in parts)
        at = np.where(absent, total, places).astype(np.int64)

        def moved(numbers: Sequence[int]) -> int:
            full = [self.expanded(n, p.shape) for n, p in zip(numbers, parts, strict=True)]
            extra = [self.steps.constant(np.array([np.nan]))] if absent.any() else []
            return self.steps.take(self.steps.join([*full, *extra]), at)

        if len(parts) == 1 and not absent.any() and self.steps.sizes[parts[0].real] == 1:
            return Traced(at.shape, parts[0].real, parts[0].imag)
        if at.size == 0:
            return Traced(at.shape, self.steps.constant(np.zeros(0)))
        real = moved([p.real for p in parts])
        if all(p.imag is None for p in parts):
            return Traced(at.shape, real)
        zero = self.steps.constant(np.zeros(1))
        return Traced(at.shape, real, moved([zero if p.imag is None else p.imag for p in parts]))

    def row(self, value: Value, k: int, axis: int = 0) -> Value:
        """One element along an axis."""
        if isinstance(value, np.ndarray):
            return np.take(value, k, axis)
        numbers = np.arange(np.prod(value.shape), dtype=np.float64).reshape(value.shape)
        return self.taken([value], np.take(numbers, k, axis))

    def stacked(self, values: list[Value]) -> Value:
        """Values along a new first axis."""
        if all(isinstance(v, np.ndarray) for v in values):
            return np.stack(values)  # pyright: ignore[reportCallIssue, reportArgumentType]
        shape = (len(values), *values[0].shape)
        return self.taken(values, np.arange(np.prod(shape), dtype=np.float64).reshape(shape))

    def chosen(self, which: Traced, cases: list[Value]) -> Traced:
        """The case of number `which`, element by element."""
        traced = [self.traced(c) for c in cases]

        def of(parts: list[int]) -> int:
            result = parts[-1]
            for k in range(len(parts) - 2, -1, -1):
                # In a condition of two cases the number itself tells.
                if len(parts) == 2:
                    return self.steps.select(which.real, parts[1], parts[0])
                here = self.steps.apply("le", which.real, self.steps.constant(np.array([k])))
                result = self.steps.select(here, parts[k], result)
            return result

        real, shape = of([t.real for t in traced]), traced[0].shape
        if all(t.imag is None for t in traced):
            return Traced(shape, real)
        zero = self.steps.constant(np.zeros(1))
        return Traced(shape, real, of([zero if t.imag is None else t.imag for t in traced]))


def _scanned(params: Any) -> tuple[int, int]:
    """Numbers of operands of a loop that stay, and that it carries; groups from JAX 0.12 on."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts.vals), len(carry.vals)


def _inner(equation: Any) -> Any:
    """The jaxpr that an equation calls, or that a primitive of a higher level stands for."""
    params = equation.params
    expand = getattr(params.get("_prim"), "expand", None)
    if expand is not None:
        shapes = (jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in equation.invars)
        return jax.make_jaxpr(expand)(*shapes)
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        inner = params.get(key)
        if inner is not None:
            return inner if hasattr(inner, "consts") else ClosedJaxpr(inner, ())
    return None


def computed(equation: Any, operands: Sequence[Any]) -> list[Value]:
    """What an equation gives for known operands."""
    if equation.primitive.name in MOVES and len(operands):
        return [MOVES[equation.primitive.name](equation.params, *operands)]
    results = equation.primitive.bind(*(from_host(v) for v in operands), **equation.params)
    several = equation.primitive.multiple_results
    return [np.asarray(r) for r in (results if several else [results])]


def _broadcast(params: Any, x: np.ndarray) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(params: Any, x: np.ndarray) -> np.ndarray:
    steps = params["strides"] or (1,) * x.ndim
    starts, stops = params["start_indices"], params["limit_indices"]
    return x[tuple(slice(*s) for s in zip(starts, stops, steps, strict=True))]


# What moves elements most often, in NumPy: JAX would compile each of them.
MOVES: dict[str, Callable[..., np.ndarray]] = {
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "expand_dims": lambda params, x: np.expand_dims(x, tuple(params["dimensions"])),
    "transpose": lambda params, x: np.transpose(x, params["permutation"]),
    "concatenate": lambda params, *xs: np.concatenate(xs, axis=params["dimension"]),
    "rev": lambda params, x: np.flip(x, tuple(params["dimensions"])),
}

"""How each of JAX's primitives is said in the steps of a program, by its name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dfsm.exports.rules_of_axes import AXES
from dfsm.exports.translate import Rule, Traced, Translator, UntranslatableError, Value, computed
from dfsm.exports.translate import is_whole as _is_whole
from dfsm.exports.translate import real_of as _real
from dfsm.exports.translate import shape_of as _shape

# -- elementwise --------------------------------------------------------------------------------


def _applied(name: str) -> Rule:
    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        numbers = [_real(to, v, name, _shape(equation)) for v in operands]
        return [Traced(_shape(equation), to.steps.apply(name, *numbers))]

    return rule


def _logical(name: str) -> Rule:
    """Of truths; on whole numbers JAX goes bit by bit."""

    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        if equation.outvars[0].aval.dtype != bool:
            raise UntranslatableError(f"{equation.primitive.name} of the bits of whole numbers")
        return _applied(name)(to, equation, operands)

    return rule


def _composed(make: Callable[..., int]) -> Rule:
    """A rule of ``make(apply, constant, *numbers)``."""

    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        numbers = [_real(to, v, equation.primitive.name) for v in operands]

        def constant(value: float) -> int:
            return to.steps.constant(np.array([value]))

        return [Traced(_shape(equation), make(to.steps.apply, constant, *numbers))]

    return rule


def _polynomial(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """Of its first operand, with coefficients from the lowest degree on, by Horner's rule."""
    shape = _shape(equation)
    x, *coefficients = (_real(to, v, "polynomial", shape) for v in operands)
    total = coefficients.pop()
    for coefficient in reversed(coefficients):
        total = to.steps.apply("add", to.steps.apply("mul", total, x), coefficient)
    return [Traced(shape, total)]


def _each_part(name: str) -> Rule:
    """Sums, differences and signs, of real and imaginary parts alike."""

    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        traced = [to.spread(v, _shape(equation)) for v in operands]
        real = to.steps.apply(name, *(t.real for t in traced))
        if all(t.imag is None for t in traced):
            return [Traced(_shape(equation), real)]
        zero = to.steps.constant(np.zeros(1))
        imag = to.steps.apply(name, *(zero if t.imag is None else t.imag for t in traced))
        return [Traced(_shape(equation), real, imag)]

    return rule


def _mul(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    shape = _shape(equation)
    a, b = (to.spread(v, shape) for v in operands)
    return [_times(to, a, b, shape)]


def _times(to: Translator, a: Traced, b: Traced, shape: tuple[int, ...]) -> Traced:
    apply = to.steps.apply
    real = apply("mul", a.real, b.real)
    if a.imag is None and b.imag is None:
        return Traced(shape, real)
    if a.imag is None or b.imag is None:
        (part, other) = (b.imag, a.real) if a.imag is None else (a.imag, b.real)
        return (
            Traced(shape, real) if part is None else Traced(shape, real, apply("mul", part, other))
        )
    imag = apply("add", apply("mul", a.real, b.imag), apply("mul", a.imag, b.real))
    return Traced(shape, apply("sub", real, apply("mul", a.imag, b.imag)), imag)


def _exp(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    z = to.traced(operands[0])
    apply, size = to.steps.apply, to.steps.apply("exp", z.real)
    if z.imag is None:
        return [Traced(z.shape, size)]
    parts = [apply("mul", size, apply(name, z.imag)) for name in ("cos", "sin")]
    return [Traced(_shape(equation), *parts)]


def _part(name: str) -> Rule:
    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        z = to.traced(operands[0])
        part = z.real if name == "real" else z.imag
        number = to.steps.constant(np.zeros(1)) if part is None else part
        return [Traced(_shape(equation), number)]

    return rule


def _complex(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    shape = _shape(equation)
    real, imag = (_real(to, v, "complex", shape) for v in operands)
    return [Traced(shape, real, imag)]


def _conj(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    z = to.traced(operands[0])
    imag = None if z.imag is None else to.steps.apply("neg", z.imag)
    return [Traced(_shape(equation), z.real, imag)]


def _truncated(to: Translator, number: int) -> int:
    apply = to.steps.apply
    negative = apply("lt", number, to.steps.constant(np.zeros(1)))
    return to.steps.select(negative, apply("ceil", number), apply("floor", number))


def _div(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    apply, shape = to.steps.apply, _shape(equation)
    a, b = (to.spread(v, shape) for v in operands)
    if b.imag is None:
        parts = [apply("div", part, b.real) for part in (a.real, a.imag) if part is not None]
        if _is_whole(equation.outvars[0]):
            parts = [_truncated(to, parts[0])]
        return [Traced(shape, *parts)]
    size = apply("add", apply("mul", b.real, b.real), apply("mul", b.imag, b.imag))
    turned = _times(to, a, Traced(shape, b.real, apply("neg", b.imag)), shape)
    return [
        Traced(shape, *(apply("div", p, size) for p in (turned.real, turned.imag) if p is not None))
    ]


def _round(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """To the nearest whole number, halves away from zero or to the even one."""
    apply, number = to.steps.apply, _real(to, operands[0], "round")
    half, two = (to.steps.constant(np.array([v])) for v in (0.5, 2.0))
    if int(equation.params["rounding_method"]) == 0:
        up = apply("floor", apply("add", apply("abs", number), half))
        return [Traced(_shape(equation), apply("mul", apply("sign", number), up))]
    moved = apply("add", number, half)
    up = apply("floor", moved)
    odd = apply("ne", apply("rem", up, two), to.steps.constant(np.zeros(1)))
    return [Traced(_shape(equation), apply("sub", up, apply("and", apply("eq", moved, up), odd)))]


def _converted(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """Another type: only from fractions to whole numbers does a value change."""
    value, new = to.traced(operands[0]), np.dtype(equation.params["new_dtype"])
    old = equation.invars[0].aval.dtype
    if new.kind == "b" and old.kind != "b":
        zero = to.steps.constant(np.zeros(1))
        return [Traced(value.shape, to.steps.apply("ne", value.real, zero))]
    if new.kind == "u" or (new.kind == "i" and new.itemsize < 4):
        raise UntranslatableError(f"whole numbers that end at {np.iinfo(new).max}")
    if new.kind == "i" and np.issubdtype(old, np.floating):
        number = _truncated(to, value.real)
        if new.itemsize < 8:  # those beyond its ends become these
            ends = (np.array([float(end)]) for end in (np.iinfo(new).min, np.iinfo(new).max))
            low, high = (to.steps.constant(end) for end in ends)
            number = to.steps.apply("min", to.steps.apply("max", number, low), high)
        return [Traced(value.shape, number)]
    return [value]


def _power(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """A whole power, by multiplication."""
    base, power = _real(to, operands[0], "a power"), equation.params["y"]
    apply, one = to.steps.apply, to.steps.constant(np.ones(1))
    result, square = None, base
    for bit in reversed(f"{abs(power):b}"):
        if bit == "1":
            result = square if result is None else apply("mul", result, square)
        square = apply("mul", square, square)
    result = one if result is None else result
    return [Traced(_shape(equation), apply("div", one, result) if power < 0 else result)]


def _select(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    which, *cases = operands
    if isinstance(which, np.ndarray) and which.ndim:
        numbers = np.arange(len(cases) * which.size, dtype=np.float64)
        places = np.choose(which.astype(int), list(numbers.reshape(len(cases), *which.shape)))
        return [to.taken(cases, places)]
    if isinstance(which, np.ndarray):
        return [cases[int(which)]]
    chosen = to.chosen(which, cases)
    return [Traced(_shape(equation), chosen.real, chosen.imag)]


def _clamp(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    low, value, high = (_real(to, v, "clamp", _shape(equation)) for v in operands)
    number = to.steps.apply("min", to.steps.apply("max", value, low), high)
    return [Traced(_shape(equation), number)]


def _same(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:  # noqa: ARG001
    return operands


# -- moved elements -----------------------------------------------------------------------------


def _moved(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """What only moves elements: their numbers, moved the same way, tell where they come from."""
    name = equation.primitive.name
    fixed = operands[1:] if name in ("gather", "dynamic_slice") else []
    fixed = operands[1:2] if name == "scatter" else fixed
    if any(isinstance(v, Traced) for v in fixed):
        raise UntranslatableError(f"{name} at places that are computed")
    values, numbers, first = list[Value](), list[Any](), 0
    for k, value in enumerate(operands):
        if fixed and 0 < k <= len(fixed):
            numbers.append(value)
            continue
        size = int(np.prod(value.shape))
        numbers.append(np.arange(first, first + size, dtype=np.float64).reshape(value.shape))
        values.append(value)
        first += size
    places = computed(equation, numbers)
    return [to.taken(values, np.asarray(p, dtype=np.float64)) for p in places]


def _sliced(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """A slice whose start is computed; it stays within the array."""
    source, *starts = operands
    if not any(isinstance(s, Traced) for s in starts):
        return _moved(to, equation, operands)
    sizes = equation.params["slice_sizes"]
    offsets = np.indices(sizes).reshape(len(sizes), -1)
    return [_looked_up(to, source, offsets, [to.traced(s).real for s in starts], tuple(sizes))]


def _gathered(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """Slices whose starts are computed, see the documentation of XLA's Gather."""
    source, at = operands
    if not isinstance(at, Traced):
        return _moved(to, equation, operands)
    numbers, params, shape = equation.params["dimension_numbers"], equation.params, _shape(equation)
    sizes, rank = params["slice_sizes"], len(source.shape)
    count = int(np.prod(shape))
    places = np.indices(shape).reshape(len(shape), count)
    batch = [d for d in range(len(shape)) if d not in numbers.offset_dims]
    gone = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    offsets = np.zeros((rank, count), dtype=np.int64)
    kept = [d for d in range(rank) if d not in gone]
    offsets[kept] = places[list(numbers.offset_dims)]
    for d, b in zip(
        numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True
    ):
        offsets[d] = places[batch[b]]
    rows = np.zeros(count, dtype=np.int64)
    if batch:
        rows = np.asarray(np.ravel_multi_index(tuple(places[batch]), at.shape[:-1]))
    found = to.expanded(at.real, at.shape)
    starts: list[int] = [to.steps.constant(np.zeros(1))] * rank
    for j, d in enumerate(numbers.start_index_map):
        starts[d] = to.steps.take(found, rows * at.shape[-1] + j)
    value = _looked_up(to, source, offsets, starts, tuple(sizes), shape)
    if "FILL" not in str(params["mode"]):
        return [value]
    inside, apply = to.steps.constant(np.ones(1)), to.steps.apply
    for d in numbers.start_index_map:
        last = to.steps.constant(np.array([source.shape[d] - sizes[d]]))
        for part in (("ge", starts[d], to.steps.constant(np.zeros(1))), ("le", starts[d], last)):
            inside = apply("and", inside, apply(*part))
    fill = params["fill_value"]
    other = to.steps.constant(np.array([np.nan if fill is None else fill]))
    return [Traced(shape, to.steps.select(inside, value.real, other))]


def _looked_up(
    to: Translator,
    source: Value,
    offsets: np.ndarray,
    starts: list[int],
    sizes: tuple[int, ...],
    shape: tuple[int, ...] | None = None,
) -> Traced:
    """Elements at offsets ``(axis, element)`` from starts, which are kept within the array."""
    strides = np.cumprod([1, *source.shape[:0:-1]])[::-1]
    steps, flat = to.steps, strides @ offsets
    zero = steps.constant(np.zeros(1))
    base, moves = zero, 0
    for start, stride, length, size in zip(starts, strides, source.shape, sizes, strict=True):
        if length == size:
            continue
        moves += 1
        last = steps.constant(np.array([length - size]))
        at = steps.apply("min", steps.apply("max", start, zero), last)
        at = steps.apply("mul", at, steps.constant(np.array([stride])))
        base = at if base == zero else steps.apply("add", base, at)
    wanted = np.arange(flat.size)
    if isinstance(source, np.ndarray) and moves == 1 and steps.sizes[base] == 1:
        wanted = _never_zero(source, flat, strides, sizes)
    shape = sizes if shape is None else shape
    if not wanted.size:
        return Traced(shape, zero)
    base = base if steps.sizes[base] == 1 else steps.take(base, wanted)
    places = steps.apply("add", steps.constant(flat[wanted].astype(np.float64)), base)
    number = steps.lookup(to.full(source), to.expanded(places, wanted.shape))
    if wanted.size < flat.size:
        # Zeros that no start can change are known to be zeros.
        where = np.full(flat.size, wanted.size)
        where[wanted] = np.arange(wanted.size)
        number = steps.take(steps.join([number, zero]), where)
    return Traced(shape, number)


def _never_zero(
    source: np.ndarray, flat: np.ndarray, strides: np.ndarray, sizes: tuple[int, ...]
) -> np.ndarray:
    """Which elements of a slice that moves along one axis are not zero wherever it starts."""
    (axis,) = [d for d, (a, b) in enumerate(zip(source.shape, sizes, strict=True)) if a != b]
    starts = np.arange(source.shape[axis] - sizes[axis] + 1) * strides[axis]
    return np.flatnonzero((source.ravel()[flat[:, None] + starts] != 0).any(axis=1))


RULES: dict[str, Rule] = {
    **{
        name: _applied(name)
        for name in (
            *("abs", "sign", "floor", "ceil", "sqrt", "log", "log1p", "expm1", "sin", "cos", "tan"),
            *("asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf"),
            *("pow", "atan2", "max", "min", "rem", "lt", "le", "gt", "ge", "eq", "ne"),
        )
    },
    **{name: _logical(name) for name in ("not", "and", "or")},
    "xor": _logical("ne"),
    **{name: _each_part(name) for name in ("add", "sub", "neg")},
    **{name: _part(name) for name in ("real", "imag")},
    **AXES,
    **{
        name: _moved
        for name in (
            *("broadcast_in_dim", "slice", "reshape", "squeeze", "expand_dims", "transpose"),
            *("concatenate", "rev", "stack", "pad", "split", "scatter", "tile"),
        )
    },
    **{name: _same for name in ("copy", "copy_p", "stop_gradient", "optimization_barrier")},
    "lt_to": _applied("lt"),
    "le_to": _applied("le"),
    "mul": _mul,
    "add_any": _each_part("add"),
    "exp": _exp,
    "complex": _complex,
    "conj": _conj,
    "div": _div,
    # What is not finite is not zero beside itself.
    "is_finite": _composed(
        lambda apply, constant, x: apply("eq", apply("sub", x, x), constant(0.0))
    ),
    "square": _composed(lambda apply, _constant, x: apply("mul", x, x)),
    "rsqrt": _composed(lambda apply, constant, x: apply("div", constant(1.0), apply("sqrt", x))),
    "exp2": _composed(
        lambda apply, constant, x: apply("exp", apply("mul", x, constant(float(np.log(2.0)))))
    ),
    "logistic": _composed(
        lambda apply, constant, x: apply(
            "div", constant(1.0), apply("add", constant(1.0), apply("exp", apply("neg", x)))
        )
    ),
    "cbrt": _composed(
        lambda apply, constant, x: apply(
            "mul", apply("sign", x), apply("pow", apply("abs", x), constant(1 / 3))
        )
    ),
    "integer_pow": _power,
    "polynomial": _polynomial,
    "convert_element_type": _converted,
    "select_n": _select,
    "clamp": _clamp,
    "round": _round,
    "dynamic_slice": _sliced,
    "gather": _gathered,
}

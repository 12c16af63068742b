"""Rules of primitives that go along axes: sums and products, running ones, places of extremes."""

from __future__ import annotations

from typing import Any

import numpy as np

from dfsm.core.types import Array
from dfsm.exports.translate import Rule, Traced, Translator, Value, real_of, shape_of


def _reduced(name: str) -> Rule:
    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        value = operands[0]
        rank, axes = len(value.shape), tuple(equation.params["axes"])
        numbers = np.arange(np.prod(value.shape), dtype=np.float64).reshape(value.shape)
        order = [d for d in range(rank) if d not in axes] + list(axes)
        columns = int(np.prod([value.shape[d] for d in axes]))
        ordered = to.taken([value], np.transpose(numbers, order))
        real_of(to, ordered, f"reduce_{name}")
        shape = shape_of(equation)
        rows = int(np.prod(shape))
        return [Traced(shape, to.steps.reduce(name, to.full(ordered), (rows, columns)))]

    return rule


def _product(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    """Sums of products over axes, with or without axes that go along."""
    (left_sum, right_sum), (left_along, right_along) = equation.params["dimension_numbers"]
    left, right = operands
    free = [
        [d for d in range(len(v.shape)) if d not in gone]
        for v, gone in ((left, {*left_sum, *left_along}), (right, {*right_sum, *right_along}))
    ]
    inner = int(np.prod([left.shape[d] for d in left_sum]))
    along = int(np.prod([left.shape[d] for d in left_along]))
    rows, columns = (
        int(np.prod([v.shape[d] for d in f])) for v, f in zip(operands, free, strict=True)
    )
    shape = shape_of(equation)

    def ordered(value: Value, order: list[int]) -> Array:
        numbers = np.arange(np.prod(value.shape), dtype=np.float64).reshape(value.shape)
        return np.transpose(numbers, order)

    a = ordered(left, [*left_along, *free[0], *left_sum]).reshape(along, rows, inner)
    b = ordered(right, [*right_along, *right_sum, *free[1]]).reshape(along, inner, columns)
    parts = [
        to.steps.matmul(
            to.full(to.taken([left], a[k])),
            to.full(to.taken([right], b[k])),
            (rows, inner, columns),
        )
        for k in range(along)
    ]
    return [Traced(shape, to.steps.join(parts))]


def _unstacked(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
    axis, (value,) = equation.params["axis"], operands
    return [to.row(value, k, axis) for k in range(value.shape[axis])]


def _running(name: str) -> Rule:
    """Sums, products or extremes of the elements so far."""

    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        axis, value = equation.params["axis"], operands[0]
        order = list(range(value.shape[axis]))
        order = order[::-1] if equation.params["reverse"] else order
        shape = tuple(np.delete(value.shape, axis))
        rows: dict[int, Value] = {}
        total: int | None = None
        for k in order:
            new = real_of(to, to.row(value, k, axis), equation.primitive.name)
            total = new if total is None else to.steps.apply(name, total, new)
            rows[k] = Traced(shape, total)
        if not rows:
            return [value]
        along = to.traced(to.stacked([rows[k] for k in sorted(rows)]))
        numbers = np.arange(np.prod(along.shape), dtype=np.float64).reshape(along.shape)
        return [to.taken([along], np.moveaxis(numbers, 0, axis))]

    return rule


def _place(beyond: str) -> Rule:
    """Where the first of the largest or smallest elements along an axis is."""

    def rule(to: Translator, equation: Any, operands: list[Value]) -> list[Value]:
        (axis,), value, steps = equation.params["axes"], operands[0], to.steps
        place = steps.constant(np.zeros(1))
        best = real_of(to, to.row(value, 0, axis), equation.primitive.name)
        for k in range(1, value.shape[axis]):
            new = real_of(to, to.row(value, k, axis), equation.primitive.name)
            better = steps.apply(beyond, new, best)
            place = steps.select(better, steps.constant(np.array([float(k)])), place)
            best = steps.select(better, new, best)
        return [Traced(shape_of(equation), place)]

    return rule


AXES: dict[str, Rule] = {
    **{f"reduce_{name}": _reduced(name) for name in ("sum", "max", "min", "prod")},
    "reduce_and": _reduced("min"),
    "reduce_or": _reduced("max"),
    **{f"cum{long}": _running(name) for long, name in (("sum", "add"), ("prod", "mul"))},
    **{f"cum{name}": _running(name) for name in ("max", "min")},
    "argmax": _place("gt"),
    "argmin": _place("lt"),
    "unstack": _unstacked,
    "dot_general": _product,
}

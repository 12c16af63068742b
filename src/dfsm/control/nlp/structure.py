"""Which outputs of traced code depend on an argument, value by value.

That is how linear-quadratic problems are recognised, constraints on which no choice has an effect,
and variables in which everything is linear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
Masks = Sequence[BoolArray]

# Calls whose inner code has the same inputs and outputs as the call itself.
_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "custom_jvp_call", "custom_vjp_call")

# Operations whose every output value takes the input values of its own place, or scalars.
# fmt: off
_ELEMENTWISE = frozenset({
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh",
    "cbrt", "ceil", "clamp", "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf",
    "erf_inv", "erfc", "exp", "exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite",
    "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg", "nextafter",
    "not", "or", "polynomial", "pow", "reduce_precision", "rem", "round", "rsqrt", "select_n",
    "sign", "sin", "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor"
})
# fmt: on


def _placed(mask: BoolArray, options: Any) -> BoolArray:
    """A mask under ``broadcast_in_dim``: its axes among the new ones, then repeated."""
    shape = [1] * len(options["shape"])
    for size, axis in zip(mask.shape, options["broadcast_dimensions"], strict=True):
        shape[axis] = size
    return np.broadcast_to(mask.reshape(shape), options["shape"])


def _cut(mask: BoolArray, options: Any) -> BoolArray:
    start, stop = options["start_indices"], options["limit_indices"]
    strides = options["strides"] or (1,) * mask.ndim
    return mask[tuple(map(slice, start, stop, strides))]


# Operations that move values and compute nothing, on one mask.
_MOVES: dict[str, Callable[[BoolArray, Any], BoolArray]] = {
    "broadcast_in_dim": _placed,
    "reshape": lambda mask, o: mask.reshape(o["new_sizes"]),
    "squeeze": lambda mask, o: mask.squeeze(tuple(o["dimensions"])),
    "slice": _cut,
    "transpose": lambda mask, o: mask.transpose(o["permutation"]),
    "rev": lambda mask, o: np.flip(mask, o["dimensions"]),
}
# Operations that put arrays together.
_JOINS: dict[str, Callable[[Masks, Any], BoolArray]] = {
    "concatenate": lambda masks, o: np.concatenate(masks, o["dimension"]),
    "stack": lambda masks, o: np.stack(masks, o["axis"]),
}


def varies(function: Callable[..., Any], first: Any, *rest: Any) -> bool:
    """Whether what a function returns depends on its first argument; see `dependent`."""
    return any(mask.any() for mask in dependent(function, first, *rest))


def dependent(function: Callable[..., Any], first: Any, *rest: Any) -> list[BoolArray]:
    """Which of the values that a function returns depend on its first argument.

    Followed through the traced code operation by operation. Operations on places of their own, and
    those that only move values, are followed value by value; of all others, loops and branches
    included, every output counts as depending on all that enters. A False is therefore a proof, a
    True may be overcautious.

    Parameters
    ----------
    function
        Traceable by JAX.
    first
        Example of the argument in question.
    rest
        Examples of the others.

    Returns
    -------
    list of ndarray
        One per array returned, of its shape.
    """
    closed = jax.make_jaxpr(function)(first, *rest)
    count = len(jax.tree.leaves(first))
    masks = [_all(v, i < count) for i, v in enumerate(closed.jaxpr.invars)]
    return _follow(closed.jaxpr, masks)


def curved(function: Callable[..., Any], first: Any, *rest: Any) -> BoolArray:
    """In which elements of its first argument a function is not affine.

    Those on which its gradient depends; a False is a proof, see `dependent`.

    Parameters
    ----------
    function
        Gives one number; traceable by JAX.
    first
        Example of the vector in question.
    rest
        Examples of the other arguments.

    Returns
    -------
    ndarray
        Shape ``(element,)``.
    """
    closed = jax.make_jaxpr(jax.grad(function))(first, *rest)
    others = [_all(v, False) for v in closed.jaxpr.invars[1:]]
    found = [
        any(mask.any() for mask in _follow(closed.jaxpr, [one, *others]))
        for one in np.eye(len(first), dtype=bool)
    ]
    return np.array(found, dtype=bool)


def _all(variable: Any, value: bool) -> BoolArray:
    return np.broadcast_to(np.asarray(value), variable.aval.shape)


def _follow(jaxpr: Any, masks: Masks) -> list[BoolArray]:
    known = dict(zip(jaxpr.invars, masks, strict=True))

    def mask(v: Any) -> BoolArray:
        # Literals are not hashable and never depend on anything, nor do constants.
        return _all(v, False) if hasattr(v, "val") or v not in known else known[v]

    for equation in jaxpr.eqns:
        enters = [mask(v) for v in equation.invars]
        if any(m.any() for m in enters):
            known |= zip(equation.outvars, _through(equation, enters), strict=True)
    return [mask(v) for v in jaxpr.outvars]


def _through(equation: Any, enters: Masks) -> Masks:
    """Masks of the outputs of one operation."""
    name, options, outputs = equation.primitive.name, equation.params, equation.outvars
    inner = inner_code(equation)
    if inner is not None:
        return _follow(inner, enters)
    if name in _ELEMENTWISE:
        return [np.broadcast_to(_either(enters), outputs[0].aval.shape)]
    if name in _MOVES and len(enters) == 1:
        return [_MOVES[name](enters[0], options)]
    if name in _JOINS:
        return [_JOINS[name](enters, options)]
    if name == "unstack":
        axis = options["axis"]
        return [np.take(enters[0], k, axis) for k in range(enters[0].shape[axis])]
    if name == "split":
        ends = np.cumsum(options["sizes"])[:-1]
        return np.split(enters[0], ends, options["axis"])
    return [_all(v, True) for v in outputs]


def _either(masks: Masks) -> BoolArray:
    total = masks[0]
    for mask in masks[1:]:
        total = total | mask
    return total


def inner_code(equation: Any) -> Any:
    """Code of a call, if its inputs and outputs are those of the equation; else None."""
    if equation.primitive.name not in _CALLS:
        return None
    for key in ("jaxpr", "call_jaxpr"):
        code = equation.params.get(key)
        code = getattr(code, "jaxpr", code)
        if code is not None and len(code.invars) == len(equation.invars):
            return code
    return None

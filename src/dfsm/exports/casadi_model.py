"""A model as functions of CasADi: exact, with first and second derivatives.

With `control.nlp.callbacks` the only file that imports CasADi. What f̂ and ĝ compute is translated
step by step, so that a function of CasADi is the model itself, not another fit of it: coefficients
that follow a schedule stay what they are at its ends beyond them, tables are looked up as they are.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi

from dfsm.core.files import check_file, json_value, write_file
from dfsm.exports.functions import RESULTS, description, programs
from dfsm.exports.program import Program, Step
from dfsm.models.dfsm import DFSM

_UNARY = {
    **{n: getattr(casadi, n) for n in ("sign", "floor", "ceil", "sqrt", "exp", "log", "log1p")},
    **{n: getattr(casadi, n) for n in ("expm1", "sin", "cos", "tan", "asin", "acos", "atan")},
    **{n: getattr(casadi, n) for n in ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf")},
    "neg": lambda a: -a,
    "abs": casadi.fabs,
    "not": casadi.logic_not,
}
_BINARY = {
    **{n: getattr(casadi, n) for n in ("lt", "le", "gt", "ge", "eq", "ne", "atan2")},
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "pow": casadi.power,
    "max": casadi.fmax,
    "min": casadi.fmin,
    "rem": casadi.fmod,
    "and": casadi.logic_and,
    "or": casadi.logic_or,
}

# CasADi writes functions that nobody calls, and arguments that nobody takes.
_LOUD = "#pragma GCC diagnostic pop\n"
_QUIET = """#define CASADI_SYMBOL_EXPORT static
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
"""


@dataclass(frozen=True)
class CasadiModel:
    """The functions of a model.

    Attributes
    ----------
    f, g
        `casadi.Function` of ``states``, ``controls``, ``disturbances`` and ``parameters``, columns
        in the order and units of `description`; they return ``derivatives`` (per second) and
        ``outputs``.
    g_at_azimuth
        As ``g``, with ``azimuth`` in rad and ``field`` in addition, for a model with blade-passing
        harmonics, of which ``g`` is then the average over a revolution; None for others.
    description
        Names, units and start values of all vectors, and which inputs must be computed from
        others before they are supplied; values that JSON can hold.
    distance
        `casadi.Function` of the same four: how far a point is from the training data, up to 1
        inside them. It has kinks, for it is the farthest of all signals.
    """

    f: Any
    g: Any
    g_at_azimuth: Any
    description: dict[str, Any]
    distance: Any

    def save(self, path: str | Path) -> None:
        """Write one file that CasADi reads without dfsm.

        `casadi.FileDeserializer(path).unpack()` returns in turn ``f``, ``g``, the description as
        JSON, ``g_at_azimuth`` if there is one, and ``distance``; `casadi.Function.load(path)`
        returns ``f``.

        Raises
        ------
        DfsmError
            It cannot be written.
        """
        check_file(path)
        with write_file(path) as temporary:
            file = casadi.FileSerializer(str(temporary), {})
            file.pack(self.f)
            file.pack(self.g)
            file.pack(json.dumps(json_value(self.description), ensure_ascii=True))
            if self.g_at_azimuth is not None:
                file.pack(self.g_at_azimuth)
            file.pack(self.distance)
            del file


def to_casadi(model: DFSM) -> CasadiModel:
    """Translate a model into functions of CasADi.

    Parameters
    ----------
    model
        Any model; terms may be functions of one's own.

    Returns
    -------
    CasadiModel
        Its functions equal `DFSM.derivative` and `DFSM.output` inside and outside the training
        data, up to rounding, and have exact first and second derivatives.

    Raises
    ------
    DfsmError
        A term is a function with something in it that CasADi has not; names both.
    """
    functions = {name: to_function(program, name) for name, program in programs(model).items()}
    turned, distance = functions.get("g_at_azimuth"), functions["d"]
    return CasadiModel(functions["f"], functions["g"], turned, description(model), distance)


def c_functions(model: DFSM, name: str) -> tuple[str, dict[str, tuple[int, int, int, int]]]:
    """C code of a model's functions as CasADi writes it.

    Parameters
    ----------
    model
        The model.
    name
        Prefix of all names in the code.

    Returns
    -------
    tuple
        The code, which defines a static function ``<name>_f`` and so on for every program; and how
        many arguments, results, integers and numbers each needs room for.
    """
    options = {"with_header": False, "verbose": False}
    generator, sizes = casadi.CodeGenerator(f"{name}.c", options), {}
    for short, program in programs(model).items():
        function = to_function(program, short, prefix=f"{name}_")
        generator.add(function)
        sizes[short] = (function.sz_arg(), function.sz_res(), function.sz_iw(), function.sz_w())
    return f"{_QUIET}{generator.dump()}\n#if defined(__GNUC__)\n{_LOUD}#endif\n", sizes


def to_function(program: Program, name: str, prefix: str = "") -> Any:
    """A `casadi.Function` of a program."""
    arguments = [casadi.MX.sym(n, size) for n, size in program.inputs]
    # Zeros among constants are left out, so that derivatives know of them.
    constants = [casadi.sparsify(casadi.DM(c)) for c in program.constants]
    values: list[Any] = [*arguments, *constants]
    for step in program.steps:
        values.append(_result(step, [values[k] for k in step.of]))
    names, what = [n for n, _ in program.inputs], [RESULTS[name]]
    result = [casadi.densify(values[program.result])]
    return casadi.Function(prefix + name, arguments, result, names, what)


def _result(step: Step, of: list[Any]) -> Any:
    kind = step.kind
    if kind == "apply":
        return _UNARY[step.name](*of) if len(of) == 1 else _BINARY[step.name](*of)
    if kind == "select":
        return casadi.if_else(*of)
    if kind == "take" and step.places is not None:
        # Of a value of one element CasADi makes a row.
        return casadi.vec(of[0][step.places.tolist()])
    if kind == "lookup":
        return casadi.vec(casadi.MX(casadi.densify(of[0]))[casadi.densify(of[1])])
    if kind == "join":
        return casadi.vertcat(*of)
    if kind == "matmul":
        rows, inner, columns = step.shape
        product = casadi.mtimes(_matrix(of[0], rows, inner), _matrix(of[1], inner, columns))
        return casadi.reshape(product.T, rows * columns, 1)
    return _reduced(step.name, _matrix(of[0], *step.shape))


def _matrix(flat: Any, rows: int, columns: int) -> Any:
    """Row after row, where CasADi has column after column."""
    return casadi.reshape(flat, columns, rows).T


def _reduced(name: str, matrix: Any) -> Any:
    if name == "sum":
        return casadi.sum2(matrix)
    pair = {"max": casadi.fmax, "min": casadi.fmin, "prod": lambda a, b: a * b}[name]
    columns = casadi.horzsplit(matrix)
    result = columns[0]
    for column in columns[1:]:
        result = pair(result, column)
    return result

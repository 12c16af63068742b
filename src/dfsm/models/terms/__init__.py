"""The kinds of known terms φ(u, w, ξ, p) that a linear fit may take, one file each.

A new kind is a file like `product.py`, its name in `FORMS` and its settings in `TermSettings` of
`terms.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import jax
from pydantic import TypeAdapter

from dfsm.data.trajectory import Channel
from dfsm.models.terms.form import Term
from dfsm.models.terms.function import Function, FunctionTerm, ScalarFunction
from dfsm.models.terms.product import Product, ProductTerm
from dfsm.models.terms.quadratic_drag import QuadraticDrag, QuadraticDragTerm
from dfsm.models.terms.rotor import Rotor
from dfsm.models.terms.rotor_term import RotorTerm
from dfsm.models.terms.sensor import SensorTerm
from dfsm.models.terms.terms import Terms, TermSettings, terms_of

__all__ = [
    "FORMS",
    "Function",
    "FunctionTerm",
    "Product",
    "ProductTerm",
    "QuadraticDrag",
    "QuadraticDragTerm",
    "Rotor",
    "RotorTerm",
    "ScalarFunction",
    "SensorTerm",
    "Term",
    "TermSettings",
    "Terms",
    "restored_term",
    "terms_of",
    "told_term",
]

# By the kind that a model folder names.
FORMS: Mapping[str, type[Term]] = {
    form.kind: form
    for form in (RotorTerm, QuadraticDragTerm, ProductTerm, FunctionTerm, SensorTerm)
}


def told_term(term: Term) -> dict[str, Any]:
    """What the manifest of a model folder says of a term: JSON values."""
    channels = [asdict(c) for c in term.channels]
    return {"kind": term.kind, "columns": term.columns, "channels": channels, **term.structure()}


def restored_term(
    told: Mapping[str, Any],
    arrays: Mapping[str, jax.Array],
    functions: Mapping[str, ScalarFunction],
) -> Term:
    """The term of which `told_term` told, with its arrays.

    Parameters
    ----------
    told
        See `told_term`.
    arrays
        By name, see `Term.arrays`.
    functions
        Users' functions by name.

    Raises
    ------
    KeyError
        Something is missing.
    DfsmError
        A function is missing.
    """
    form = FORMS[told["kind"]]
    columns = tuple(int(c) for c in told["columns"])
    channels = TypeAdapter(tuple[Channel, ...]).validate_python(told["channels"])
    if form is FunctionTerm:
        return FunctionTerm.restored(columns, channels, arrays, told, functions)
    return form.restored(columns, channels, arrays, told)

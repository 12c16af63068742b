"""The kinds of known terms φ(u, w, ξ, p) that a linear fit may take, one file each.

A new kind is a file like `product.py`, its name in `FORMS` and its settings in `TermSettings` of
`terms.py`.
"""

from __future__ import annotations

from collections.abc import Mapping

from dfsm.models.terms.form import Term
from dfsm.models.terms.function import Function, FunctionTerm
from dfsm.models.terms.product import Product, ProductTerm
from dfsm.models.terms.quadratic_drag import QuadraticDrag, QuadraticDragTerm
from dfsm.models.terms.rotor import Rotor, RotorTerm
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
    "Term",
    "TermSettings",
    "Terms",
    "terms_of",
]

# By the kind that a model folder names.
FORMS: Mapping[str, type[Term]] = {
    form.kind: form for form in (RotorTerm, QuadraticDragTerm, ProductTerm, FunctionTerm)
}

"""The forms that a corrective function takes when it is evaluated, one file each.

A new form is a file like `gaussian_units.py` and its name in `FORMS`.
"""

from __future__ import annotations

from collections.abc import Mapping

from dfsm.models.corrective.form import Corrective
from dfsm.models.corrective.gaussian_units import GaussianUnits
from dfsm.models.corrective.perceptron import Perceptron
from dfsm.models.corrective.polynomial import Polynomial

__all__ = ["FORMS", "Corrective", "GaussianUnits", "Perceptron", "Polynomial"]

# By the kind that a model folder names.
FORMS: Mapping[str, type[Corrective]] = {
    form.kind: form for form in (GaussianUnits, Perceptron, Polynomial)
}

"""Polynomials of the coefficients that data tell: the others only do harm beyond the data.

A full polynomial of three inputs has some twenty coefficients per row, a spring that hardens needs
one. Those go, one by one, that cost the least by the curvature of the error (backward elimination),
as long as each costs less than Schwarz's criterion allows (1978, "Estimating the dimension of a
model", Annals of Statistics 6(2)); what data left out say of the rest decides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.starts import Candidate, improved
from dfsm.fitting.hidden.windows import Windows

# Squared errors on data left out of a sparse polynomial relative to those of the full one, steps
# that mend what the curvature did not foresee, and shares of the criterion that are tried.
_AS_GOOD, _MENDED, _SHARES = 1.15, 15, (1.0, 0.1)


def sparse(full: Candidate, windows: Windows, decay: float) -> Candidate:
    """The same polynomial with fewer coefficients, where data left out do not speak against it."""
    form = full.form
    if form.kind != "polynomial":
        return full
    before = HiddenError(form, windows).left_out(full.weights)
    for share in _SHARES:
        fewer = _without(full, windows, share)
        if fewer is None:
            return full
        mended = improved(fewer[0], windows, fewer[1], decay, _MENDED)
        if mended.error <= _AS_GOOD * before:
            return replace(mended, error=full.error)
    return full


def _without(full: Candidate, windows: Windows, share: float) -> tuple[Form, Array] | None:
    """Form and weights without what costs little; None where nothing does."""
    form, error = full.form, HiddenError(full.form, windows)
    first = form.states * (form.width + 1)
    samples = windows.used.sum() * form.outputs
    limit = share * float(np.log(samples)) * error.trained(full.weights)
    curvature, _ = error.normal_equations(full.weights)
    curvature += 1e-12 * np.trace(curvature) / len(curvature) * np.eye(len(curvature))
    inverse, weights = np.linalg.inv(curvature), full.weights.copy()
    there = np.zeros(error.size, dtype=bool)
    there[first : form.size] = True
    while there.any():
        cost = np.where(there, weights**2 / np.maximum(np.diag(inverse), 1e-300), np.inf)
        j = int(np.argmin(cost))
        if cost[j] > limit:
            break
        column = inverse[:, j] / inverse[j, j]
        weights = weights - column * weights[j]
        inverse = inverse - np.outer(column, inverse[j])
        there[j], weights[j] = False, 0.0
    if there[first : form.size].all():
        return None
    return _cut(form, weights, there, first)


def _cut(form: Form, weights: Array, there: NDArray[np.bool_], first: int) -> tuple[Form, Array]:
    old = np.arange(form.states * len(form.factors)) if form.kept is None else np.array(form.kept)
    left = there[first : form.size]
    kept = tuple(int(i) for i in old[left])
    keep = there.copy()
    keep[:first], keep[form.size :] = True, True
    return replace(form, kept=kept), weights[keep]

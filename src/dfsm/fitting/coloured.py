"""Effects that what is left over pulls away: a second estimate, with its correlation modelled.

Least squares is right where what it leaves is independent of the inputs. An unknown force that is
correlated in time moves the states, and with them controls that answer these, however much the loop
is excited besides. Its own next value follows from its past, though: with what is left over taken
for an autoregressive series, and the row filtered until nothing of it can be foretold, least
squares comes out right in open and in closed loop, as long as something else excites the control
(generalised least squares; Ljung 1999, System Identification, Sec. 7.6 and 13.4). Where both
estimates differ by far more than the standard error, the first is not to be believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.fitting.residuals import Residuals, stacked

# Share of a row that must be unexplained; how far apart the estimates must be, relative to the
# larger one and in standard errors: see `benchmarks.feedback`.
_UNEXPLAINED, _APART, _SURE = 0.3, 0.25, 3.0
# Share of what is left over that the inputs' curvature may explain, judged on so many samples.
_CURVED, _SAMPLES = 0.5, 4000
# Orders of the series that are tried, rounds, and the change of coefficients that ends them.
_ORDERS, _ROUNDS, _SETTLED = (1, 2, 3, 4, 6, 8, 12), 20, 1e-4


@dataclass(frozen=True)
class Second:
    """An effect, estimated twice.

    Attributes
    ----------
    column
        Of the inputs.
    first, second
        Without and with the correlation of what is left over.
    error
        Standard error of the second.
    """

    column: int
    first: float
    second: float
    error: float


def pulled(residuals: Residuals, columns: Sequence[int]) -> list[Second]:
    """Effects of one row that differ in both estimates.

    Parameters
    ----------
    residuals
        The row.
    columns
        Inputs to look at.
    """
    if not columns or residuals.unexplained < _UNEXPLAINED:
        return []
    centred = residuals.centred()
    if min(len(run) for run in centred.inputs) < 10 * max(_ORDERS):
        return []
    X, y = stacked(centred.inputs), stacked(centred.targets)
    size = np.maximum(X.std(axis=0), np.finfo(float).tiny)
    first = np.linalg.lstsq(X / size, y, rcond=1e-10)[0] / size
    # Not centred run by run: a parameter is constant within each.
    whole = stacked(residuals.inputs)
    whole = (whole - whole.mean(axis=0)) / np.maximum(whole.std(axis=0), np.finfo(float).tiny)
    if _explained_by_curvature(whole, y - X @ first) > _CURVED:
        return []
    second, errors = _whitened(centred, size, first)
    apart = np.abs(second - first)
    larger = np.maximum(np.abs(first), np.abs(second))
    told = (apart > _SURE * errors) & (apart > _APART * larger)
    return [
        Second(k, float(first[k]), float(second[k]), float(errors[k])) for k in columns if told[k]
    ]


def _explained_by_curvature(inputs: Array, left: Array) -> float:
    """Share of what is left over that products and cubes of the inputs explain.

    What bends is a matter for corrective functions: it does follow from the inputs.
    """
    every = max(1, len(left) // _SAMPLES)
    z, left = inputs[::every], left[::every]
    first, second = np.triu_indices(z.shape[1])
    bends = np.hstack([z[:, first] * z[:, second], z**3, z, np.ones((len(z), 1))])
    rest = left - bends @ np.linalg.lstsq(bends, left, rcond=1e-10)[0]
    usual = np.var(left) * len(left) / max(len(left) - bends.shape[1], 1)
    return 1.0 - float(np.var(rest) / max(usual, np.finfo(float).tiny))


def _whitened(centred: Residuals, size: Array, first: Array) -> tuple[Array, Array]:
    """Coefficients with what is left over made white, and their standard errors."""
    found, left, inverse = first, np.zeros(0), np.eye(len(size))
    for _ in range(_ROUNDS):
        series = [y - X @ found for X, y in zip(centred.inputs, centred.targets, strict=True)]
        taps = np.concatenate([[1.0], -_foretold(series)])
        X = stacked([_filtered(run, taps) for run in centred.inputs]) / size
        y = stacked([_filtered(run[:, None], taps)[:, 0] for run in centred.targets])
        inverse = np.linalg.pinv(X.T @ X, rcond=1e-12, hermitian=True)
        scaled = inverse @ (X.T @ y)
        left, new = y - X @ scaled, scaled / size
        change = np.abs(new - found).max() / max(np.abs(new).max(), np.finfo(float).tiny)
        found = new
        if change < _SETTLED:
            break
    errors = np.sqrt(np.maximum(np.diag(inverse), 0.0) * np.mean(left**2)) / size
    return found, errors


def _foretold(series: Sequence[Array]) -> Array:
    """Coefficients of an autoregressive series, of the order that Schwarz's criterion takes."""
    most = max(_ORDERS)
    # The past of lower orders stands first, on the same samples: one factor serves all.
    past_and_now = stacked(
        [
            np.column_stack([e[most - i : len(e) - i] for i in (*range(1, most + 1), 0)])
            for e in series
        ]
    )
    count, R = len(past_and_now), np.asarray(np.linalg.qr(past_and_now, mode="r"))
    best, least = np.zeros(1), np.inf
    for order in _ORDERS:
        taps = np.linalg.lstsq(R[:, :order], R[:, -1], rcond=None)[0]
        squares = float(np.sum((R[:, -1] - R[:, :order] @ taps) ** 2))
        left = max(squares / count, np.finfo(float).tiny)
        score = count * np.log(left) + order * np.log(count)
        if score < least:
            best, least = taps, score
    return best


def _filtered(values: Array, taps: Array) -> Array:
    return np.stack([np.convolve(v, taps, "valid") for v in values.T], axis=1)


def pulled_note(row: str, name: str, twice: Second) -> str:
    """Which effect not to believe, what it may be, and what to do."""
    return (
        f"{row}: what the fit leaves over is correlated in time and with '{name}', as where a "
        "control answers what nobody measures, and pulls its effect: "
        f"{twice.first:.3g}, with this correlation modelled {twice.second:.3g} ± {twice.error:.2g}"
        "; believe neither to the last digit: measure what is missing, give runs in which the "
        "control itself is excited more, or set linear.known"
    )

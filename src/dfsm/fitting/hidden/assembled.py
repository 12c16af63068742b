"""The model that a search found, in physical units: states, what instruments see, the equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Channel
from dfsm.fitting.hidden.error import HiddenError
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.search import Found
from dfsm.models.corrective import Corrective, Perceptron, Polynomial
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.terms import SensorTerm, Terms
from dfsm.models.wider import with_columns


def assembled(model: DFSM, found: Found, startup: float) -> DFSM:
    """The model with hidden states.

    Outputs that an instrument changes become outputs of hidden states, with one known term each.

    Parameters
    ----------
    model
        Fitted on derivatives: its signals and its region.
    found
        See `search`.
    startup
        Length in s of the past that tells hidden states in use.
    """
    s, form = model.signals, found.best.form
    order = _order(form)
    behind = [k for k in order if k < form.outputs and form.sensors and not _is_direct(form, k)]
    kept = [k for k in order[: form.outputs - len(behind)]]
    hidden = tuple(Channel(f"hidden{k + 1}", "-") for k in range(form.states - len(kept)))
    sensed = tuple(s.states[k] for k in behind)
    table = replace(
        s,
        states=(*(s.states[k] for k in kept), *hidden),
        specs=tuple(s.specs[k] for k in kept),
        outputs=(*s.outputs, *sensed),
        telling=tuple(c.name for c in sensed),
        latents=hidden,
        between=found.kinds[: len(s.driving)],
        startup=startup,
        step=found.standard.step / found.steps,
    )
    names = [c.name for c in table.inputs]
    places = np.array([names.index(n) for n in (*table.names("states"), *s.exogenous)])
    paths = HiddenError(form, found.windows).paths(found.best.weights)
    seen = paths[found.windows.used > 0][:, order]
    f, e = _equation(found, order, places)
    terms, g = None, None
    if behind:
        terms = _sensors(form, behind, (places[len(kept) :], sensed), seen[:, len(kept) :])
        wide = np.pad(f.coefficients, ((0, 0), (0, 0), (0, len(behind))))
        f = replace(f, coefficients=from_host(wide))
        g = _seen(found, behind, (len(s.outputs), len(names)))
    region = model.region
    if behind:
        region = region.without([s.state_columns.start + k for k in behind])
    region = with_columns(region, table.observed_columns.stop, seen[:, len(kept) :])
    return replace(
        model,
        f=f,
        e=e,
        g=g,
        region=region,
        corrected=() if e is None else tuple(range(form.states)),
        signals=table,
        terms=terms,
    )


def with_fitted(seen: LinearModel | None, fitted: LinearModel | None) -> LinearModel | None:
    """ĝ of outputs that were fitted, and of those that instruments see after them."""
    if seen is None or fitted is None:
        return seen if fitted is None else fitted
    rows = fitted.coefficients.shape[1]
    pairs = [(fitted.coefficients, seen.coefficients), (fitted.offsets, seen.offsets)]
    L, b = (np.concatenate([first, then[:, rows:]], axis=1) for first, then in pairs)
    return replace(fitted, coefficients=from_host(L), offsets=from_host(b))


def _is_direct(form: Form, output: int) -> bool:
    return not form.sensors or form.sensors[output].sensing == "direct"


def _order(form: Form) -> list[int]:
    """Which of x each state of the model is: what is recorded, what is changed, the rest."""
    outputs = range(form.outputs)
    kept = [k for k in outputs if _is_direct(form, k)]
    return [*kept, *(k for k in outputs if k not in kept), *range(form.outputs, form.states)]


def _sensors(
    form: Form, behind: list[int], to: tuple[IntArray, tuple[Channel, ...]], hidden: Array
) -> Terms:
    """What instruments make of the first hidden states, standardised."""
    columns, channels = to
    parts = tuple(
        SensorTerm((int(column),), (Channel(f"seen({c.name})", "-"),), form.sensors[k])
        for k, column, c in zip(behind, columns, channels, strict=False)
    )
    values = [np.asarray(p.sensor.seen(x)) for p, x in zip(parts, hidden.T, strict=False)]
    mean, std = [v.mean() for v in values], [v.std() for v in values]
    return Terms(parts, from_host(mean), from_host(std))


def _seen(found: Found, behind: list[int], sizes: tuple[int, int]) -> LinearModel:
    """Outputs of terms; rows of others, which come first, are still to be fitted."""
    others, inputs = sizes
    form, (mean, scale) = found.best.form, found.standard.outputs
    levels = found.best.parameters[-form.outputs :]
    rows = np.zeros((others + len(behind), inputs + len(behind)))
    offsets = np.zeros(len(rows))
    for place, k in enumerate(behind):
        rows[others + place, inputs + place] = scale[k]
        offsets[others + place] = mean[k] + scale[k] * levels[k] * form.sensors[k].folds
    return _linear(rows, offsets)


def _equation(
    found: Found, order: list[int], places: IntArray
) -> tuple[LinearModel, Corrective | None]:
    """Linear and corrective part in physical units, states and inputs in the order of a model."""
    form, standard = found.best.form, found.standard
    none = np.zeros(form.states - form.outputs)
    mean_x, scale_x = (
        np.concatenate([a, none + b]) for a, b in zip(standard.outputs, (0, 1), strict=True)
    )
    # What an instrument changes keeps its own scale.
    own = [k for k in range(form.outputs) if not _is_direct(form, k)]
    mean_x[own], scale_x[own] = 0.0, 1.0
    mean = np.concatenate([mean_x, standard.inputs[0]])
    scale = np.concatenate([scale_x, standard.inputs[1]])
    rate = scale_x / standard.step
    at = np.concatenate([places[np.argsort(order)], places[form.states :]])
    L, *others = map(np.asarray, form.parts(found.best.parameters))
    slopes = rate[:, None] * L[:, :-1] / scale
    coefficients = np.zeros_like(slopes)
    coefficients[:, at] = slopes
    offsets = rate * L[:, -1] - slopes @ mean
    f = _linear(coefficients[order], offsets[order])
    shift, spread = np.zeros(len(at)), np.ones(len(at))
    shift[at], spread[at] = mean, scale
    e = _corrective(form, others, (at, rate), (shift, spread))
    return f, None if e is None else e.select(order)


def _linear(coefficients: Array, offsets: Array) -> LinearModel:
    grid = from_host(np.zeros(1))
    return LinearModel(grid, from_host(coefficients[None]), from_host(offsets[None]), None)


def _corrective(
    form: Form,
    parts: list[Array],
    to: tuple[IntArray, Array],
    standard: tuple[Array, Array],
) -> Corrective | None:
    (places, rate), (shift, scale) = to, map(from_host, standard)
    if form.kind == "polynomial":
        columns = [*places.tolist(), len(places)]
        factors = tuple(tuple(columns[c] for c in f) for f in form.factors)
        weights = from_host(rate[:, None] * parts[0])
        return Polynomial(shift, scale, weights, factors, form.reach)
    if form.kind == "tanh":
        directions = np.zeros((form.units, len(places)))
        directions[:, places] = parts[0][:, :-1]
        return Perceptron(
            shift,
            scale,
            weights=(from_host(directions), from_host(rate[:, None] * parts[1])),
            biases=(from_host(parts[0][:, -1]), from_host(np.zeros(form.states))),
        )
    return None

"""Whether a model that was read hangs together: its arrays must fit its signals.

The digests of a folder tell accidents. A manifest that somebody edited and signed again is only
told by what it says: counts, columns and shapes are compared with the signals here, once, so that
nothing later asks for arrays that no fit made.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from dfsm.data.derivatives import state_names
from dfsm.models.corrective import Corrective, GaussianUnits, Perceptron, Polynomial
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.passing import FACTORS, harmonics_of
from dfsm.models.region import Region
from dfsm.models.signals import SignalTable
from dfsm.models.wakes import wake_columns

_Shape = tuple[int, ...]


class _Loose(BaseModel):
    model_config = ConfigDict(extra="allow", protected_namespaces=())


class _Row(_Loose):
    name: str
    unit: str
    decision: str


class _Run(_Loose):
    name: str
    samples: int
    sha256: str


class _Window(_Loose):
    start: float | None = None
    stop: float | None = None


class _Refinement(_Loose):
    message: str


class RecordCheck(_Loose):
    """What is read of a model's history, by summaries, reports and commands."""

    settings: _Window = _Window()
    rows: list[_Row] = Field(default_factory=list)
    data: list[_Run] = Field(default_factory=list)
    channels: list[str] = Field(default_factory=list)
    checks: list[str] = Field(default_factory=list)
    warnings: list[str] = Field(default_factory=list)
    seconds: dict[str, float] = Field(default_factory=dict)
    condition: float | None = None
    refinement: _Refinement | None = None


def check_model(model: DFSM) -> None:
    """Refuse a model whose parts do not fit together.

    Raises
    ------
    ValueError
        Says which part, and what was expected.
    """
    s = model.signals
    _check_signals(s)
    inputs, states, outputs = len(s.inputs), len(s.states), len(s.outputs)
    terms = 0
    if model.terms is not None:
        channels = model.terms.channels
        terms = len(channels)
        for part in model.terms.parts:
            _columns("terms", part.columns, inputs)
        _shapes("terms", {"mean": (terms,), "std": (terms,)}, model.terms)
        made = jax.eval_shape(model.terms, jax.ShapeDtypeStruct((inputs,), jnp.float64))
        _equal("terms", made.shape, (terms,))
    _equal("induced", wake_columns(model), [*range(inputs)[s.induced_columns]])
    harmonics = 2 if s.azimuth is not None and not s.azimuth.rings else 0
    _check_linear("f", model.f, states, inputs + terms, inputs)
    _check_corrective("e", model.e, (inputs, states), model.corrected)
    if (model.g is None) != (outputs == 0):
        raise ValueError(f"g, which does not fit {outputs} outputs")
    if model.g is not None:
        _check_linear("g", model.g, outputs, inputs + terms + harmonics, inputs)
    _check_corrective("e_g", model.e_g, (inputs + harmonics, outputs), model.corrected_outputs)
    _check_region(model.region, inputs)
    if model.passing is not None:
        _columns("passing", [model.passing.column], inputs)
        count = 0 if s.azimuth is None else 2 * len(harmonics_of(s.azimuth))
        expected = {"coefficients": (FACTORS, outputs, count), "speed": (), "schedule": (2,)}
        _shapes("passing", expected, model.passing)
    for array in jax.tree.leaves(model):
        if array.dtype != jnp.float64:
            raise ValueError(f"an array of {array.dtype}, expected 64-bit numbers")


def _check_signals(s: SignalTable) -> None:
    named = [c.name for c in (*s.inputs, *s.outputs)]
    if len({*named}) < len(named):
        raise ValueError("signals, of which two have one name")
    if len(s.latents) > len(s.states) or s.states[len(s.states) - len(s.latents) :] != s.latents:
        raise ValueError("latents, which are not the last states")
    if not set(s.telling) <= set(s.names("outputs")):
        raise ValueError("telling, of which some are no outputs")
    if not 0 <= s.induced <= len(s.latents):
        raise ValueError(f"induced, expected 0 to {len(s.latents)}")
    told_by_outputs = s.telling and not s.specs
    expected = [] if told_by_outputs else [*state_names(s.specs)]
    _equal("states", [c.name for c in s.observed], expected)
    if s.azimuth is not None:
        _ = s.azimuth_rate
        _equal("field", list(s.names("field")), list(s.azimuth.field))


def _check_linear(what: str, linear: LinearModel, rows: int, columns: int, inputs: int) -> None:
    points = linear.grid.shape[0] if linear.grid.ndim == 1 else 0
    expected: dict[str, _Shape] = {
        "grid": (points,),
        "coefficients": (points, rows, columns),
        "offsets": (points, rows),
    }
    _shapes(what, expected, linear)
    _check_schedule(what, linear.schedule, linear.grid, inputs)
    _columns(f"{what}.known", [column for _, column in linear.known], columns)
    _columns(f"{what}.known", [row for row, _ in linear.known], rows)


def _check_schedule(what: str, schedule: int | None, grid: jax.Array, inputs: int) -> None:
    points = np.asarray(grid)
    if schedule is None:
        _equal(f"{what}.grid", points.shape, (1,))
        return
    _columns(f"{what}.schedule", [schedule], inputs)
    if len(points) < 2 or not (np.diff(points) > 0).all():
        raise ValueError(f"{what}.grid, expected two points or more that increase")


def _check_corrective(
    what: str, form: Corrective | None, sizes: tuple[int, int], rows: tuple[int, ...]
) -> None:
    inputs, targets = sizes
    _columns(f"{what} corrects", rows, targets)
    if form is None:
        return
    if len({*rows}) < len(rows):
        raise ValueError(f"{what}, which corrects a row twice")
    expected: dict[str, _Shape] = {"shift": (inputs,), "scale": (inputs,)}
    if isinstance(form, GaussianUnits):
        units = form.centres.shape[-1] if form.centres.ndim else 0
        expected |= {"centres": (inputs, units), "weights": (len(rows), units)}
        expected["bias"] = (len(rows),)
    if isinstance(form, Polynomial):
        expected["weights"] = (len(rows), len(form.factors))
    _shapes(what, expected, form)
    if isinstance(form, Perceptron):
        if not form.weights:
            raise ValueError(f"{what}, which has no layers")
        width = inputs
        for k, (W, b) in enumerate(zip(form.weights, form.biases, strict=True)):
            out = len(rows) if k == len(form.weights) - 1 else W.shape[0] if W.ndim else 0
            _equal(f"{what}.weights.{k}", W.shape, (out, width))
            _equal(f"{what}.biases.{k}", b.shape, (out,))
            width = out


def _check_region(region: Region, inputs: int) -> None:
    points = region.grid.shape[0] if region.grid.ndim == 1 else 0
    # Latent states have no rows of their own.
    rows = region.whitening.shape[1] if region.whitening.ndim == 3 else 0
    whitening = (points, rows, inputs) if region.whitening.size else region.whitening.shape
    expected: dict[str, _Shape] = {
        **dict.fromkeys(("low", "high", "mean", "std"), (inputs,)),
        "grid": (points,),
        "operating": (points, inputs),
        "whitening": whitening,
    }
    _shapes("region", expected, region)
    _check_schedule("region", region.schedule, region.grid, inputs)
    if type(region.fixed) is not int or not 0 <= region.fixed <= min(rows, inputs):
        raise ValueError(f"region.fixed, expected 0 to {min(rows, inputs)}")


def _shapes(what: str, expected: dict[str, _Shape], module: Any) -> None:
    for field, shape in expected.items():
        _equal(f"{what}.{field}", getattr(module, field).shape, shape)


def _equal(what: str, came: Any, expected: Any) -> None:
    if came != expected:
        raise ValueError(f"{what}, which is {came} where its signals ask for {expected}")


def _columns(what: str, columns: Iterable[Any], count: int) -> None:
    for column in columns:
        if type(column) is not int or not 0 <= column < count:
            raise ValueError(f"{what}, which names column {column} of {count}")

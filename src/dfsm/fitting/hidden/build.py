"""From runs to a model with hidden states that is simulated like any other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dfsm.data.dataset import Dataset
from dfsm.data.periods import period
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.hidden.assembled import assembled
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.search import Found, search
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.models.signals import Provenance
from dfsm.numerics.time_mesh import uneven

# Samples of the past from which hidden states are told, and fewest samples per parameter.
_STARTUP, _FEWEST = 50, 20
# A measured state that is another one late, to so small a share of its variance.
_DELAYED, _LAGS = 1e-6, 50
# Of what fewer hidden states leave, what more must come below to be no more than the data can tell.
_NOTHING = 0.98


@dataclass(frozen=True)
class Hidden:
    """A model with hidden states, and what is to be told of it."""

    model: DFSM
    notes: list[str]
    checks: list[str]


def require_hidden(settings: FitSettings, refined: bool) -> None:
    """Refuse settings that hidden states do not go with."""
    for spec in settings.states:
        if spec.order != 1 or spec.rate is not None:
            raise DfsmError(
                f"state '{spec.name}' of order {spec.order} with hidden: hidden states are what a "
                f"rate is, so name it as {{name: {spec.name}, order: 1}} alone, or leave hidden out"
            )
    if not settings.states:
        raise DfsmError("hidden needs a measured state: name in signals.states what is measured")
    if refined:
        raise DfsmError("hidden fits rollouts already: leave refine out, or hidden")
    if settings.linear.kind != "LTI" or settings.terms or settings.azimuth is not None:
        raise DfsmError(
            "hidden goes with linear.kind LTI, without terms and azimuth: leave out these or hidden"
        )


def fit_hidden(model: DFSM, data: Dataset, settings: FitSettings, hidden: HiddenSettings) -> Hidden:
    """Fit hidden states, and corrections of all rows, on rollouts.

    Parameters
    ----------
    model
        Fitted on derivatives: its signals and its region.
    data
        Training runs.
    settings
        Of the fit.
    hidden
        How.

    Raises
    ------
    DfsmError
        Records too short for what is asked for, or a measured state that is another one late.
    """
    s = model.signals
    names = (*s.names("states"), *s.exogenous)
    records = [r.window(settings.start, settings.stop).select(names) for r in data]
    _require_even(records)
    for record in records:
        _require_apart(record, s.names("states"))
    startup = _startup(records, hidden)
    _require_enough(records, len(s.states), len(s.exogenous), hidden)
    chosen = settings.inputs or {}
    free = [
        not isinstance(chosen, str) and n not in chosen and kind != "hold" and n in s.driving
        for n, kind in zip(s.exogenous, s.between_samples(), strict=True)
    ]
    found = search(records, len(s.states), s.between_samples(), free, hidden, settings.seed)
    built = assembled(model, found, startup)
    notes, checks = _told(found, hidden, [n for n, f in zip(s.exogenous, free, strict=True) if f])
    periods = [period(r, s.exogenous) for r in records]
    if all(periods):
        checks[0] += f", under inputs that training saw, too: {_repeated(periods)}"
    checks += _instruments(found, s.names("states"))
    record = {
        "hidden": {
            "count": found.best.form.states - found.best.form.outputs,
            "form": found.best.form.kind,
            "outputs": [sensor.sensing for sensor in found.best.form.sensors],
            "left_out": _root(found.best.error),
            "by_count": {str(k): _root(v) for k, v in found.gains.items()},
            "tried": [{"form": f, "count": c, "left_out": _root(e)} for f, c, e in found.tried],
            "inputs": {k: _root(v) for k, v in found.kinds_tried.items()},
            "step": built.signals.step,
            "startup": startup,
        }
    }
    return Hidden(replace(built, provenance=Provenance(record)), notes, checks)


def _root(error: float) -> float | None:
    return float(np.sqrt(error)) if np.isfinite(error) else None


# -- bad input ----------------------------------------------------------------------------------


def _startup(records: list[Trajectory], hidden: HiddenSettings) -> float:
    """Length in s of the past that tells hidden states in use."""
    step = float(np.median(np.concatenate([np.diff(r.time) for r in records])))
    shortest = min(records, key=lambda r: r.duration)
    if hidden.startup is None:
        return min(_STARTUP * step, shortest.duration / 2)
    if hidden.startup > shortest.duration:
        raise DfsmError(
            f"hidden.startup is {hidden.startup:g} s, but {shortest.where} lasts "
            f"{shortest.duration:g} s: choose a shorter one, or leave the run out"
        )
    return hidden.startup


def _require_even(records: list[Trajectory]) -> None:
    """Refuse uneven times: what is told of a start, and of a step, is meant per sample."""
    step, other = uneven([record.time for record in records])
    if other is not None:
        apart = np.diff(records[other].time)
        ends = dict.fromkeys(f"{end:.6g}" for end in (apart.min(), apart.max()))
        raise DfsmError(
            f"{records[other].where} has samples {' to '.join(ends)} s apart, "
            f"where {step:.6g} s are usual: hidden states are fitted on even samples of one "
            "interval in all runs, so resample it, or leave it out"
        )


def _require_enough(
    records: list[Trajectory], outputs: int, inputs: int, hidden: HiddenSettings
) -> None:
    samples = sum(len(r) for r in records) * outputs
    count = hidden.count or 0
    parameters = (outputs + count) * (outputs + count + inputs + 1)
    if samples < 2 * parameters or samples < _FEWEST:
        raise DfsmError(
            f"the runs hold {samples} measured values, too few for the {parameters} coefficients "
            f"of a linear model with {count} hidden states: use more data, or fewer of them"
        )


def _require_apart(record: Trajectory, names: tuple[str, ...]) -> None:
    """Refuse a measured state that is another one some samples ago."""
    for late in names:
        for early in names:
            if late == early:
                continue
            y, x = record[late], record[early]
            for k in range(min(_LAGS, len(y) // 4)):
                apart = y[k:] - x[: len(x) - k]
                if np.var(apart) <= _DELAYED * min(np.var(x), np.var(y)):
                    seconds = float(record.time[k] - record.time[0])
                    raise DfsmError(
                        f"{record.where}: '{late}' is '{early}' {seconds:g} s later and tells "
                        f"nothing else: leave '{late}' out of signals.states"
                    )


# -- what is told -------------------------------------------------------------------------------


def _told(found: Found, hidden: HiddenSettings, free: list[str]) -> tuple[list[str], list[str]]:
    form = found.best.form
    count = form.states - form.outputs
    off = f"{np.sqrt(found.best.error):.3g} standard deviations"
    plural = "s" * (count != 1)
    kind = {"none": "a linear equation", "tanh": f"{form.units} tanh units in all rows"}.get(
        form.kind, f"a polynomial of degree {_degree(form)} in all rows"
    )
    checks = [
        f"{count} hidden state{plural} and {kind}: rollouts are off by {off} "
        "where data were left out"
    ]
    if len(found.gains) > 1:
        listed = ", ".join(f"{k}: {np.sqrt(v):.3g}" for k, v in found.gains.items())
        checks.append(f"linear models by their number of hidden states are off by {listed}")
    if found.kinds_tried:
        listed = ", ".join(f"{k} {np.sqrt(v):.3g}" for k, v in found.kinds_tried.items())
        kind = found.kinds[0] if len({*found.kinds}) == 1 else "as told"
        checks.append(
            f"{', '.join(free)} between samples: {listed} with the simplest equation; {kind} was "
            "taken (inputs sets another)"
        )
    if found.steps > 1:
        checks.append(
            f"made for {found.steps} steps per sample ({found.standard.step / found.steps:.3g} s): "
            "with half as many, what the integration adds would be learned"
        )
    return _doubts(found, hidden), checks


def _repeated(periods: Sequence[float | None]) -> str:
    ends = sorted(p for p in periods if p is not None)
    told = dict.fromkeys(f"{p:.3g}" for p in (ends[0], ends[-1]))
    return (
        f"they repeat themselves every {' to '.join(told)} s, so only a record under other inputs "
        "tells how good the model is (dfsm validate)"
    )


def _instruments(found: Found, names: Sequence[str]) -> list[str]:
    """What instruments make of states."""
    standard, told = found.standard, []
    for k, sensor in enumerate(found.best.form.sensors):
        mean, scale = standard.outputs[0][k], standard.outputs[1][k]
        if sensor.folds:
            level = mean + scale * found.best.parameters[k - found.best.form.outputs]
            what = "absolute value" if sensor.sensing == "absolute" else "square"
            side = "above" if sensor.up > 0 else "below"
            way = f"the {what} of a hidden state, {side} {level:.3g}"
        elif sensor.sensing == "clipped":
            ends = [f"{mean + scale * e:.4g}" for e in (sensor.low, sensor.high) if np.isfinite(e)]
            way = f"a hidden state, as far as the instrument goes: to {' and '.join(ends)}"
        else:
            continue
        told.append(f"{names[k]} is {way} (hidden.output: direct takes it for a state)")
    return told


def _degree(form: Form) -> int:
    return max((sum(c < form.width for c in f) for f in form.factors), default=1)


def _doubts(found: Found, hidden: HiddenSettings) -> list[str]:
    """More hidden states than the data tell apart."""
    count = found.best.form.states - found.best.form.outputs
    fewer = {c: e for c, e in found.gains.items() if c < count}
    if hidden.count is None or not fewer or found.best.error < _NOTHING * min(fewer.values()):
        return []
    enough = min(c for c, e in fewer.items() if _NOTHING * e <= found.best.error)
    return [
        f"hidden.count is {count}, more than the data can tell: a linear equation with {enough} is "
        f"off by {np.sqrt(fewer[enough]):.3g} standard deviations where data were left out, this "
        f"one by {np.sqrt(found.best.error):.3g}; set hidden.count to {enough}, or to null"
    ]

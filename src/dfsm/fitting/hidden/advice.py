"""Where derivatives are not to be fitted, and what to write into the configuration instead."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from dfsm.data.dataset import Dataset
from dfsm.data.windows import Windows
from dfsm.fitting.causes import driven_by_past
from dfsm.fitting.doubts import Doubts
from dfsm.fitting.linear import LTI
from dfsm.fitting.settings import FitSettings

# RMS that a fit leaves of a derivative, relative to its standard deviation, from which the state
# is not told by what is recorded.
_MUCH = 0.8
# What is to be mended before: the past of a control that is little else than the states is theirs.
_FIRST = ("alike", "late", "rough", "coarse")


def hidden_advice(
    decisions: Sequence[Mapping[str, Any]], data: Dataset, settings: FitSettings, doubt: Doubts
) -> list[str]:
    """A sentence where derivatives leave most of themselves, and hidden states are what may help.

    They may where the past of what drives a state tells its next sample, although its value now
    does not tell the derivative: then something in between remembers. Noise of a sensor is nothing
    of the kind, and covers a derivative alike: it is told from windows of time over which it is
    next to nothing.

    Parameters
    ----------
    decisions
        On every derivative, see `gate.Correction`.
    data
        Training runs.
    settings
        Of the fit.
    doubt
        What is told already: where an input acts late or is too coarse, that is to be mended first.
    """
    if not isinstance(settings.linear, LTI) or settings.terms or settings.azimuth is not None:
        return []
    run = max(data, key=len)
    driving = [n for n in (*settings.controls, *settings.driving) if n in run]
    told = {s.name: _of_state(s.name, decisions) for s in settings.states}
    rates = {s.rate for s in settings.states}
    told = {n: left for n, left in told.items() if left >= _MUCH and n not in rates}
    first = {_base(r.row) for r in doubt.reasons if r.kind in _FIRST}
    told = {n: left for n, left in told.items() if n not in first}
    if not told or not driving:
        return []
    states = [s.name for s in settings.states if s.name not in rates]
    told = {n: left for n, left in told.items() if n not in _noisy(told, data, settings, driving)}
    if not told:
        return []
    driven = set(driven_by_past(run, [*states, *driving]))
    poor = [n for n in told if n in driven]
    if not poor or driven & set(driving):
        return []
    left = f"{told[poor[0]]:.0%}"
    if len(poor) > 1:
        left = f"{min(told[n] for n in poor):.0%} to {max(told[n] for n in poor):.0%}"
    which = ", ".join(f"'{n}'" for n in poor)
    changed = [s.name for s in settings.states if s.order != 1 or s.rate is not None]
    orders = "".join(f", {{name: {n}, order: 1}} among signals.states" for n in changed)
    return [
        f"derivatives are not to be fitted here: what is recorded leaves {left} of that of "
        f"{which}, and the past of the inputs tells more: something in between is not measured; "
        f"set hidden: {{}}{orders} in the configuration (HiddenSettings in Python), which fits "
        "rollouts with hidden states, and corrects these instead of what corrective names"
    ]


def _noisy(
    names: Iterable[str], data: Dataset, settings: FitSettings, driving: Sequence[str]
) -> set[str]:
    """States of whose derivatives noise or dropouts of the record are what is left.

    Windows that are long enough for noise to be next to nothing are explained there.
    """
    order = {s.name: s.order for s in settings.states}
    recorded = [s.rate for s in settings.states if s.rate is not None]
    every = list(dict.fromkeys([*order, *recorded, *driving]))
    windows = Windows([run.window(settings.start, settings.stop) for run in data], every)
    return {n for n in names if windows.left(n, order[n], every)[0] < _MUCH**2}


def _of_state(name: str, decisions: Sequence[Mapping[str, Any]]) -> float:
    """RMS that is left of a state's highest derivative, relative to its standard deviation."""
    rows = [d for d in decisions if _base(d["name"]) == name and d["residual_rms"] > 0]
    if not rows:
        return 0.0
    row = rows[-1]
    explained = max(0.0, row["explained"] or 0.0) if row["corrected"] else 0.0
    ratio = row["residual_rms"] / max(row["std"], np.finfo(float).tiny)
    return float(ratio * np.sqrt(max(0.0, 1 - explained)))


def _base(derivative: str) -> str:
    return derivative.removesuffix("_ddot").removesuffix("_dot")

"""A model in tables: its signals and their ranges, what each is good for."""

from __future__ import annotations

import numpy as np

from dfsm.models.dfsm import DFSM
from dfsm.report.article import Table


def signal_table(model: DFSM) -> Table:
    """Every signal with its unit, its role, and where its training data lie."""
    s, region = model.signals, model.region
    places = {c.name: k for k, c in enumerate(s.inputs)}
    low, high, mean = (np.asarray(v) for v in (region.low, region.high, region.mean))
    rows: list[tuple[str | float | None, ...]] = []
    for group in ("states", "controls", "disturbances", "parameters", "outputs"):
        for c in getattr(s, group):
            k = places.get(c.name)
            known = (None,) * 3 if k is None else (float(low[k]), float(mean[k]), float(high[k]))
            rows.append((c.name, c.unit, group[:-1], *known))
    note = "Outputs follow from the others, so their range limits nothing."
    heads = ("signal", "unit", "role", "lowest", "mean", "highest")
    return Table("signals", "Signals and the range of the training data", heads, tuple(rows),
                 note if s.outputs else "", digits=4)  # fmt: skip


def verdict_table(model: DFSM) -> Table | None:
    """What the fit says that each signal is good for; None where its record says nothing."""
    verdicts = model.provenance.record.get("verdicts", ())
    if not verdicts:
        return None
    rows = tuple((v["name"], v.get("nrmse"), v["text"]) for v in verdicts)
    heads = ("signal", "NRMSE of rollouts", "what it is good for")
    return Table("verdicts", "What each signal is good for, by the fit", heads, rows)

"""A model card: what a model is, what taught it, where it holds, what it is good for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.core.version import __version__
from dfsm.fitting.verdicts import TRENDS, USABLE
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.stability import told_growths
from dfsm.report.article import Article, Figure, Section, Table, listed
from dfsm.report.article_page import write_article
from dfsm.report.dots import dots
from dfsm.report.first_screen import GRADES
from dfsm.report.model_tables import signal_table

# The most words of provenance that a table cell shows.
_DIGEST = 12
_PAPER = (
    "Sundarrajan, A. K., and Herber, D. R. (2023). Using High-fidelity Time-Domain Simulation Data "
    "to Construct Multi-fidelity State Derivative Function Surrogate Models for use in Control and "
    "Optimization. ASME International Mechanical Engineering Congress and Exposition."
)


def write_model_card(model: DFSM, path: str | Path, *, name: str = "model") -> None:
    """Write one self-contained HTML page about a model, from what the model itself holds.

    Parameters
    ----------
    model
        Fitted, or loaded from a folder.
    path
        File to write; an existing one is replaced when the new one is complete.
    name
        Heading, e.g. the folder's name.

    Raises
    ------
    DfsmError
        The file cannot be written.
    """
    require_model(model)
    write_article(card_article(model, name), path)


def card_article(model: DFSM, name: str) -> Article:
    """Put what a model holds of itself into sections, tables and a figure.

    Parameters
    ----------
    model
        Any; what its record does not hold is left out.
    name
        Heading.
    """
    record = model.provenance.record
    sections = [
        *_good_for(record),
        _holds(model),
        _trained(record),
        _inside(model, record),
        _cite(record),
    ]
    return Article("card", f"Model card: {name}", _lede(model, record), tuple(sections))


# -- the verdict ----------------------------------------------------------------------------------


def _lede(model: DFSM, record: Mapping[str, Any]) -> str:
    s = model.signals
    kind = "One linear model" if model.f.schedule is None else (
        f"A linear model whose coefficients follow {model.schedule}"
    )  # fmt: skip
    corrected = len(model.corrected) + len(model.corrected_outputs)
    rows = len(s.states) + len(s.outputs)
    told = f"{kind}, {corrected} of {rows} rows with a nonlinear correction."
    groups = _by_grade(record)
    if groups:
        words = [f"{g}: {', '.join(names)}" for g, names in groups.items()]
        told = f"By rollouts over its own training runs, {'; '.join(words)}. {told}"
    return told


def _by_grade(record: Mapping[str, Any]) -> dict[str, list[str]]:
    verdicts = record.get("verdicts", ())
    groups = {g: [v["name"] for v in verdicts if v["verdict"] == g] for g in GRADES}
    return {g: names for g, names in groups.items() if names}


def _good_for(record: Mapping[str, Any]) -> list[Section]:
    """The verdicts as a figure first, then in words, then what the fit warns of."""
    verdicts = record.get("verdicts", ())
    if not verdicts:
        text = "Its record holds no rollouts: validate it on runs of your own with dfsm validate."
        sections = [Section("verdicts", "What it is good for", (text,))]
    else:
        rows = tuple(
            (v["name"], v["verdict"], v["nrmse"], v["text"].removeprefix(f"{v['verdict']}: "))
            for v in verdicts
        )
        table = Table(
            "verdicts",
            "Rollouts over the training runs; runs that it has not seen may do worse",
            ("signal", "verdict", "NRMSE", "why, and what to try"),
            rows,
            digits=2,
        )
        known = [v for v in verdicts if v["nrmse"] is not None]
        figures = (_errors(known),) if known else ()
        sections = [
            Section("errors", "What it is good for", figures=figures),
            Section("verdicts", "Signal by signal", tables=(table,)),
        ]
    if warnings := tuple(f"The fit warns: {text}." for text in record.get("warnings", ())):
        sections.append(Section("warnings", "What to mind", warnings))
    return sections


def _errors(verdicts: Sequence[Mapping[str, Any]]) -> Figure:
    return dots(
        "errors-plot",
        "Rollouts over the training runs.",
        "error / spread of the record (NRMSE)",
        [v["name"] for v in verdicts],
        {"this model": [v["nrmse"] for v in verdicts]},
        {"usable to the left": (USABLE, 3), "for trends only to the left": (TRENDS, 2)},
    )


# -- where it holds, what taught it ---------------------------------------------------------------


def _holds(model: DFSM) -> Section:
    text = (
        "The model knows what its training data hold: signals inside these ranges, and together as "
        "they occurred together. A simulation tells the share of its time outside."
    )
    if model.schedule:
        grid = np.asarray(model.region.grid)
        text += f" Operating points: {model.schedule} = {', '.join(f'{v:.4g}' for v in grid)}."
    return Section("region", "Where it holds", (text,), (signal_table(model),))


def _trained(record: Mapping[str, Any]) -> Section:
    data = record.get("data", ())
    seconds = sum(d.get("seconds", 0.0) for d in data)
    text = "Its record names no runs."
    if data:
        text = f"{len(data)} run{'s' * (len(data) != 1)}, {seconds:.6g} s in all."
    rows = tuple(
        (d["name"], d.get("samples"), d.get("seconds"), d.get("sha256", "")[:_DIGEST]) for d in data
    )
    heads = ("run", "samples", "seconds", "SHA-256, first 12")
    tables = (Table("data", "Training runs", heads, rows, digits=6),) if rows else ()
    return Section("training", "What taught it", (text,), tables)


# -- inside ---------------------------------------------------------------------------------------


def _inside(model: DFSM, record: Mapping[str, Any]) -> Section:
    rows = tuple(
        (r.get("name", ""), r.get("unit", ""), r.get("residual_rms"), r.get("std"),
         str(r.get("decision", "")))
        for r in record.get("rows", ())
    )  # fmt: skip
    heads = ("row", "unit", "residual RMS", "signal std", "decision")
    tables = [Table("rows", "What the fit decided for each row", heads, rows)] if rows else []
    growths = [
        (
            "all conditions" if model.schedule is None else f"{model.schedule} = {g.schedule:.4g}",
            g.rate,
            g.word or "stable",
        )
        for g in told_growths(model)
    ]
    tables.append(Table("growth", "Fastest mode", ("at", "real part (1/s)", ""), tuple(growths)))
    texts = [f"Check: {text}." for text in record.get("checks", ())]
    if "refinement" in record:
        texts.append(str(record["refinement"]["message"]))
    return Section("inside", "Inside", tuple(texts), tuple(tables))


def _cite(record: Mapping[str, Any]) -> Section:
    versions = record.get("versions", {})
    made = versions.get("dfsm", __version__)
    told = listed([f"{k} {v}" for k, v in versions.items()]) if versions else ""
    texts = [
        f"The dfsm developers. dfsm: derivative function surrogate models from time-domain "
        f"simulations, version {made}. Apache-2.0.",
        f"The method: {_PAPER}",
    ]
    if told:
        texts.append(f"Fitted with {told}.")
    return Section("cite", "How to cite", tuple(texts))

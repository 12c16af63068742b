"""A model in lines of text: signals, what the fit decided, stability, verdicts, warnings."""

from __future__ import annotations

import textwrap

import numpy as np

from dfsm.errors import printable
from dfsm.models.dfsm import DFSM
from dfsm.models.stability import told_growths

# Columns of the narrowest terminal in use.
_COLUMNS = 80


def lines_of(model: DFSM, warnings: bool = True) -> list[str]:
    """Describe a model.

    Parameters
    ----------
    model
        Any; what its record does not hold is left out.
    warnings
        Whether to end with the warnings of its fit; not where they have just been shown.
    """
    s, record = model.signals, model.provenance.record
    lines = [
        f"{group}: {', '.join(c.label for c in getattr(s, group))}"
        for group in ("states", "controls", "disturbances", "parameters", "outputs")
        if getattr(s, group)
    ]
    if s.azimuth is not None and s.azimuth.rings:
        rings = ", ".join(f"{r:g}" for r in s.azimuth.rings)
        lines.append(f"wind field, for outputs: {len(s.field)} harmonics over rings of {rings} m")
    if model.terms is not None:
        lines.append(f"terms: {', '.join(c.label for c in model.terms.channels)}")
    kind = f"LPV in {model.schedule}, {len(model.f.grid)} points" if model.schedule else "LTI"
    lines.append(f"linear fit: {kind}, condition number {record.get('condition', np.nan):.3g}")
    for row in record.get("rows", []):
        lines.append(f"  {row['name']} ({row['unit']}): {row['decision']}")
        if row.get("coefficients"):
            lines.append(f"    = {' '.join(_term(*entry) for entry in row['coefficients'])}")
    lines += _stability(model)
    lines += [f"check: {text}" for text in record.get("checks", [])]
    if "refinement" in record:
        lines.append(record["refinement"]["message"])
    lines += [f"{v['name']}: {v['text']}" for v in record.get("verdicts", [])]
    if warnings:
        lines += [f"warning: {text}" for text in record.get("warnings", [])]
    return lines


def wrapped(model: DFSM, columns: int = _COLUMNS) -> str:
    """Describe a model in lines that fit a terminal, what goes on indented further.

    Parameters
    ----------
    model
        Any.
    columns
        Of the terminal.
    """
    told = []
    for line in map(printable, lines_of(model)):
        margin = " " * (len(line) - len(line.lstrip()))
        told += textwrap.wrap(line, columns, initial_indent="", subsequent_indent=margin + "    ",
                              break_on_hyphens=False) or [""]  # fmt: skip
    return "\n".join(told)


def _stability(model: DFSM) -> list[str]:
    """Eigenvalues of the linear fit, and what the whole model does where it is another one."""
    growths = told_growths(model)
    whole = model.e is None and len(growths) == len(model.f.grid)
    lines = []
    for k, (point, values) in enumerate(model.eigenvalues()):
        where = f" at {model.schedule} = {point:.4g}" if model.schedule else ""
        listed = ", ".join(_complex(v) for v in values if v.imag >= 0)
        mark = f"  {growths[k].word}" if whole and growths[k].word else ""
        lines.append(f"  eigenvalues (1/s){where}: {listed}{mark}")
    if not whole and growths:
        worst = max(growths, key=lambda g: g.rate)
        where = f" at {model.schedule} = {worst.schedule:.4g}" if model.schedule else ""
        mark = f"  {worst.word}" if worst.word else ", stable"
        lines.append(f"  with its correction, fastest growth (1/s){where}: {worst.rate:.3g}{mark}")
    return lines


def _term(name: str, value: float, error: float | None) -> str:
    doubt = "?" if error is None else f"{error:.1g}"
    return f"{value:+.3g} (± {doubt}) {name}"


def _complex(value: complex) -> str:
    return f"{value.real:.3g}" + (f" ± {value.imag:.3g}i" if value.imag else "")

"""Tables of optimal control: known problems, orders, times, co-design and the adaptive loop."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from dfsm.report.article import Table, cell_text


def codesign_table(figures: Mapping[str, Any]) -> list[str]:
    """A line per seed of the plant-and-control optimization."""
    lines = [
        "| seed | runs | best m2, surrogate / truth | cost, surrogate / truth | this m2 costs "
        "more by | arm misses its end by |",
        "|---|---|---|---|---|---|",
    ]
    for seed, study in figures["codesign"].items():
        cells = [
            str(study["runs"]),
            f"{study['mass']:.3f} / {study['true_mass']:.3f} kg",
            f"{study['cost']:.4f} / {study['true_cost']:.4f}",
            f"{100 * study['loss']:.2g} %",
            f"{max(study['miss']['theta1'], study['miss']['theta2']):.2g} rad",
        ]
        lines.append(f"| {seed} | {' | '.join(cells)} |")
    return lines


def adaptive_table(figures: Mapping[str, Any]) -> list[str]:
    """A line per seed of the adaptive loop."""
    lines = [
        "| seed | runs at first | simulations of optima | predicted | realised + price of the miss "
        "| largest miss | truth | differences by round |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for seed, study in figures["adaptive"].items():
        rounds = [None if d is None else 100 * d for d in study["differences"]]
        cells = [
            str(study["runs"]),
            str(study["simulations"]) + ("" if study["status"] == "AGREED" else ", no agreement"),
            f"{study['predicted']:.4f}",
            f"{study['realised']:.4f} {study['price']:+.4f}".replace("-", "\N{MINUS SIGN}"),
            f"{study['miss']:.1g}",
            f"{study['true_cost']:.4f}",
            ", ".join("–" if d is None else _percent(d) for d in rounds),
        ]
        lines.append(f"| {seed} | {' | '.join(cells)} |")
    return lines


def _percent(value: float) -> str:
    return f"{value:.0f} %" if value >= 10 else f"{value:.2g} %"


def known_table(figures: Mapping[str, Any]) -> list[str]:
    """Relative error, iterations and seconds of every method on problems with known answers."""
    methods = {
        "hermite_simpson": "Hermite–Simpson",
        "radau": "Radau 3",
        "multiple_shooting": "multiple shooting",
    }
    rows = [
        (name, f"{results['value']:.10g}", *(_solved(results.get(key)) for key in methods))
        for name, results in figures.items()
    ]
    return Table("known", "", ("problem", "optimum", *methods.values()), _minus(rows)).markdown()


def estimates_table(figures: Mapping[str, Any]) -> list[str]:
    """True error of the objective beside its estimate, by both transcriptions."""
    schemes = {"hermite_simpson": "Hermite–Simpson", "radau": "Radau 3"}
    heads = [f"{label}, {what}" for label in schemes.values() for what in ("true", "estimated")]
    rows = []
    for name, results in figures.items():
        pairs = [(results[k]["relative_error"], results[k]["estimate"]) for k in schemes]
        rows.append((name, *(cell_text(value, 2) for pair in pairs for value in pair)))
    return Table("estimates", "", ("problem", *heads), _minus(rows)).markdown()


def _solved(result: Mapping[str, Any] | None) -> str | None:
    if result is None:
        return None
    if result["ending"] != "SOLVED":
        return result["ending"].lower().replace("_", " ")
    error, seconds = cell_text(result["relative_error"], 2), cell_text(result["seconds"], 2)
    return f"{error}, {result['iterations']}, {seconds} s"


def orders_table(figures: Mapping[str, Any]) -> list[str]:
    """Observed orders; in brackets where the finer error is below the solver's tolerance."""
    meshes = next(iter(figures.values()))["intervals"]
    steps = [f"{coarse} → {fine}" for coarse, fine in pairwise(meshes)]
    rows = []
    for name, result in figures.items():
        pairs = zip(result["orders"], result["errors"][1:], strict=True)
        cells = [
            f"{order:.2f}" if e > result["tolerance"] else f"({order:.2f})" for order, e in pairs
        ]
        label = name.replace("hermite_simpson", "Hermite–Simpson").replace("radau", "Radau")
        rows.append((label, str(result["theory"]), *cells))
    return Table("orders", "", ("problem, scheme", "theory", *steps), _minus(rows)).markdown()


def control_speed_table(figures: Mapping[str, Any]) -> list[str]:
    """Time per iteration over the number of points; the last column is 1 where it is linear."""
    least, first = min((int(n), result["ms_per_iteration"]) for n, result in figures.items())
    rows = []
    for count, result in figures.items():
        points, ms = int(count), result["ms_per_iteration"]
        growth = f"{points / least:.0f} × the points, {ms / first:.2g} × the time"
        label = result["iterations"] if result["ending"] == "SOLVED" else result["ending"].lower()
        rows.append((points, label, ms, 1000 * ms / points, "–" if points == least else growth))
    columns = ("points", "iterations", "ms per iteration", "ms per iteration per 1000 points")
    growth = f"against {least} points"
    return Table("control_speed", "", (*columns, growth), tuple(rows)).markdown()


def expressions_table(figures: Mapping[str, Any]) -> list[str]:
    """The same program by dfsm and in CasADi expressions."""
    names = {
        "dfsm": "dfsm, first call",
        "dfsm, compiled": "dfsm, compiled",
        "dfsm, warm start": "dfsm, compiled, from its solution",
        "casadi": "CasADi expressions",
        "casadi, compiled": "CasADi expressions in C",
    }
    reference, rows = figures["ms_per_iteration"]["dfsm"], []
    for key, name in names.items():
        result = figures[key]
        if result is None:
            continue
        start, solve = (
            result.get(a, result.get(b))
            for a, b in (("seconds_setup", "seconds_compile"), ("seconds_solve", "seconds"))
        )
        ms = 1000 * solve / result["iterations"]
        objective = f"{result['objective']:.4f}"
        rows.append((name, objective, result["iterations"], start, solve, ms, ms / reference))
    columns = (
        "program",
        "objective",
        "iterations",
        "set up, compile (s)",
        "solve (s)",
        "ms per iteration",
        "over dfsm, compiled",
    )
    return Table("expressions", "", columns, _minus(rows), digits=2).markdown()


def _minus(rows: Sequence[tuple[Any, ...]]) -> tuple[tuple[Any, ...], ...]:
    """Texts with a minus sign where they have a hyphen before a digit."""
    return tuple(
        tuple(re.sub(r"-(?=\d)", "\N{MINUS SIGN}", c) if isinstance(c, str) else c for c in row)
        for row in rows
    )

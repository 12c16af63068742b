"""A tuning, told: parameters and measures before and after, each run, the front, time series."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dfsm.data.trajectory import Trajectory
from dfsm.loops.tuning_problem import Limit
from dfsm.loops.tuning_result import TuningResult
from dfsm.report.article import Article, Curve, Figure, Panel, Section, Table, cell_text
from dfsm.report.article_page import write_article
from dfsm.report.dots import dots
from dfsm.simulation.closed_loop import LoopStatus

_BEFORE, _AFTER = "before", "after"
# Points of a drawn series at most, and how many runs are drawn.
_POINTS, _DRAWN = 3000, 3


def tuning_article(result: TuningResult) -> Article:
    """What a page and the terminal show of a tuning."""
    count = len(result.loops)
    cost = (
        f"{count} run{'s' * (count != 1)}, {result.evaluations} evaluations of all of them, "
        f"{result.gradients} with slopes, in {result.seconds:.0f} s."
    )
    sections = [
        Section("changed", "Before and after", figures=_changed(result)),
        Section("measures", "Measure by measure", tables=(measures(result),)),
        Section("parameters", "Parameters", (cost,), (_parameters(result),)),
        Section("runs", "Each run", tables=(_by_run(result),)),
    ]
    if len(result.starts) > 1:
        sections.append(Section("starts", "Starts", tables=(_starts(result),)))
    if result.front:
        sections.append(_front(result))
    if result.changes:
        sections.append(_changes(result))
    sections += _series(result)
    return Article("tuning", "Tuning", _verdict(result), tuple(sections))


def _verdict(result: TuningResult) -> str:
    """What was gained, whether the limits hold, and what the search says of its end."""
    before, after = result.before_objective, result.objective
    if np.isfinite([before, after]).all() and before:
        change = 100 * (after - before) / abs(before)
        signed = f"{change:+.0f}".replace("-", "\N{MINUS SIGN}")
        told = f"The objective goes from {cell_text(before)} to {cell_text(after)} ({signed} %)"
    else:
        told = f"The objective is {cell_text(after)}, and was no number before"
    if result.problem.constraints:
        told += ", a limit is broken" if result.violation > 0 else ", all limits hold"
    return f"{told}. {result.message[:1].upper()}{result.message[1:]}."


def _changed(result: TuningResult) -> tuple[Figure, ...]:
    """Measures after over before, where that is a number above zero."""
    pairs = zip(result.problem.measures, result.before_figures, result.figures, strict=True)
    shown = [(m.label, float(a / b)) for m, b, a in pairs if b and np.isfinite(a / b) and a / b > 0]
    if not shown:
        return ()
    names, ratios = zip(*shown, strict=True)
    return (
        dots(
            "changed",
            "Every measure after over before, all runs with their weights.",
            "after / before",
            names,
            {"tuned": ratios},
            {"as it was": (1.0, 0)},
        ),
    )


def write_tuning_page(result: TuningResult, path: Path) -> None:
    """Write a tuning as a page; see `write_article`."""
    write_article(tuning_article(result), path)


def _parameters(result: TuningResult) -> Table:
    rows = [
        (name, result.before[name], value, *bounds, "yes" if name in result.at_bounds else "")
        for (name, bounds), value in zip(
            result.problem.parameters.items(), result.values.values(), strict=True
        )
    ]
    return Table(
        "parameters",
        "What was tuned",
        ("parameter", _BEFORE, _AFTER, "lowest", "highest", "at a bound"),
        tuple(rows),
        digits=4,
    )


def measures(result: TuningResult) -> Table:
    """Every measure before and after, and the objective that they make."""
    rows = []
    for measure, before, after in zip(
        result.problem.measures, result.before_figures, result.figures, strict=True
    ):
        asked = f"weight {getattr(measure, 'weight', 0):g}"
        if isinstance(measure, Limit):
            asked = f"{'at most' if measure.sign > 0 else 'at least'} {measure.bound:g}"
        change = 100 * (after / before - 1) if before else None
        rows.append((measure.label, asked, float(before), float(after), change))
    rows.append(
        ("objective", "", result.before_objective, result.objective,
         100 * (result.objective / result.before_objective - 1)
         if result.before_objective else None)
    )  # fmt: skip
    return Table(
        "measures",
        "Over all runs with their weights",
        ("measure", "asked", _BEFORE, _AFTER, "change (%)"),
        tuple(rows),
        note="Measures in the units of their channels; travel and rate per s.",
        digits=4,
    )


def _by_run(result: TuningResult) -> Table:
    rows = []
    for old, new in zip(result.before_loops, result.loops, strict=True):
        for measure in dict.fromkeys((m.measure, m.channel, m.exponent, m.reference)
                                     for m in result.problem.measures):  # fmt: skip
            own = next(
                m
                for m in result.problem.measures
                if (m.measure, m.channel, m.exponent, m.reference) == measure
            )
            pair = [
                own.along(r.trajectory.time, r.trajectory[own.channel])[0]
                if r.status is LoopStatus.COMPLETED
                else None
                for r in (old, new)
            ]
            rows.append((new.trajectory.name, own.label, *pair))
    return Table("by_run", "Each run", ("run", "measure", _BEFORE, _AFTER), tuple(rows), digits=4)


def _starts(result: TuningResult) -> Table:
    rows = [
        (
            ", ".join(f"{v:.4g}" for v in start.first),
            ", ".join(f"{v:.4g}" for v in start.last),
            start.objective,
            start.iterations,
            start.status.name.lower(),
        )
        for start in result.starts
    ]
    return Table(
        "starts",
        "Where each start led: " + ", ".join(result.values),
        ("from", "to", "objective", "steps", "ending"),
        tuple(rows),
        digits=4,
    )


def _front(result: TuningResult) -> Section:
    first, second = result.problem.objective
    names = list(result.values)
    rows = [(*p.measures, *(p.values[n] for n in names)) for p in result.front]
    points = np.array([p.measures for p in result.front])
    now = np.array([result.before_figures[:2]])
    curves = (
        Curve("front", points[:, 0], points[:, 1], 1),
        Curve("front", points[:, 0], points[:, 1], 1, "points"),
        Curve("controller as it was", now[:, 0], now[:, 1], 0, "points"),
    )
    return Section(
        "front",
        "Pareto front",
        tables=(
            Table("front", "What each weight gives", (first.label, second.label, *names),
                  tuple(rows), digits=4),
        ),
        figures=(
            Figure("front", "Pareto front",
                   (Panel("front", first.label, second.label, curves),)),
        ),
    )  # fmt: skip


def _changes(result: TuningResult) -> Section:
    rows = [
        (key, " ".join(f"{float(v):.6g}" for v in np.atleast_1d(np.asarray(values))))
        for key, values in result.changes.items()
    ]
    return Section(
        "changes",
        "Lines of the DISCON.IN that change",
        ("All others stay as they are, byte by byte.",),
        (Table("changes", "Changed keys", ("key", "new values"), tuple(rows)),),
    )


def _series(result: TuningResult) -> list[Section]:
    channels = list(dict.fromkeys(m.channel for m in result.problem.measures))
    sections = []
    for old, new in list(zip(result.before_loops, result.loops, strict=True))[:_DRAWN]:
        name = new.trajectory.name
        panels = []
        for channel in channels:
            label = new.trajectory.channel(channel).label
            curves = (
                _curve(_BEFORE, old.trajectory, channel, 0),
                _curve(_AFTER, new.trajectory, channel, 1),
            )
            panels.append(Panel(channel, "time (s)", label, curves))
        figure = Figure(f"series-{name}", f"{name}: before and after", tuple(panels), stacked=True)
        sections.append(Section(f"run-{name}", name, figures=(figure,)))
    return sections


def _curve(label: str, run: Trajectory, channel: str, colour: int) -> Curve:
    every = max(1, len(run) // _POINTS)
    return Curve(label, run.time[::every], run[channel][::every], colour)

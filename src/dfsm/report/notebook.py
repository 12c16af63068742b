"""What a notebook shows of a result: its verdict in a sentence, one table, sizes; no figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch

from dfsm.control.solution import Solution
from dfsm.data.trajectory import Trajectory, labels
from dfsm.loops.adaptive import AdaptiveResult
from dfsm.loops.sweep import Sweep
from dfsm.loops.tuning_result import TuningResult
from dfsm.models.dfsm import DFSM
from dfsm.report.article import Table
from dfsm.report.closed_loop_article import over_runs
from dfsm.report.elements import Markup, element, join, plural
from dfsm.report.first_screen import main_channels
from dfsm.report.model_tables import signal_table, verdict_table
from dfsm.report.solution_page import outcome
from dfsm.report.tuning_article import measures
from dfsm.selection.compare import Ranking
from dfsm.simulation.closed_loop import ClosedLoopRun
from dfsm.simulation.simulate import Simulation
from dfsm.validation.closed_loop import ClosedLoopValidation
from dfsm.validation.results import Validation

# Rows of a table, and sentences beside it; the rest is counted.
_MOST_ROWS, _MOST_NOTES = 15, 4


@dataclass(frozen=True)
class Told:
    """A result in short.

    Attributes
    ----------
    verdict
        What it is, or how it went.
    tables
        What a reader asks for first.
    notes
        What to know before trusting it.
    """

    verdict: str
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()


def html_of(result: object) -> str:
    """Return a result as HTML without scripts, figures and styles of its own."""
    short = told(result)
    notes = [element("li", note) for note in short.notes[:_MOST_NOTES]]
    if len(short.notes) > _MOST_NOTES:
        notes.append(element("li", f"and {len(short.notes) - _MOST_NOTES} more"))
    return element(
        "div",
        element("p", element("b", type(result).__name__), f": {short.verdict}"),
        *[_table(t) for t in short.tables],
        element("ul", *notes) if notes else "",
    )


def _table(content: Table) -> Markup:
    """A table as notebooks style it, cut where it becomes long."""
    texts = content.texts()
    head = element("tr", *[element("th", c) for c in content.columns])
    rows = [element("tr", *[element("td", cell) for cell in row]) for row in texts[:_MOST_ROWS]]
    left = len(texts) - _MOST_ROWS
    more = element("p", f"and {plural(left, 'row')} more") if left > 0 else ""
    made = element("table", element("thead", head), element("tbody", *rows))
    return join(element("p", content.caption), made, more)


@singledispatch
def told(result: object) -> Told:
    """Put a result in short.

    Parameters
    ----------
    result
        Any of those that notebooks show.
    """
    return Told(repr(result))


@told.register
def _trajectory(result: Trajectory) -> Told:
    step = result.time_step
    every = "irregular" if step is None else f"every {step:g} s"
    verdict = (
        f"{result.name}, {plural(len(result), 'sample')}, {result.time[0]:g} to "
        f"{result.time[-1]:g} s, {every}; {plural(len(result.channels), 'channel')}"
    )
    return Told(verdict, (_ranges(result),), result.notes)


@told.register
def _rollout(result: Simulation | ClosedLoopRun) -> Told:
    run = result.trajectory
    outcome = result.status.name.lower().replace("_", " ")
    verdict = (
        f"{run.name}: {outcome}, {run.time[0]:g} to {result.ended:g} s in "
        f"{result.wall_time:.2g} s; {result.message}"
    )
    return Told(verdict, (_ranges(run),))


def _ranges(run: Trajectory) -> Table:
    rows = tuple(
        (c.name, c.unit, c.role or "", float(v.min()), float(v.mean()), float(v.max()))
        for c, v in zip(run.channels, run.values.T, strict=True)
    )
    heads = ("channel", "unit", "role", "min", "mean", "max")
    return Table("ranges", "", heads, rows, digits=5)


@told.register
def _validation(result: Validation) -> Told:
    count = len(result.runs)
    done = ", ".join(f"{m} {result.completed(m)} of {count}" for m in result.models)
    rows = tuple(
        (c.name, c.unit, *(result.mean_nrmse(m, c.name) for m in result.models))
        for c in (main_channels(result) if result.models else result.channels)
    )
    heads = ("channel", "unit", *result.models)
    table = Table("accuracy", "mean NRMSE over the runs; 0 is perfect", heads, rows, digits=2)
    notes = (*result.warnings, *result.endings(), *result.outside(), *result.still())
    verdict = f"{plural(count, 'test run')}; rollouts completed: {done}"
    return Told(verdict, (table,), tuple(dict.fromkeys(notes)))


@told.register
def _loops(result: ClosedLoopValidation) -> Told:
    verdict = f"{result.completed} of {plural(len(result.runs), 'closed loop')} completed"
    return Told(verdict, (over_runs(result),), tuple(result.endings()))


@told.register
def _solution(result: Solution) -> Told:
    return Told(f"{result.name}: {result.message}", (outcome(result),))


@told.register
def _ranking(result: Ranking) -> Told:
    best = result.best
    verdict = "no candidate could be fitted" if best is None else f"best is {best.name}"
    rows = tuple(
        (e.name, e.status, e.score, *(e.outcome.nrmse.get(s) for s in result.states),
         e.outcome.diverged, e.outcome.fit_seconds)
        for e in result.candidates
    )  # fmt: skip
    heads = ("candidate", "status", "score", *result.states, "ended early", "fit (s)")
    caption = f"NRMSE over {plural(len(result.validation), 'run')} held out, best first"
    return Told(verdict, (Table("ranking", caption, heads, rows),), tuple(result.failures()))


@told.register
def _sweep(result: Sweep) -> Told:
    frame = result.table()
    rows = tuple((str(n), *map(float, line)) for n, line in zip(frame.index, frame.values))  # noqa: B905
    table = Table("sweep", "over all runs with their weights", ("controller", *frame), rows)
    notes = [text for c in result.controllers for text in c.endings]
    verdict = f"{plural(len(result.controllers), 'controller')} over {len(result.runs)} runs"
    return Told(verdict, (table,), tuple(notes))


@told.register
def _tuning(result: TuningResult) -> Told:
    return Told(result.message, (measures(result),))


@told.register
def _adaptive(result: AdaptiveResult) -> Told:
    rows = tuple(
        (k, r.solution.objective, r.realised.cost, r.realised.price, 100 * r.difference)
        for k, r in enumerate(result.rounds, start=1)
    )
    heads = ("round", "predicted", "realised", "price of misses", "apart (%)")
    return Told(result.message, (Table("rounds", "", heads, rows, digits=5),))


@told.register
def _model(result: DFSM) -> Told:
    s = result.signals
    kind = "LTI" if result.f.schedule is None else f"LPV in {result.schedule}"
    corrected = f"{len(result.corrected)} of {len(s.states)} derivatives corrected"
    record = result.provenance.record
    verdict = f"{kind}, {corrected}; states {labels(s.states)}"
    tables: Sequence[Table | None] = (signal_table(result), verdict_table(result))
    return Told(verdict, tuple(t for t in tables if t), tuple(record.get("warnings", ())))

"""Tables for the terminal. Names come from files: they are printed as text, never as markup."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from dfsm.errors import printable

if TYPE_CHECKING:
    from dfsm.control.check import RunCheck
    from dfsm.data.info import RunInfo
    from dfsm.report.article import Article
    from dfsm.selection.compare import Ranking
    from dfsm.validation.intervals import Intervals
    from dfsm.validation.results import Validation

# Longer texts in tables are broken into lines.
_LONG = 45


def print_info(runs: Sequence[RunInfo]) -> None:
    """Print what `dfsm info` says of each run, one table per run."""
    console = _console()
    for run in runs:
        sampling = (
            f"every {run.interval:g} s"
            if run.interval is not None
            else f"irregular, {run.min_interval:g} to {run.max_interval:g} s"
        )
        span = f"{run.samples} samples, {run.start:g} to {run.stop:g} s, {sampling}"
        console.print(_text(f"{run.source or run.name}: {span}"))
        table = _table("channel", "unit", "min", "max", "mean", "std", "step")
        for c in run.channels:
            step = "–" if c.step is None else f"{c.step:.3g}"
            figures = [f"{v:.5g}" for v in (c.min, c.max, c.mean, c.std)]
            table.add_row(_text(c.name), _text(c.unit), *figures, step)
        console.print(table)
        for text in run.warnings:
            console.print(_text(f"warning: {text}"))


def print_merged(runs: Sequence[RunInfo]) -> None:
    """Print what `dfsm info` says of several runs: one table over all, every warning once."""
    from dfsm.data.info import counted, merged

    console = _console()
    console.print(_text(f"{len(runs)} runs, {_sampling(runs)}"))
    table = _table("channel", "unit", "min", "max", "runs", "step")
    for c in merged(runs):
        steps = "–" if c.steps is None else " to ".join(f"{s:.3g}" for s in dict.fromkeys(c.steps))
        of = "all" if c.runs == len(runs) else str(c.runs)
        table.add_row(
            _text(c.name), _text(" or ".join(c.units)), f"{c.min:.5g}", f"{c.max:.5g}", of, steps
        )
    console.print(table)
    for text in counted([(run.source or run.name, run.warnings) for run in runs]):
        console.print(_text(f"warning: {text}"))
    console.print("dfsm info --each prints every run by itself")


def _sampling(runs: Sequence[RunInfo]) -> str:
    """Spans and intervals of several runs, in one line."""
    intervals = sorted({r.interval for r in runs if r.interval is not None})
    samples = sorted({r.samples for r in runs})
    parts = [
        f"{_range(samples, 'd')} samples",
        f"{min(r.start for r in runs):g} to {max(r.stop for r in runs):g} s",
    ]
    parts += [f"every {_range(intervals, 'g')} s"] if intervals else []
    irregular = sum(r.interval is None for r in runs)
    parts += [f"{irregular} of them irregular"] if irregular else []
    return ", ".join(parts)


def _range(values: Sequence[float], form: str) -> str:
    low, high = format(values[0], form), format(values[-1], form)
    return low if low == high else f"{low} to {high}"


def print_validation(validation: Validation) -> None:
    """Print the mean NRMSE of every channel and variant, and what each variant cost."""
    print_validations({"": validation})


def print_validations(validations: Mapping[str, Validation]) -> None:
    """Print one table over several fitted models: errors, times, speed-ups.

    Parameters
    ----------
    validations
        Validation per fitted model.
    """
    console = _console()
    variants = list(
        dict.fromkeys(v for validation in validations.values() for v in validation.models)
    )
    several = len(validations) > 1
    inside = any(v.intervals is not None for v in validations.values())
    heads = ["model"] * several + ["channel", "unit", *variants, "RMSE*", "max*"]
    table = _table(*heads, *["inside*", "promised"] * inside)
    for label, validation in validations.items():
        for i, c in enumerate(validation.channels):
            row: list[str | Text] = [_text(label if i == 0 else "")] if several else []
            row += [_text(c.name), _text(c.unit)]
            for v in variants:
                known = v in validation.models
                row.append(_figure(validation.mean_nrmse(v, c.name), ".3f") if known else "")
            row += [
                _figure(validation.mean_error("multi-fidelity", c.name, what), ".4g")
                for what in ("rmse", "maximum")
            ]
            if inside:
                row += _inside(validation, c.name)
            table.add_row(*row, end_section=i == len(validation.channels) - 1)
    for label, validation in validations.items():
        prefix = f"{label}: " if several else ""
        for text in validation.warnings:
            console.print(_text(f"{prefix}{text}"))
    console.print(
        "NRMSE: RMS error / standard deviation of the recorded signal, mean over test runs"
    )
    console.print(table)
    console.print(
        "* of the multi-fidelity model, in the channel's unit; – no mean, a rollout ended early or "
        "the channel moves in no run"
    )
    if inside:
        console.print("inside: share of the time that the record lies in the prediction intervals")
    times = _table(
        *(["model"] if several else []), "variant", "rollouts done", "wall time", "speed-up"
    )
    for label, validation in validations.items():
        for i, variant in enumerate(validation.models):
            speed = validation.speed_up(variant)
            row = [_text(label if i == 0 else "")] if several else []
            row += [
                variant,
                f"{validation.completed(variant)} of {len(validation.runs)}",
                f"{1000 * validation.wall_time(variant):.0f} ms",
                "no wall time known" if speed is None else f"{speed:,.0f} ×",
            ]
            times.add_row(*row)
    console.print(times)
    for label, validation in validations.items():
        prefix = f"{label}: " if several else ""
        for text in (*validation.endings(), *validation.outside()):
            console.print(_text(f"{prefix}{text}"))


def print_intervals(intervals: Intervals) -> None:
    """Print the half-widths of prediction intervals, from the smallest to the largest."""
    console = _console()
    for text in intervals.warnings:
        console.print(_text(text))
    along = "" if intervals.schedule is None else f" along {intervals.schedule}"
    promised = f"a new run is expected inside {100 * intervals.level:g} % of the time"
    console.print(_text(f"half-widths of prediction intervals{along}; {promised}"))
    table = _table("channel", "smallest", "largest", "unit")
    for name, unit, half in zip(
        intervals.channels, intervals.units, intervals.half_width.T, strict=True
    ):
        table.add_row(_text(name), f"{half.min():.4g}", f"{half.max():.4g}", _text(unit))
    console.print(table)


def print_ranking(ranking: Ranking) -> None:
    """Print candidates best first, what each changes, and how to use the best."""
    console = _console()
    table = _table("candidate", "score", *map(printable, ranking.states), "rollouts done")
    for column in ("parameters", "fit", "simulate"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("changes", justify="left", overflow="fold")
    of = len(ranking.validation)
    for c in ranking.candidates:
        o = c.outcome
        figures = [
            _figure(c.score, ".3f"),
            *(_figure(o.nrmse.get(n), ".3f") for n in ranking.states),
        ]
        costs = [f"{of - o.diverged} of {of}", str(o.parameters)]
        costs += [f"{o.fit_seconds:.1f} s", f"{1000 * o.simulate_seconds:.0f} ms"]
        costs = ["–"] * len(costs) if c.status == "failed" else costs
        changes = f"{c.changes} (refinement discarded)" if o.discarded else c.changes
        table.add_row(_text(c.name), *figures, *costs, _text(changes))
    console.print(table)
    states = ", ".join(ranking.states)
    console.print(_text(f"score: root mean square over {states} of the NRMSE of rollouts"))
    for text in (*ranking.failures(), *ranking.discarded()):
        console.print(_text(text))
    kept = [c.name for c in ranking.candidates if c.kept]
    if kept:
        console.print(_text(f"not fitted again, nothing has changed: {', '.join(kept)}"))
    console.print(_text(f"trained on: {', '.join(ranking.training)}"))
    console.print(_text(f"chosen on: {', '.join(ranking.validation)} (test the choice on others)"))
    if ranking.best is not None:
        use = f"its model is {ranking.best.folder}: dfsm validate it on other runs"
        console.print(_text(f"best: {ranking.best.name}, {use}"))


def print_check(check: RunCheck) -> None:
    """Print how a high-fidelity run under optimal controls differs from the prediction."""
    console = _console()
    part = "the whole horizon" if check.complete else "a part of the horizon"
    span = f"{check.start:g} to {check.stop:g} s, {part}"
    console.print(_text(f"{check.run} against {check.name}, {span}; figures: predicted → actual"))
    for sentence in check.commands:
        console.print(_text(sentence))
    if check.commands:
        console.print("so the run is no test of the model before its controls are those commanded")
    if check.power is not None:
        ahead, came = (_figure(check.power[k], ".5g") for k in ("predicted", "actual"))
        console.print(_text(f"mean power ({check.power_source}): {ahead} → {came} kW"))
    if check.power_advice:
        console.print(_text(check.power_advice))
    table = _table("channel", "unit", "mean", "max", "DEL m=4", "DEL m=10", "RMSE", "NRMSE")
    for name, c in check.channels.items():
        a, b = c.predicted, c.actual
        pairs = [(a.mean, b.mean), (a.maximum, b.maximum)]
        pairs += [(a.damage.get(m), b.damage.get(m)) for m in ("4", "10")]
        cells = [
            f"{_figure(x, '.4g')} → {_figure(y, '.4g')}" if x is not None else "" for x, y in pairs
        ]
        table.add_row(_text(name), _text(c.unit), *cells, f"{c.rmse:.3g}", f"{c.nrmse:.3f}")
    console.print(table)
    if check.limits:
        table = _table("channel", "beyond its limits by", "at", "share of samples")
        for name, limit in check.limits.items():
            at = "" if limit.at is None else f"{limit.at:g} s"
            beyond = f"{limit.predicted:.3g} → {limit.actual:.3g}"
            table.add_row(_text(name), beyond, at, f"{limit.share:.1%}")
        console.print(table)
    else:
        console.print("no bounds of these channels are saved with the solution")
    if check.missing:
        console.print(_text(f"not in the run: {', '.join(check.missing)}"))


def print_article(article: Article) -> None:
    """Print the tables of a study; texts and figures are in its page."""
    console = _console()
    for section in (s for s in article.sections if s.tables):
        console.print(Text(section.heading, style="bold underline"))
        for part in section.tables:
            console.print(Text(f"\n{part.caption}", style="italic"))
            table = _table(*part.columns)
            for column, made in enumerate(table.columns):
                made.justify = "left" if part.is_text(column) else "right"
                # Sentences may break, numbers and names may not.
                made.no_wrap = max(len(row[column]) for row in part.texts()) < _LONG
            for row in part.texts():
                table.add_row(*map(_text, row))
            console.print(table)
            if part.note:
                console.print(_text(part.note), style="dim")
        console.print()


def _text(text: str) -> Text:
    return Text(printable(text))


def _inside(validation: Validation, channel: str) -> list[str]:
    """Share of the time inside the prediction intervals, mean over runs, and the level."""
    if validation.intervals is None:
        return ["", ""]
    shares = validation.coverage(channel)
    mean = "–" if shares is None else f"{100 * sum(shares) / len(shares):.1f} %"
    return [mean, f"{100 * validation.intervals.level:g} %"]


def _figure(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        text = column in ("model", "channel", "unit", "variant", "candidate")
        table.add_column(column, justify="left" if text else "right", no_wrap=True)
    return table


def _console() -> Console:
    # Piped output keeps full rows: a table must not be cut to a terminal that is not there.
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=160)

"""Summary, accuracy and model sections of the page; the run by run tables are in runs.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dfsm.models.stability import Growth
from dfsm.report.elements import MISSING, Cell, Markup, element, join, number, plural, table
from dfsm.report.first_screen import endings, grades, judged, main_channels
from dfsm.validation.results import Validation

# -- summary --------------------------------------------------------------------------------------


def completions(name: str, validation: Validation) -> Markup:
    """How many rollouts came to their end, and whether anything was corrected at all."""
    v, count = validation, len(validation.runs)
    durations = [r.recorded.duration for r in v.runs]
    completed = [(m, v.completed(m)) for m in v.models]
    span = f"{np.mean(durations):.0f} s" if np.ptp(durations) < 1 else "different lengths"
    tested = f"{plural(count, 'test run')} of {span}"
    if all(n == count for _, n in completed):
        all_of_them = f"the test run of {span}" if count == 1 else f"all {tested}"
        text = f"{name}: every variant completed {all_of_them}."
    else:
        each = ", ".join(f"{m} {n} of {count}" for m, n in completed)
        text = f"{name}: completed, of {tested}: {each}."
    rows = v.record.get("rows", ())
    if rows and not any(r.get("corrected") for r in rows):
        text += " No row was corrected, so the multi-fidelity model is its linear fit."
    return element("p", text)


def verdicts(name: str, validation: Validation) -> Markup:
    """What each signal is good for by these runs, and by its fit, which knows what to try."""
    found = grades(validation)
    model = judged(validation)
    advised = {entry["name"]: entry["text"] for entry in validation.record.get("verdicts", ())}
    rows = [
        [n, verdict, validation.mean_nrmse(model, n), Cell(advised.get(n, MISSING), "long")]
        for n, verdict in found.items()
    ]
    return table(
        f"{name}: what each signal is good for, by {model} over these runs and by its fit",
        [],
        ["Signal", "By these runs", "NRMSE", "By the fit"],
        rows,
    )


def glance(validations: Mapping[str, Validation]) -> Markup:
    """All fitted models in one table: completed runs, NRMSE of the main signals, times."""
    common = [c.name for c in main_channels(next(iter(validations.values())))]
    common = [n for n in common if all(n in _names(v) for v in validations.values())]
    rows = []
    for name, v in validations.items():
        for model in v.models:
            done, count = v.completed(model), len(v.runs)
            runs = f"{done} of {count}"
            rows.append(
                [
                    name,
                    model,
                    Cell(runs, "bad" if done < count else "good"),
                    *[v.mean_nrmse(model, c) for c in common],
                    v.wall_time(model),
                    v.speed_up(model),
                ]
            )
    grid = table(
        "Mean NRMSE of the main signals over the test runs, and cost",
        [("", 3), ("mean NRMSE", len(common)), ("per rollout", 2)],
        ["Fitted model", "Variant", "Runs completed", *common, "wall time (s)", "speed-up"],
        rows,
    )
    return join(grid, element("p", _glance_note(validations), cls="note"))


def _names(validation: Validation) -> list[str]:
    return [c.name for c in main_channels(validation)]


def _glance_note(validations: Mapping[str, Validation]) -> str:
    text = (
        "NRMSE: root-mean-square error divided by the standard deviation of the recorded signal; "
        "0 is perfect, 1 is no better than the recorded mean. Speed-up: the simulator's recorded "
        "wall time, scaled to the same span, over the model's."
    )
    if any(v.completed(m) < len(v.runs) for v in validations.values() for m in v.models):
        text += (
            " A variant that did not complete all its runs has no mean error (—); its wall time "
            "includes the rollouts that ended early."
        )
    return text


# -- accuracy -----------------------------------------------------------------------------------


def accuracy(name: str, validation: Validation) -> Markup:
    """Mean NRMSE, mean RMSE and largest error per channel and variant."""
    v = validation
    complete = [m for m in v.models if v.completed(m) == len(v.runs)]
    letters = {m: chr(ord("a") + i) for i, m in enumerate(m for m in v.models if m not in complete)}
    rows = []
    for c in v.channels:
        row: list[object] = [c.name, c.unit or MISSING, c.role or MISSING]
        scores = {m: v.mean_nrmse(m, c.name) for m in complete}
        best = min((s for s in scores.values() if s is not None), default=None)
        for model in v.models:
            if model in letters:
                mark = join(MISSING, element("sup", letters[model]))
                row += [mark, mark, mark]
                continue
            errors = [r.models[model].errors[c.name] for r in v.runs]
            score = scores[model]
            row += [
                Cell(score, "best") if score == best and len(complete) > 1 else score,
                float(np.mean([e.rmse for e in errors])),
                max(e.maximum for e in errors),
            ]
        rows.append(row)
    grid = table(
        f"{name}: mean NRMSE, mean RMSE and largest error of {plural(len(v.runs), 'test run')}, "
        "in the channel's unit",
        [("", 3), *[(m, 3) for m in v.models]],
        ["Channel", "Unit", "Role", *["NRMSE", "RMSE", "max"] * len(v.models)],
        rows,
    )
    reasons = [_reason(v, m, letter) for m, letter in letters.items()]
    return join(grid, *reasons, _coverage(name, v))


def _reason(v: Validation, model: str, letter: str) -> Markup:
    text = f" {model} completed {v.completed(model)} of {plural(len(v.runs), 'run')}: "
    return element(
        "p", element("sup", letter), text + "; ".join(endings(v, model)) + ".", cls="note"
    )


def _coverage(name: str, v: Validation) -> Markup:
    """How often the record lies inside the prediction intervals, beside the level promised."""
    if v.intervals is None:
        return Markup("")
    rows = []
    for c, half in zip(v.channels, v.intervals.half_width.T, strict=True):
        shares = v.coverage(c.name)
        figures = [None] * 3 if shares is None else [np.mean(shares), min(shares), max(shares)]
        row = [c.name, c.unit or MISSING, float(half.min()), float(half.max())]
        promised = Markup(f"{100 * v.intervals.level:g} %")
        rows.append([*row, promised, *map(_share, figures)])
    return table(
        f"{name}: share of the time that the record lies inside the prediction intervals of "
        f"the multi-fidelity model, over {plural(len(v.runs), 'test run')}",
        [("", 2), ("half-width", 2), ("inside", 4)],
        ["Channel", "Unit", "smallest", "largest", "promised", "mean", "lowest run", "highest run"],
        rows,
    )


def _share(value: float | None) -> Markup:
    return Markup(MISSING if value is None else f"{100 * value:.1f} %")


def shading(_name: str, validation: Validation) -> Markup:
    """What the band in the time series stands for; the page's script colours the patch."""
    intervals = validation.intervals
    if intervals is None:
        return Markup("")
    text = (
        "Around the multi-fidelity rollout: where the record of a new run is expected "
        f"{100 * intervals.level:g} % of the time, "
        f"calibrated on {plural(len(intervals.runs), 'run')}."
    )
    return element("p", element("span", cls="patch interval"), text, cls="note")


# -- derivatives, decisions, eigenvalues, times -------------------------------------------------


def derivatives(name: str, validation: Validation) -> Markup:
    """NRMSE of f̂ along the recorded test runs, per state and variant."""
    v = validation
    states = list(v.runs[0].models[next(iter(v.models))].derivative_errors)
    rows = []
    for state in states:
        row: list[object] = [f"d/dt {state}"]
        for m in v.models:
            values = [r.models[m].derivative_errors[state] for r in v.runs]
            row += [float(np.mean(values)), max(values)]
        rows.append(row)
    return table(
        f"{name}: NRMSE of the derivative along recorded test runs (no rollout)",
        [("", 1), *[(m, 2) for m in v.models]],
        ["Derivative", *["mean", "worst run"] * len(v.models)],
        rows,
    )


def decisions(name: str, validation: Validation) -> Markup:
    """What the fit decided for each row of f̂ and ĝ."""
    rows = [
        [
            r.get("name", ""),
            r.get("unit", ""),
            r.get("residual_rms"),
            r.get("std"),
            Cell(str(r.get("decision", "")), "long"),
        ]
        for r in validation.record.get("rows", ())
    ]
    if not rows:
        return element("p", f"{name}: the model carries no record of its fit.", cls="note")
    return table(
        f"{name}: what the fit decided for each row (training data)",
        [],
        ["Row", "Unit", "Residual RMS", "Signal std", "Decision"],
        rows,
    )


def eigenvalues(name: str, validation: Validation) -> Markup:
    """Eigenvalues per schedule point, conjugate pairs on one line, unstable ones marked."""
    schedule = next(iter(validation.models.values())).schedule
    data = validation.record.get("data", ())
    seconds = max((run.get("seconds", 0.0) for run in data), default=0.0)
    # Whether the model is unstable is not for its linear part to say.
    whole = all(model.e is None for model in validation.models.values())
    rows = []
    for point, values in validation.eigenvalues:
        where = f"{schedule} = {number(float(point))}" if schedule else "all conditions"
        for value in _upper(values):
            size = abs(value)
            growth = Growth(float(point), value.real, seconds)
            unstable = growth.unstable and whole
            word = growth.word if growth.integrates else "stable" if value.real <= 0 else "grows"
            pair = f"± {number(value.imag)}" if value.imag > 0 else MISSING
            rows.append(
                [
                    where,
                    Cell(number(value.real), "bad num" if unstable else "num"),
                    Cell(pair, "num"),
                    size / (2 * np.pi) if value.imag > 0 else None,
                    -value.real / size if value.imag > 0 else None,
                    Cell("unstable", "bad") if unstable else word,
                ]
            )
    return table(
        f"{name}: eigenvalues of the linear fit",
        [],
        ["At", "Real (1/s)", "Imaginary (rad/s)", "Frequency (Hz)", "Damping ratio", ""],
        rows,
    )


def _upper(values: Sequence[complex] | Any) -> list[complex]:
    """One of each conjugate pair."""
    return [complex(v) for v in values if v.imag >= 0]


def times(name: str, validation: Validation) -> Markup:
    """Seconds per step of the build, and per rollout."""
    v = validation
    built = [[f"build: {k}", float(s)] for k, s in v.record.get("seconds", {}).items()]
    if built:
        built.append(["build: total", float(sum(row[1] for row in built))])
    simulated = [[f"one rollout, {m}", v.wall_time(m)] for m in v.models]
    return table(f"{name}: wall times", [], ["Step", "Seconds"], [*built, *simulated])


# -- settings and provenance --------------------------------------------------------------------


def provenance(name: str, validation: Validation) -> Markup:
    """Settings, training data and versions, folded."""
    record = validation.record
    settings = [[k, v] for k, v in _flat(record.get("settings", {}))]
    fitted = ("condition", "schedule_windows", "window_samples", "checks")
    extra = {k: record[k] for k in fitted if k in record}
    settings += [[k, v] for k, v in _flat({"fit": extra})]
    data = [
        [
            d["name"],
            Markup(int(d["samples"])),
            float(d["seconds"]),
            element("code", d["sha256"][:12]),
        ]
        for d in record.get("data", ())
    ]
    versions = [[k, str(v)] for k, v in record.get("versions", {}).items()]
    parameters = next(iter(validation.models.values())).signals.parameters
    tests = [[r.recorded.name, r.recorded.source or MISSING, Markup(len(r.recorded)),
              r.recorded.wall_time, *(r.parameters[c.name] for c in parameters)]
             for r in validation.runs]  # fmt: skip
    parts = [
        ("Settings", ["Setting", "Value"], settings),
        ("Training data", ["Run", "Samples", "Seconds", "SHA-256 (first 12)"], data),
        (
            "Test runs",
            ["Run", "File", "Samples", "Simulator's wall time (s)", *(c.label for c in parameters)],
            tests,
        ),
        ("Versions", ["Package", "Version"], versions),
    ]
    return join(
        *[
            element("details", element("summary", what), table(f"{name}: {what}", [], heads, rows))
            for what, heads, rows in parts
            if rows
        ]
    )


def _flat(value: object, key: str = "") -> list[tuple[str, str]]:
    """Nested settings as lines ``linear.points: 5``."""
    if isinstance(value, Mapping) and value:
        return [
            pair for k, v in value.items() for pair in _flat(v, f"{key}.{k}" if key else str(k))
        ]
    if isinstance(value, list | tuple):
        if any(isinstance(v, Mapping) for v in value):
            return [pair for i, v in enumerate(value) for pair in _flat(v, f"{key}[{i}]")]
        return [(key, ", ".join(_plain(v) for v in value) or MISSING)]
    return [(key, _plain(value))]


def _plain(value: object) -> str:
    if value is None or value == {}:
        return MISSING
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_plain(v) for v in value)}]"
    return str(value)

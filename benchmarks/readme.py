"""Write the tables of the README and of the pages in docs/, and figures, from measurements.

python -m benchmarks > figures.json && python -m benchmarks.readme figures.json
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from dfsm.report.article import Table, cell_text

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = ("method.md", "optimal-control.md", "floating-turbine.md")
FILES = (ROOT / "README.md", *(DOCS / name for name in PAGES))


def accuracy_table(figures: Mapping[str, Any], variant: str = "multi-fidelity") -> list[str]:
    """Mean NRMSE per model and channel; a dash where a rollout ended early or has no such state."""
    models = {label: found[variant] for label, found in figures.items()}
    channels = list(dict.fromkeys(c for found in models.values() for c in found["nrmse"]))
    lines = [
        "| model | rollouts completed | " + " | ".join(channels) + " |",
        "|---|---|" + "---|" * len(channels),
    ]
    for label, found in models.items():
        errors = [found["nrmse"].get(c) for c in channels]
        cells = ["–" if v is None else f"{v:.2f}" for v in errors]
        done = f"{found['completed']} of {found['of']}"
        lines.append(f"| {label} | {done} | " + " | ".join(cells) + " |")
    return lines


def speed_table(figures: Mapping[str, Any]) -> list[str]:
    """One line per timing."""
    linear, corrective = figures["linear_fit"], figures["corrective"]
    simulate, start = figures["simulate"], figures["start"]
    rows = [
        (
            "linear fit, 1 000 000 samples × 6 inputs → 4 derivatives",
            f"{linear['dfsm_s']:.3f} s, {linear['times_faster']:.1f} × faster than "
            f"`numpy.linalg.lstsq` (coefficients agree to {linear['difference']:.0e})",
        ),
        (
            "subsample and train both corrective functions, 8 runs × 600 s, 200 units each",
            f"{corrective['both_functions_s']:.1f} s (the paper: 65 s)",
        ),
        (
            "simulate 600 s at 0.05 s, LPV + 200 units for f̂ and for ĝ, outputs included",
            f"{simulate['one_run_s']:.3f} s, {simulate['times_faster_than_solve_ivp']:.0f} × "
            "faster than `scipy.integrate.solve_ivp` on the same right-hand side, "
            f"{simulate['times_faster_than_openfast']:,.0f} × faster than OpenFAST",
        ),
        ("100 such runs at once", f"{simulate['hundred_runs_s']:.1f} s"),
        ("`import dfsm`; `dfsm --help`", f"{start['import_s']:.2f} s; {start['help_s']:.2f} s"),
    ]
    return ["| what | time |", "|---|---|", *(f"| {what} | {value} |" for what, value in rows)]


def derivatives_table(figures: Mapping[str, Any]) -> list[str]:
    """Mean and worst error per method, in per cent."""
    names = {
        "dfsm_default": "default (quantisation step known)",
        "dfsm_cross_validation": "default, step unknown",
        "scipy_quintic": "`UnivariateSpline(k=5, s=N q²/12)`",
        "paper_cubic": "cubic spline (the paper)",
    }
    lines = ["| method | rate, mean / worst | acceleration, mean / worst |", "|---|---|---|"]
    for key, name in names.items():
        mean, worst = figures["mean"][key], figures["worst"][key]
        cells = [f"{mean[w]:.3g} % / {worst[w]:.3g} %" for w in ("rate", "acceleration")]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    return lines


def parameters_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors of the derivative and of the rollout for three sets of masses."""
    sets = next(iter(figures["errors"].values()))
    heads = [f"{where}, f̂ / rollout" for where in sets]
    lines = [f"| model | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
    for name, found in figures["errors"].items():
        cells = [
            f"{100 * e['derivative']:.2g} % / "
            + ("–" if e["rollout"] is None else f"{100 * e['rollout']:.2g} %")
            for e in found.values()
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def scaling_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors, then costs: a row per kind, a column per number of inputs."""
    heads = [f"{found['inputs']} inputs" for found in figures.values()]
    kinds = list(next(iter(figures.values()))["results"])
    lines: list[str] = []
    for what, cell in (
        ("error, f̂ / rollout", _scaling_errors),
        ("cost, training / evaluation", _scaling_costs),
    ):
        lines += [f"| {what} | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
        for kind in kinds:
            cells = [cell(found["results"][kind]) for found in figures.values()]
            lines.append(f"| {kind} | {' | '.join(cells)} |")
        lines.append("")
    return lines[:-1]


def _scaling_errors(found: Mapping[str, Any]) -> str:
    rollout = "–" if found["rollout"] is None else f"{100 * found['rollout']:.2g} %"
    return f"{100 * found['derivative']:.2g} % / {rollout}"


def _scaling_costs(found: Mapping[str, Any]) -> str:
    seconds, ratio = found["training_s"], found["evaluation_ratio"]
    training = f"{seconds:.0f} s" if seconds >= 1 else f"{seconds:.1g} s"
    return f"{training} / " + ("–" if ratio is None else f"{ratio:.2g} ×")


def rollouts_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors of every step from the paper's recipe on."""
    lines = [
        "| model | pitch | pitch rate | rotor speed | perturbed: pitch, speed | diverged | fit |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, found in figures["models"].items():
        closed, other = found["closed loop"], found["perturbed"]
        states = ("PtfmPitch", "PtfmPitch_dot", "GenSpeed")
        cells = [f"{_two(closed['filtered'][c])} ({_two(closed['unfiltered'][c])})" for c in states]
        cells.append(", ".join(_two(other["filtered"][c]) for c in (states[0], states[2])))
        cells.append(f"{closed['diverged'] + other['diverged']} of {closed['of'] + other['of']}")
        cells.append(f"{found['fit_s']:.0f} s")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def _two(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _pitch_and_speed(errors: Mapping[str, float | None]) -> str:
    return ", ".join(_two(errors[c]) for c in ("PtfmPitch", "GenSpeed"))


def loads_table(figures: Mapping[str, Any]) -> list[str]:
    """Tower-base loads of the last model, run by run."""
    lines = [
        "| run, load | NRMSE (below 0.5 Hz) | damage-equivalent load | power 0–0.3 Hz | power 3P "
        "| peaks off by bins: platform, wave |",
        "|---|---|---|---|---|---|",
    ]
    for run, loads in figures["loads"].items():
        for load, found in loads.items():
            power, bins = found["power_ratio"], found["peak_bins"]
            cells = [
                f"{found['nrmse']:.2f} ({found['nrmse_filtered']:.2f})",
                f"{found['del_ratio']:.2f}",
                f"{power['0-0.3 Hz']:.2f}",
                f"{power['3P']:.2f}",
                ", ".join("–" if b is None else f"{b:.0f}" for b in bins.values()),
            ]
            lines.append(f"| {run.removeprefix('iea15_2dof_')}, {load} | {' | '.join(cells)} |")
    return lines


def leak_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors of a linear fit with each of three winds as its disturbance."""
    lines = ["| wind given to the model | pitch | pitch rate | rotor speed |", "|---|---|---|---|"]
    for wind, found in figures["leak"].items():
        lines.append(f"| {wind} | {' | '.join(_two(v) for v in found.values())} |")
    return lines


def limits_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors with fewer runs, other sizes of the network, and the thrust given."""
    lines = [
        "| model | training runs | training, validation | pitch | pitch rate | rotor speed "
        "| perturbed: pitch, speed |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, found in figures["variants"].items():
        closed, other = found["closed loop"]["filtered"], found["perturbed"]["filtered"]
        pair = ", ".join(f"{found[k] ** 0.5:.3f}" for k in ("training", "validation"))
        cells = [str(found["runs"]), pair, *(_two(v) for v in closed.values())]
        cells.append(_pitch_and_speed(other))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def field_table(figures: Mapping[str, Any]) -> list[str]:
    """What explains the slow part of what the model's derivatives leave over."""
    lines = [
        "| left over, below 0.05 Hz | RotWind and its slopes | and the rest of the field "
        "| and the rest, shifted in time |",
        "|---|---|---|---|",
    ]
    for name, found in figures["field"].items():
        three, whole = (f"{100 * found[k]:.0f} %" for k in ("three signals", "whole field"))
        middle, most = (f"{100 * v:.0f} %" for v in found["shifted"])
        lines.append(f"| {name} | {three} | {whole} | {middle} (95th percentile: {most}) |")
    return lines


def braking_table(figures: Mapping[str, Any]) -> list[str]:
    """Effect of torque on the speed's derivative, true and as derivatives teach it."""
    lines = ["| torque's effect (10⁻⁵ rpm/s per kN m) | weakest | strongest |", "|---|---|---|"]
    for name, pair in figures["braking"].items():
        cells = [f"{1e5 * v:.1f}".replace("-", "\N{MINUS SIGN}") for v in pair]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def matched_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors of rollouts, and of differences between rollouts under the same wind."""
    lines = [
        "| correlation of errors | pitch | pitch rate | rotor speed | perturbed: pitch, speed "
        f"| difference of the speed: {', '.join(figures['pairs'])} |",
        "|---|---|---|---|---|---|",
    ]
    for name, found in figures["models"].items():
        closed, other = found["closed loop"]["filtered"], found["perturbed"]["filtered"]
        cells = [name, *(_two(v) for v in closed.values())]
        cells.append(_pitch_and_speed(other))
        cells.append(", ".join(_two(errors[-1]) for errors in found["differences"]))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def slopes_table(figures: Mapping[str, Any]) -> list[str]:
    """What the speed's derivative depends on, by differences of records."""
    lines = [
        "| pair of runs | speed (1/s) | pitch rate (rpm/s per deg/s) | blade pitch (rpm/s per deg) "
        "| torque (10⁻⁵ rpm/s per kN m) |",
        "|---|---|---|---|---|",
    ]
    for name, found in zip(figures["pairs"], figures["slopes"], strict=True):
        values = [f"{found[c]:.3f}" for c in ("GenSpeed", "PtfmPitch_dot", "BldPitch1")]
        cells = [*values, f"{1e5 * found['GenTq']:.1f}"]
        signed = [c.replace("-", "\N{MINUS SIGN}") for c in cells]
        lines.append(f"| {name} | {' | '.join(signed)} |")
    return lines


def below_rated_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors below rated wind, of a model that is told what moves the rotor and one that is not."""
    lines = [
        "| at 6 m/s | controlled: pitch, speed | perturbed: pitch, speed "
        "| difference of the pair: pitch, speed |",
        "|---|---|---|---|",
    ]
    for name, found in figures["below rated"].items():
        cells = [_pitch_and_speed(found[k]["filtered"]) for k in ("closed loop", "perturbed")]
        difference = found["differences"][0]
        cells.append(f"{_two(difference[0])}, {_two(difference[-1])}")
        lines.append(f"| model for {name} | {' | '.join(cells)} |")
    return lines


def sweep_table(figures: Mapping[str, Any]) -> list[str]:
    """The sweep of constant winds in one line per figure."""
    found = figures["sweep"]
    reach = max(found.values(), key=lambda f: f["half_ranges"])["half_ranges"]
    drift = max(f["drift"] for f in found.values())
    done = sum(f["completed"] for f in found.values())
    return [
        "| constant winds | simulated to the end | farthest from the middle | drift at last |",
        "|---|---|---|---|",
        f"| {' to '.join((next(iter(found)), list(found)[-1]))} m/s | {done} of {len(found)} | "
        f"{reach:.2f} half-ranges | {drift:.0e} standard deviations per s |",
    ]


def codesign_table(figures: Mapping[str, Any]) -> list[str]:
    """A line per seed of the plant-and-control optimization."""
    lines = [
        "| seed | runs | best m2, surrogate / truth | cost, surrogate / truth | this m2 costs "
        "more by | arm misses its end by |",
        "|---|---|---|---|---|---|",
    ]
    for seed, found in figures["codesign"].items():
        cells = [
            str(found["runs"]),
            f"{found['mass']:.3f} / {found['true_mass']:.3f} kg",
            f"{found['cost']:.4f} / {found['true_cost']:.4f}",
            f"{100 * found['loss']:.2g} %",
            f"{max(found['miss']['theta1'], found['miss']['theta2']):.2g} rad",
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
    for seed, found in figures["adaptive"].items():
        rounds = [None if d is None else 100 * d for d in found["differences"]]
        cells = [
            str(found["runs"]),
            str(found["simulations"]) + ("" if found["status"] == "AGREED" else ", no agreement"),
            f"{found['predicted']:.4f}",
            f"{found['realised']:.4f} {found['price']:+.4f}".replace("-", "\N{MINUS SIGN}"),
            f"{found['miss']:.1g}",
            f"{found['true_cost']:.4f}",
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
        (name, f"{found['value']:.10g}", *(_solved(found.get(key)) for key in methods))
        for name, found in figures.items()
    ]
    return Table("known", "", ("problem", "optimum", *methods.values()), _minus(rows)).markdown()


def _solved(found: Mapping[str, Any] | None) -> str | None:
    if found is None:
        return None
    if found["ending"] != "SOLVED":
        return found["ending"].lower().replace("_", " ")
    error, seconds = cell_text(found["relative_error"], 2), cell_text(found["seconds"], 2)
    return f"{error}, {found['iterations']}, {seconds} s"


def orders_table(figures: Mapping[str, Any]) -> list[str]:
    """Observed orders; in brackets where the finer error is below the solver's tolerance."""
    meshes = next(iter(figures.values()))["intervals"]
    steps = [f"{coarse} → {fine}" for coarse, fine in pairwise(meshes)]
    rows = []
    for name, found in figures.items():
        pairs = zip(found["orders"], found["errors"][1:], strict=True)
        cells = [
            f"{order:.2f}" if e > found["tolerance"] else f"({order:.2f})" for order, e in pairs
        ]
        label = name.replace("hermite_simpson", "Hermite–Simpson").replace("radau", "Radau")
        rows.append((label, str(found["theory"]), *cells))
    return Table("orders", "", ("problem, scheme", "theory", *steps), _minus(rows)).markdown()


def control_speed_table(figures: Mapping[str, Any]) -> list[str]:
    """Time per iteration over the number of points; the last column is 1 where it is linear."""
    least, first = min((int(n), found["ms_per_iteration"]) for n, found in figures.items())
    rows = []
    for count, found in figures.items():
        points, ms = int(count), found["ms_per_iteration"]
        growth = f"{points / least:.0f} × the points, {ms / first:.2g} × the time"
        label = found["iterations"] if found["ending"] == "SOLVED" else found["ending"].lower()
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
        found = figures[key]
        if found is None:
            continue
        start, solve = (
            found.get(a, found.get(b))
            for a, b in (("seconds_setup", "seconds_compile"), ("seconds_solve", "seconds"))
        )
        ms = 1000 * solve / found["iterations"]
        objective = f"{found['objective']:.4f}"
        rows.append((name, objective, found["iterations"], start, solve, ms, ms / reference))
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


TABLES = {
    "accuracy": accuracy_table,
    "speed": speed_table,
    "derivatives": derivatives_table,
    "parameters": parameters_table,
    "scaling": scaling_table,
}
ROLLOUT_TABLES = {
    "rollouts": rollouts_table,
    "loads": loads_table,
    "sweep": sweep_table,
    "leak": leak_table,
}
LIMITS_TABLES = {"limits": limits_table, "field": field_table, "braking": braking_table}
MATCHED_TABLES = {
    "matched": matched_table,
    "slopes": slopes_table,
    "below_rated": below_rated_table,
}
CODESIGN_TABLES = {"codesign": codesign_table, "adaptive": adaptive_table}
# By the part of the figures that each shows.
CONTROL_TABLES = {
    "known": ("known", known_table),
    "orders": ("orders", orders_table),
    "control_speed": ("turbine", control_speed_table),
    "expressions": ("expressions", expressions_table),
}


def fill(path: Path, tables: Mapping[str, list[str]]) -> None:
    """Put a table between ``<!-- name -->`` and ``<!-- end -->``, wherever that stands."""
    text = path.read_text(encoding="utf-8")
    for name, lines in tables.items():
        mark = f"<!-- {name} -->"
        if mark in text:
            head, rest = text.split(mark, 1)
            tail = rest.split("<!-- end -->", 1)[1]
            text = "\n".join([head + mark, *lines, "<!-- end -->" + tail])
    path.write_text(text, encoding="utf-8")


def main() -> None:
    """Write the tables that the figures hold."""
    figures = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    tables = {name: table(figures[name]) for name, table in TABLES.items() if name in figures}
    for part, group in (
        ("rollouts", ROLLOUT_TABLES),
        ("limits", LIMITS_TABLES),
        ("matched", MATCHED_TABLES),
        ("codesign", CODESIGN_TABLES),
    ):
        if part in figures:
            tables |= {name: table(figures[part]) for name, table in group.items()}
    if "peer" in figures:
        tables["peer"] = rollouts_table(figures["peer"])
    if "control" in figures:
        for name, (part, table) in CONTROL_TABLES.items():
            tables[name] = table(figures["control"][part])
    for path in FILES:
        fill(path, tables)
    draw(figures)


def draw(figures: Mapping[str, Any]) -> None:
    """Draw what the figures hold; only this needs Matplotlib."""
    if "scaling" in figures:
        from benchmarks.figures import draw_scaling

        draw_scaling(figures["scaling"], DOCS / "figures" / "scaling.svg")
    if "control" in figures:
        from benchmarks.figures import draw_orders

        draw_orders(figures["control"]["orders"], DOCS / "figures" / "orders.svg")


if __name__ == "__main__":
    main()

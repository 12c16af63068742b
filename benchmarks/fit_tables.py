"""Tables of what fits cost and how accurate they are, from measurements."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def accuracy_table(figures: Mapping[str, Any], variant: str = "multi-fidelity") -> list[str]:
    """Mean NRMSE per model and channel; a dash where a rollout ended early or has no such state."""
    models = {label: result[variant] for label, result in figures.items()}
    channels = list(dict.fromkeys(c for result in models.values() for c in result["nrmse"]))
    lines = [
        "| model | rollouts completed | " + " | ".join(channels) + " |",
        "|---|---|" + "---|" * len(channels),
    ]
    for label, result in models.items():
        errors = [result["nrmse"].get(c) for c in channels]
        cells = ["–" if v is None else f"{v:.2f}" for v in errors]
        done = f"{result['completed']} of {result['of']}"
        lines.append(f"| {label} | {done} | " + " | ".join(cells) + " |")
    return lines


def speed_table(figures: Mapping[str, Any]) -> list[str]:
    """One line per timing."""
    linear, corrective = figures["linear_fit"], figures["corrective"]
    simulate, start = figures["simulate"], figures["start"]
    rows = [
        (
            "linear fit, 1 000 000 samples × 6 inputs → 4 derivatives",
            f"{linear['dfsm_s']:.3f} s; `numpy.linalg.lstsq` takes "
            f"{linear['times_faster']:.1f} × as long, NumPy's Cholesky of the normal equations "
            f"{linear['times_faster_than_normal_equations']:.1f} × "
            f"(coefficients agree to {linear['difference']:.0e})",
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
    for name, errors in figures["errors"].items():
        cells = [
            f"{100 * e['derivative']:.2g} % / "
            + ("–" if e["rollout"] is None else f"{100 * e['rollout']:.2g} %")
            for e in errors.values()
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def scaling_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors, then costs: a row per kind, a column per number of inputs."""
    heads = [f"{size['inputs']} inputs" for size in figures.values()]
    kinds = list(next(iter(figures.values()))["results"])
    lines: list[str] = []
    for what, cell in (
        ("error, f̂ / rollout", _scaling_errors),
        ("cost, training / evaluation", _scaling_costs),
    ):
        lines += [f"| {what} | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
        for kind in kinds:
            cells = [cell(size["results"][kind]) for size in figures.values()]
            lines.append(f"| {kind} | {' | '.join(cells)} |")
        lines.append("")
    return lines[:-1]


def _scaling_errors(result: Mapping[str, Any]) -> str:
    rollout = "–" if result["rollout"] is None else f"{100 * result['rollout']:.2g} %"
    return f"{100 * result['derivative']:.2g} % / {rollout}"


def _scaling_costs(result: Mapping[str, Any]) -> str:
    seconds, ratio = result["training_s"], result["evaluation_ratio"]
    training = f"{seconds:.0f} s" if seconds >= 1 else f"{seconds:.1g} s"
    return f"{training} / " + ("–" if ratio is None else f"{ratio:.2g} ×")

"""A solution of any optimal control problem as a page: how it ended, and every signal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dfsm.control.solution import Solution
from dfsm.data.trajectory import Role, Trajectory
from dfsm.report.article import Article, Figure, Section, Table
from dfsm.report.article_page import write_article
from dfsm.report.control_figures import stacked_figure

# In the order drawn: what comes from outside, what is chosen, what follows.
_ROLES: tuple[Role, ...] = ("disturbance", "control", "state", "output")


def write_solution_report(solution: Solution, path: str | Path) -> None:
    """Write one self-contained HTML page about a solution.

    Parameters
    ----------
    solution
        From `solve`, also one that did not succeed.
    path
        File to write; an existing one is replaced when the new one is complete.

    Raises
    ------
    DfsmError
        The file cannot be written.
    """
    write_article(solution_article(solution), path)


def solution_article(solution: Solution) -> Article:
    """Put a solution into tables and figures.

    Parameters
    ----------
    solution
        From `solve`.
    """
    count = len(solution.trajectories)
    return Article(
        key="solution",
        title=f"Optimal control: {solution.name}",
        lede=_verdict(solution),
        sections=(
            *[_course(solution, k, count) for k in range(count)],
            Section("outcome", "Outcome", tables=(outcome(solution),)),
            *[_scenario(solution, k, count) for k in range(count)],
        ),
    )


def _verdict(s: Solution) -> str:
    """How the solve ended, what it came to, and what there is to doubt."""
    told = [s.message[:1].upper() + s.message[1:], f"The objective is {s.objective:.4g}"]
    if s.outside:
        told.append(f"{100 * s.outside:.0f} % of the horizon is outside the training data")
    if s.replays:
        worst = max(r.relative for r in s.replays)
        told.append(
            f"Repeated by an adaptive integrator, the states are off by {100 * worst:.2g} % at most"
        )
    return ". ".join(told) + "."


def outcome(s: Solution) -> Table:
    """How a solve ended, and what it came to."""
    time = s.trajectory.time
    rows: list[tuple[str, str | float | None]] = [
        ("ended", s.ending.name.lower().replace("_", " ")),
        ("objective", s.objective),
        ("of which final cost", s.final_cost),
        ("of which integral", s.integral_cost),
        ("first time (s)", float(time[0])),
        ("last time (s)", float(time[-1])),
        *[(f"parameter {name}", value) for name, value in s.parameters.items()],
        (f"intervals ({s.grid.kind.replace('_', '–')})", s.grid.intervals),
        *([] if s.errors else [("largest local error", s.error)]),
        *[(f"error of the {name}, between the nodes", v) for name, v in _estimated(s)],
        ("largest violation of a constraint, relative", s.violation),
        *_optimality(s),
        ("iterations", s.iterations),
        ("time to compile (s)", s.seconds["compile"]),
        ("time to solve (s)", s.seconds["solve"]),
    ]
    if s.outside is not None:
        rows.append(("outside the training range (% of the horizon)", 100 * s.outside))
        rows += [("outside the training range", text) for text in s.departures]
    return Table("outcome", "How the solve ended", ("what", "value"), tuple(rows), digits=6)


def _estimated(s: Solution) -> list[tuple[str, float | None]]:
    """Errors by name, None where nothing estimates them."""
    return [(name, v if np.isfinite(v) else None) for name, v in s.errors.items()]


def _optimality(s: Solution) -> list[tuple[str, str | float | None]]:
    """Rows on the optimality conditions, where they were measured."""
    if s.optimality is None:
        return []
    return [
        ("slope of the Lagrangian, scaled", s.optimality.stationarity),
        ("complementarity, scaled", s.optimality.complementarity),
    ]


def _scenario(s: Solution, k: int, count: int) -> Section:
    run = s.trajectories[k]
    names = _names(run)
    rows = tuple(
        (
            f"{name} ({run.channel(name).unit})" if run.channel(name).unit else name,
            run.channel(name).role,
            *map(float, (run[name].min(), run[name].mean(), run[name].max())),
            s.replays[k].deviation.get(name) if s.replays else None,
        )
        for name in names
    )
    table = Table(
        f"signals_{k + 1}",
        "All signals at the nodes",
        ("signal", "role", "least", "mean", "most", "replay, off by"),
        rows,
        note=(
            "Replay: the optimal controls in an adaptive integrator, from the optimal initial "
            "state, with all samples of the disturbances."
        ),
        digits=5,
    )
    heading = f"Signals of scenario {k + 1}" if count > 1 else "Signals"
    return Section(f"signals-{k + 1}", heading, tables=(table,))


def _course(s: Solution, k: int, count: int) -> Section:
    heading = f"Scenario {k + 1}: {s.trajectories[k].name}" if count > 1 else "The optimum"
    return Section(f"scenario-{k + 1}", heading, figures=(course(s, k),))


def course(solution: Solution, scenario: int = 0, names: Sequence[str] | None = None) -> Figure:
    """Signals of one scenario above each other, with their bounds.

    Parameters
    ----------
    solution
        From `solve`.
    scenario
        Which one.
    names
        Of the signals; None takes all but the parameters.
    """
    label = f"scenario {scenario + 1}" if len(solution.trajectories) > 1 else "optimum"
    return stacked_figure(
        f"course_{scenario + 1}",
        "Disturbances, controls, states and outputs. Dashed: bounds near enough to be shown.",
        {label: solution},
        _names(solution.trajectories[scenario]) if names is None else names,
        scenario=scenario,
    )


def _names(run: Trajectory) -> list[str]:
    return [c.name for role in _ROLES for c in run.channels if c.role == role]

"""What `plot()` of each result shows, as a figure that any library can draw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import singledispatch
from typing import Any

import numpy as np

from dfsm.control.solution import Solution
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, near_matches
from dfsm.loops.adaptive import AdaptiveResult
from dfsm.loops.load_cases import Figures
from dfsm.loops.sweep import Sweep
from dfsm.loops.tuning_result import TuningResult
from dfsm.report.article import Curve, Figure, Panel
from dfsm.report.figures import within_reason
from dfsm.report.first_screen import main_channels
from dfsm.report.solution_page import course
from dfsm.selection.compare import Ranking
from dfsm.simulation.closed_loop import ClosedLoopRun, LoopStatus
from dfsm.simulation.simulate import Simulation, Status
from dfsm.validation.closed_loop import SHOWN_EXPONENT, ClosedLoopValidation
from dfsm.validation.results import Validation

TIME = "time (s)"
RECORDED = "recorded"
# Panels of a figure whose channels nobody chose; a result file may hold hundreds.
_MOST_PANELS = 12
# Samples of a drawn series at most.
_MOST_SAMPLES = 12000


@singledispatch
def figure_of(result: object, channels: Sequence[str] | None, **which: Any) -> Figure:
    """Describe the figure of a result.

    Parameters
    ----------
    result
        One of those with a method `plot`.
    channels
        Names to draw, in this order; None leaves the choice to the kind of result.
    **which
        Which part of it, as in its method `plot`.

    Raises
    ------
    DfsmError
        There is no such channel, run or scenario.
    """
    raise DfsmError(f"a {type(result).__name__} has no figure of {channels or which or 'its own'}")


def extremes(time: Array, values: Array, most: int = _MOST_SAMPLES) -> tuple[Array, Array]:
    """Thin a series to its smallest and largest sample per stretch, so that no peak is lost.

    Parameters
    ----------
    time, values
        Shape ``(time,)``.
    most
        Samples to keep at most; a shorter series comes back as it is.

    Returns
    -------
    tuple of ndarray
        Times and values of the samples kept, all of them recorded ones.
    """
    if len(time) <= most:
        return time, values
    length = -(-len(time) // (most // 2))
    missing = -len(values) % length
    blocks = np.pad(values, (0, missing), mode="edge").reshape(-1, length)
    low = np.where(np.isnan(blocks), np.inf, blocks).argmin(axis=1)
    high = np.where(np.isnan(blocks), -np.inf, blocks).argmax(axis=1)
    first = length * np.arange(len(blocks))
    places = np.concatenate([[0], first + low, first + high, [len(time) - 1]])
    kept = np.unique(np.minimum(places, len(time) - 1))
    return time[kept], values[kept]


# -- series along time ----------------------------------------------------------------------------


@figure_of.register
def _trajectory(result: Trajectory, channels: Sequence[str] | None, **_which: Any) -> Figure:
    names = _named(channels, result.names)
    told = "" if channels is not None or len(names) == len(result.names) else (
        f": {len(names)} of {len(result.names)} channels"
    )  # fmt: skip
    panels = [_panel(result.channel(n).label, [Curve(result.name, *_of(result, n))]) for n in names]
    return Figure("run", f"{result.name}{told}", tuple(panels), stacked=True)


@figure_of.register
def _simulation(
    result: Simulation | ClosedLoopRun,
    channels: Sequence[str] | None,
    recorded: Trajectory | None = None,
    **_which: Any,
) -> Figure:
    run = result.trajectory
    label = "simulated" if isinstance(result, Simulation) else "closed loop"
    panels = []
    for name in _named(channels, run.names):
        parts = {label: (run, 1)}
        if recorded is not None and name in recorded:
            inside = recorded.window(float(run.time[0]), None)
            parts = {RECORDED: (inside, 0), **parts}
        panels.append(_beside(name, run.channel(name).label, parts))
    done = result.status in (Status.COMPLETED, LoopStatus.COMPLETED)
    ended = "" if done else f", ended at {result.ended:g} s: {result.reason}"
    return Figure("rollout", f"{run.name}{ended}", tuple(panels), stacked=True)


@figure_of.register
def _validation(
    result: Validation, channels: Sequence[str] | None, run: int | str = 0, **_which: Any
) -> Figure:
    chosen = result.runs[_index(run, [r.recorded.name for r in result.runs])]
    known = [c.name for c in result.channels]
    names = _named(channels, known, [c.name for c in main_channels(result)])
    panels = []
    for name in names:
        parts: dict[str, tuple[Trajectory, int]] = {RECORDED: (chosen.recorded, 0)}
        bands: list[Curve] = []
        for colour, (variant, m) in enumerate(chosen.models.items(), start=1):
            parts[variant] = (m.simulation.trajectory, colour)
            if m.band and result.intervals is not None:
                low, high = m.band
                title = f"{variant}, {result.intervals.level:.0%} prediction interval"
                bands.append(Curve(title, low.time, low[name], colour, "band", upper=high[name]))
        title = chosen.recorded.channel(name).label
        scores = {v: m.errors[name].nrmse for v, m in chosen.models.items() if name in m.errors}
        panels.append(_beside(name, f"{title}{_scored(scores)}", parts, bands))
    return Figure("validation", chosen.recorded.name, tuple(panels), stacked=True)


def _scored(scores: Mapping[str, float]) -> str:
    known = [f"{v:.2g}" for v in scores.values() if np.isfinite(v)]
    return f"   NRMSE {', '.join(known)}" if len(known) == len(scores) and known else ""


@figure_of.register
def _loops(
    result: ClosedLoopValidation, channels: Sequence[str] | None, run: int | str = 0, **_which: Any
) -> Figure:
    chosen = result.runs[_index(run, [r.recorded.name for r in result.runs])]
    panels = []
    for name in _named(channels, [c.name for c in result.channels]):
        parts = {RECORDED: (chosen.recorded, 0), "closed loop": (chosen.loop.trajectory, 1)}
        if chosen.replay_statistics and name in chosen.replay.trajectory:
            parts["open-loop replay"] = (chosen.replay.trajectory, 2)
        known = {label: part for label, part in parts.items() if name in part[0]}
        panels.append(_beside(name, _label(result, name), known))
    return Figure("closed_loop", chosen.recorded.name, tuple(panels), stacked=True)


@figure_of.register
def _tuning(
    result: TuningResult, channels: Sequence[str] | None, run: int | str = 0, **_which: Any
) -> Figure:
    k = _index(run, [loop.trajectory.name for loop in result.loops])
    new, old = result.loops[k].trajectory, result.before_loops[k].trajectory
    usual = list(dict.fromkeys(m.channel for m in result.problem.measures))
    panels = []
    for name in _named(channels, new.names, usual):
        parts = {"before": (old, 2), "tuned": (new, 1)}
        panels.append(_beside(name, new.channel(name).label, parts))
    return Figure("tuning", new.name, tuple(panels), stacked=True)


@figure_of.register
def _solution(
    result: Solution, channels: Sequence[str] | None, scenario: int = 0, **_which: Any
) -> Figure:
    _index(scenario, [str(k) for k in range(len(result.trajectories))], "scenario")
    known = result.trajectories[scenario].names
    names = None if channels is None else _named(channels, known)
    return course(result, scenario, names)


# -- comparisons ----------------------------------------------------------------------------------


@figure_of.register
def _sweep(result: Sweep, channels: Sequence[str] | None, **_which: Any) -> Figure:
    whole = [s for s in result.controllers if s.figures]
    base = result.recorded if result.recorded.figures else next(iter(whole), result.recorded)
    if not base.figures:
        raise DfsmError("no controller completed all runs, so there is nothing to compare")
    names = _named(channels, list(base.figures))
    kinds = {
        "standard deviation": lambda f: f.std,
        "mean absolute rate": lambda f: f.travel,
        f"damage-equivalent load (m = {SHOWN_EXPONENT})": lambda f: f.damage[SHOWN_EXPONENT],
    }
    panels = []
    for title, of in kinds.items():
        curves = [Curve(base.name, np.ones(2), np.array([-0.5, len(names) - 0.5]), 0, "dashed")]
        for k, swept in enumerate(s for s in whole if s is not base):
            shift = 0.5 * (k + 1) / (len(whole) + 1) - 0.25
            rows = [i for i, n in enumerate(names) if n in swept.figures and of(base.figures[n])]
            ratios = [_ratio(of, swept.figures[names[i]], base.figures[names[i]]) for i in rows]
            at = len(names) - 1 - np.array(rows, dtype=float) - shift
            curves.append(Curve(swept.name, np.array(ratios), at, k + 1, "points"))
        ticks = tuple((len(names) - 1.0 - i, n) for i, n in enumerate(names))
        most = max(1.0, *(float(x) for c in curves for x in c.x))
        panels.append(
            Panel(
                title,
                f"over that of {base.name}",
                "",
                tuple(curves),
                ticks=ticks,
                x_range=(0.0, 1.1 * most),
            )
        )
    return Figure("sweep", f"Controllers over {len(result.runs)} runs", tuple(panels))


def _ratio(of: Any, ours: Figures, base: Figures) -> float:
    return float(of(ours) / of(base))


@figure_of.register
def _ranking(result: Ranking, channels: Sequence[str] | None, **_which: Any) -> Figure:
    names = _named(channels, result.states)
    entries = result.candidates
    places = len(entries) - 1.0 - np.arange(len(entries))
    curves = []
    for colour, name in enumerate(names, start=1):
        errors = [e.outcome.nrmse.get(name) for e in entries]
        kept = [(v, p) for v, p in zip(errors, places, strict=True) if v is not None]
        if kept:
            x, y = (np.array(column) for column in zip(*kept, strict=True))
            curves.append(Curve(name, x, y, colour, "points"))
    ticks = tuple(
        (float(p), f"{e.name} ({e.outcome.diverged} ended early)" if e.outcome.diverged else e.name)
        for p, e in zip(places, entries, strict=True)
    )
    title = f"mean NRMSE over {len(result.validation)} runs held out, best first"
    most = max([1.0, *(float(x) for c in curves for x in c.x)])
    panel = Panel(title, "NRMSE", "", tuple(curves), ticks=ticks, x_range=(0.0, 1.1 * most))
    return Figure("ranking", "Candidates", (panel,))


@figure_of.register
def _adaptive(result: AdaptiveResult, _channels: Sequence[str] | None, **_which: Any) -> Figure:
    rounds = np.arange(1.0, len(result.rounds) + 1)
    predicted = np.array([r.solution.objective for r in result.rounds])
    realised = np.array([r.realised.cost for r in result.rounds])
    missed = np.array([r.realised.cost + r.realised.price for r in result.rounds])
    curves = (
        Curve("predicted by the model", rounds, predicted, 1, "points"),
        Curve("realised by the simulator", rounds, realised, 0, "points"),
        Curve("realised, with the price of what was missed", rounds, missed, 2, "points"),
    )
    ticks = tuple((float(k), f"{k:g}") for k in rounds)
    panel = Panel("objective", "round", "", curves, x_ticks=ticks)
    return Figure("rounds", result.message, (panel,))


# -- parts ----------------------------------------------------------------------------------------


def _named(
    channels: Sequence[str] | None, known: Sequence[str], usual: Sequence[str] | None = None
) -> list[str]:
    """Channels to draw: those asked for, or the usual ones, as many as one looks at."""
    if channels is None:
        return list(known if usual is None else usual)[:_MOST_PANELS]
    asked = [channels] if isinstance(channels, str) else list(channels)
    for name in asked:
        if name not in known:
            raise DfsmError(f"no channel '{name}' to draw; {near_matches(name, known)}")
    if not asked:
        raise DfsmError("no channels were named to draw: name some, or leave channels out")
    return asked


def _index(which: int | str, names: Sequence[str], what: str = "run") -> int:
    if isinstance(which, str):
        if which not in names:
            raise DfsmError(f"no {what} '{which}'; {near_matches(which, names)}")
        return names.index(which)
    if not 0 <= which < len(names):
        raise DfsmError(
            f"{what} is {which}, expected 0 to {len(names) - 1}, or a name of {what}s: "
            f"{', '.join(names[:5])}"
        )
    return which


def _label(result: ClosedLoopValidation, name: str) -> str:
    return next(c.label for c in result.channels if c.name == name)


def _of(run: Trajectory, name: str) -> tuple[Array, Array]:
    return extremes(run.time, run[name])


def _panel(title: str, curves: Sequence[Curve]) -> Panel:
    return Panel(title, TIME, "", tuple(curves))


def _beside(
    name: str,
    title: str,
    parts: Mapping[str, tuple[Trajectory, int]],
    bands: Sequence[Curve] = (),
) -> Panel:
    """One signal of several runs, each with its colour; a record decides what is seen of others."""
    curves = [*bands, *(Curve(label, *_of(run, name), k) for label, (run, k) in parts.items())]
    span = None
    if RECORDED in parts:
        drawn = [run[name] for label, (run, _) in parts.items() if label != RECORDED]
        record = parts[RECORDED][0][name]
        record = record[np.isfinite(record)]
        span = within_reason(record, drawn) if len(record) else None
    return Panel(title, TIME, "", tuple(curves), y_range=span)

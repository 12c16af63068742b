"""Figures of optimal trajectories: signals above each other on one time axis, with their bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dfsm.control.solution import Solution
from dfsm.core.types import Array
from dfsm.report.article import Curve, Figure, Panel

_TIME = "time (s)"
# Bounds further away than this share of a signal's range would flatten it: they are not drawn.
_FAR = 1.5
# What varies less than this share of its size is drawn as still, with this share around it.
_STILL, _MARGIN = 1e-5, 0.05


def stacked_figure(
    key: str,
    caption: str,
    solutions: Mapping[str, Solution],
    names: Sequence[str],
    derived: Mapping[str, Mapping[str, Array]] | None = None,
    scenario: int = 0,
) -> Figure:
    """Draw the same signals of several solutions.

    Parameters
    ----------
    key, caption
        See `Figure`.
    solutions
        By the name of their curves; each has its colour.
    names
        Channels and keys of `derived`, one panel each; what is the same in all solutions is drawn
        once.
    derived
        Signals that are no channels, by title with unit and by solution: shape ``(time,)``.
    scenario
        Of the solutions.
    """
    runs = {label: s.trajectories[scenario] for label, s in solutions.items()}
    first = next(iter(runs.values()))
    times = {label: run.time for label, run in runs.items()}
    panels = []
    for name in names:
        if derived and name in derived:
            panels.append(_panel(name, "", times, derived[name], {}))
            continue
        courses = {label: run[name] for label, run in runs.items()}
        bounds = {k: s.bounds[name] for k, s in solutions.items() if name in s.bounds}
        panels.append(_panel(name, first.channel(name).unit, times, courses, bounds))
    return Figure(key, caption, tuple(panels), stacked=True)


def _panel(
    name: str,
    unit: str,
    times: Mapping[str, Array],
    courses: Mapping[str, Array],
    bounds: Mapping[str, Array],
) -> Panel:
    if len(courses) > 1 and _all_same([*courses.values()]):
        label, values = next(iter(courses.items()))
        curves = [Curve("the same for all", times[label], values, 0)]
    else:
        curves = [
            Curve(label, times[label], values, colour)
            for colour, (label, values) in enumerate(courses.items(), start=1)
        ]
    least = min(float(v.min()) for v in courses.values())
    most = max(float(v.max()) for v in courses.values())
    reach = _FAR * ((most - least) or max(abs(most), 1.0))
    drawn: list[Array] = []
    for colour, (label, pair) in enumerate(bounds.items(), start=1):
        for limit in pair:
            # A bound that all share is drawn once, in the colour of none.
            shared = all(any(_all_same([limit, p]) for p in other) for other in bounds.values())
            known = any(len(d) == len(limit) and np.allclose(d, limit) for d in drawn)
            finite = np.isfinite(limit).all()
            if known or not finite or limit.max() > most + reach or limit.min() < least - reach:
                continue
            drawn.append(limit)
            paint = 0 if shared else colour
            # In the colour of its solution it needs no entry of its own in the legend.
            title = "bounds" if shared else label
            curves.append(Curve(title, times[label], limit, paint, "dashed"))
    title = f"{name} ({unit})" if unit else name
    return Panel(title, _TIME, "", tuple(curves), y_range=_around(least, most))


def _around(least: float, most: float) -> tuple[float, float] | None:
    """A range for what hardly varies, lest its axis magnify the solver's tolerance; else None."""
    size = max(abs(least), abs(most))
    if size == 0 or most - least > _STILL * size:
        return None
    return least - _MARGIN * size, most + _MARGIN * size


def _all_same(values: Sequence[Array]) -> bool:
    return all(len(v) == len(values[0]) and np.allclose(v, values[0]) for v in values[1:])

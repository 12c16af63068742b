"""One row per signal, one dot per figure, lines where the figures are judged: a first look."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dfsm.report.article import Curve, Figure, Panel


def dots(
    key: str,
    caption: str,
    title: str,
    names: Sequence[str],
    figures: Mapping[str, Sequence[float | None]],
    limits: Mapping[str, tuple[float, int]],
) -> Figure:
    """Draw figures of several signals side by side.

    Parameters
    ----------
    key, caption
        See `Figure`.
    title
        Of the axis along which figures are read, with its unit.
    names
        Of the rows, from above.
    figures
        By the name of their dots, in the order of the rows; None draws none.
    limits
        By the name of their lines: where they stand, and their colour.
    """
    places = len(names) - 1.0 - np.arange(len(names))
    ends = np.array([-0.5, len(names) - 0.5])
    curves = [
        Curve(name, np.full(2, at), ends, colour, "dashed") for name, (at, colour) in limits.items()
    ]
    far = max(1.0, *(1.1 * at for at, _ in limits.values()))
    for colour, (name, values) in enumerate(figures.items(), start=1):
        x = np.array([np.nan if v is None else v for v in values], dtype=float)
        known = np.isfinite(x)
        if known.any():
            curves.append(Curve(name, x[known], places[known], colour, "points"))
            far = max(far, 1.1 * float(x[known].max()))
    ticks = tuple((float(p), n) for p, n in zip(places, names, strict=True))
    panel = Panel("", title, "", tuple(curves), ticks=ticks, x_range=(0.0, far))
    return Figure(key, caption, (panel,))

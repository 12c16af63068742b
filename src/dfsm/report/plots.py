"""Figures of results, by the library that a user names; `core.drawing` calls this."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

from dfsm.core.drawing import Engine
from dfsm.errors import DfsmError
from dfsm.report.plotly_figures import plotly_figure
from dfsm.report.print_figures import sheet_of
from dfsm.report.result_figures import figure_of


def draw(result: object, channels: Sequence[str] | None, engine: Engine, **which: Any) -> Any:
    """Return a figure of a result.

    Parameters
    ----------
    result
        One of those with a method `plot`.
    channels
        Names to draw; None leaves the choice to the kind of result.
    engine
        "plotly" or "matplotlib".
    **which
        Which part of it, as in its method `plot`.

    Raises
    ------
    DfsmError
        There is no such channel, run or engine, or Matplotlib is not installed.
    """
    if engine not in get_args(Engine):
        raise DfsmError(
            f"engine is '{engine}', expected one of {', '.join(map(repr, get_args(Engine)))}"
        )
    figure = figure_of(result, channels, **which)
    return plotly_figure(figure) if engine == "plotly" else sheet_of(figure)

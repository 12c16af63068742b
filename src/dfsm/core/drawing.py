"""How results draw themselves: a hook, so that no floor below the report needs to know Plotly.

Results of every floor inherit `plot` and `_repr_html_` from here. What these draw, and with which
library, is for `dfsm.report` to say; it is loaded, by its name, when something is first drawn.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, Literal

Engine = Literal["plotly", "matplotlib"]

# Where results are drawn, and where they are told, as `dfsm` itself names what it has.
_PLOTS, _NOTEBOOK = "dfsm.report.plots", "dfsm.report.notebook"


def draw(result: object, channels: Sequence[str] | None, engine: Engine, **which: Any) -> Any:
    """Return a figure of a result; `which` says which part of it."""
    return importlib.import_module(_PLOTS).draw(result, channels, engine, **which)


class Shown:
    """What a notebook shows of a result: a sentence, a table, sizes."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return importlib.import_module(_NOTEBOOK).html_of(self)


class Drawn(Shown):
    """A result with a figure."""

    __slots__ = ()

    def plot(self, channels: Sequence[str] | None = None, *, engine: Engine = "plotly") -> Any:
        """Draw it.

        Parameters
        ----------
        channels
            Names to draw, in this order; None takes what a reader asks for first.
        engine
            "plotly" for the screen, "matplotlib" for print (needs ``dfsm[figures]``).

        Returns
        -------
        plotly.graph_objects.Figure or matplotlib.figure.Figure
            To show, change or save.

        Raises
        ------
        DfsmError
            There is no such channel or engine, or Matplotlib is not installed.
        """
        return draw(self, channels, engine)


class DrawnByRun(Drawn):
    """A result over several runs with a figure of one of them."""

    __slots__ = ()

    def plot(
        self,
        channels: Sequence[str] | None = None,
        *,
        run: int | str = 0,
        engine: Engine = "plotly",
    ) -> Any:
        """Draw one run: as recorded or as it was before, and what became of it.

        Parameters
        ----------
        channels
            Names to draw, in this order; None takes what a reader asks for first.
        run
            Which run, by its index or name.
        engine
            "plotly" for the screen, "matplotlib" for print (needs ``dfsm[figures]``).

        Returns
        -------
        plotly.graph_objects.Figure or matplotlib.figure.Figure
            To show, change or save.

        Raises
        ------
        DfsmError
            There is no such channel, run or engine, or Matplotlib is not installed.
        """
        return draw(self, channels, engine, run=run)

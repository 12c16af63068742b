"""What every rollout can do, with a controller or without: be drawn beside a record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dfsm.core.drawing import Drawn, Engine, draw
from dfsm.data.trajectory import Trajectory


class DrawnRun(Drawn):
    """A simulated run, which can be drawn beside a recorded one."""

    __slots__ = ()

    def plot(
        self,
        channels: Sequence[str] | None = None,
        *,
        recorded: Trajectory | None = None,
        engine: Engine = "plotly",
    ) -> Any:
        """Draw it.

        Parameters
        ----------
        channels
            Names to draw, in this order; None takes the first of the run.
        recorded
            A run to draw below it, where it holds the same channels.
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
        return draw(self, channels, engine, recorded=recorded)

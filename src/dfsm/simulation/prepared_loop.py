"""Closed loops over prepared runs as one pure function of the controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.controller import Controller
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM
from dfsm.simulation.loop import Drive, Path, roll
from dfsm.simulation.loop_cases import ClosedLoopSettings, checked_loops, padded, prepared_cases
from dfsm.simulation.wires import Wires, connect


class ClosedLoop(eqx.Module):
    """Closed loops over some runs as a pure function of the controller: `prepare_loop` makes it.

    Attributes
    ----------
    model
        The surrogate.
    drives
        Starts and inputs of all runs, padded to one length, with a leading axis ``(run, ...)``.
    scored
        Weight of every plant step's end in means over time: 1 after the start-up and within the
        run, else 0, ``(run, step + 1)``.
    wires
        How controllers are connected.
    """

    model: DFSM
    drives: Drive
    scored: jax.Array
    wires: Wires = eqx.field(static=True)

    def __call__(self, controller: Any) -> Path:
        """Close the loop over all runs; JAX can follow it, in the controller's numbers too.

        Parameters
        ----------
        controller
            An equinox module with the channels and interval that the loop was prepared for.

        Returns
        -------
        Path
            With a leading axis ``(run, ...)``.
        """
        model = self.model.prepared()
        return jax.vmap(lambda drive: roll(model, self.wires, controller, drive))(self.drives)

    def mean(self, values: jax.Array) -> jax.Array:
        """Mean over the scored time of ``(run, step + 1)``, per run."""
        return (values * self.scored).sum(axis=-1) / self.scored.sum(axis=-1)


def prepare_loop(
    model: DFSM,
    runs: Sequence[Trajectory],
    controller: Controller,
    *,
    start: float | None = None,
    stop: float | None = None,
    measurements: Mapping[str, str] | None = None,
    settings: ClosedLoopSettings | None = None,
) -> ClosedLoop:
    """Closed loops as a pure function of the controller, to differentiate and to map over gains.

    Parameters
    ----------
    model, runs, controller, start, stop, measurements, settings
        As for `closed_loop`; of the controller only channels, units and interval matter.

    Returns
    -------
    ClosedLoop

    Raises
    ------
    DfsmError
        As `closed_loop`; or the runs differ in their sampling.
    """
    runs = checked_loops(model, runs, [controller], measurements, settings)
    settings = settings or ClosedLoopSettings()
    wires = connect(model, controller, measurements)
    cases = prepared_cases(model, runs, controller.interval, (start, stop), settings)
    if len({c.per_call for c in cases}) > 1:
        raise DfsmError(
            "the runs are sampled at different intervals: resample them, or set a step that is "
            "shorter than all of these"
        )
    calls = max(len(c.drive.time) for c in cases) + 1
    drives = [padded(c, calls) for c in cases]
    scored = np.zeros((len(cases), calls * cases[0].per_call + 1))
    for i, c in enumerate(cases):
        begins = c.run.time[c.scored] - c.run.time[0]
        first = round(begins / float(c.drive.h[0]))
        scored[i, first : c.rows] = 1.0
    stacked = jax.tree.map(lambda *parts: jnp.stack(parts), *drives)
    return ClosedLoop(model, stacked, jnp.asarray(scored), wires)

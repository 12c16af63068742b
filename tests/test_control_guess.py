"""Where a solve on a surrogate starts when no guess is made."""

from __future__ import annotations

import numpy as np
import pytest

import fits
from dfsm.control import OptimalControlProblem
from dfsm.control.guess import start_of
from dfsm.data.trajectory import Channel, Trajectory

TAU = np.linspace(0.0, 1.0, 5)


@pytest.mark.parametrize("which", [1, 3])
def test_a_scheduled_surrogate_starts_from_what_its_runs_did_in_that_wind(which):
    model = fits.scheduled()
    grid, operating = np.asarray(model.region.grid), np.asarray(model.region.operating)
    time = np.array([0.0, 4.0])
    # A wind that rises and whose mean is that of an operating point.
    wind = Trajectory(time, grid[which] + np.array([[-1.0], [1.0]]), (Channel("w"),))
    free = {"model": model, "horizon": (0.0, 4.0), "cost": lambda s: s.u[0] ** 2}
    start = start_of(OptimalControlProblem(**free, disturbances=wind), None, TAU)
    columns = [model.signals.order.names.index(n) for n in model.signals.names("controls")]
    np.testing.assert_allclose(start.U[0], np.tile(operating[which, columns], (5, 1)))
    np.testing.assert_allclose(
        start.X[0], np.tile(operating[which, model.signals.state_columns], (5, 1))
    )
    # Bounds that hold it hold the guess; it is not moved to their middle.
    name = model.signals.states[0].name
    usual = operating[which, model.signals.state_columns][0]
    bounds = {name: (usual - 1.0, usual + 9.0)}
    bounded = start_of(OptimalControlProblem(**free, disturbances=wind, bounds=bounds), None, TAU)
    np.testing.assert_allclose(bounded.X[0, :, 0], usual)

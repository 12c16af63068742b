"""How far a model is from a system whose equations are known: along runs, and in rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import hushed
from dfsm.models.dfsm import DFSM
from dfsm.simulation.simulate import Status, simulate
from dfsm.simulators import ODESystem


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Simulations of one model from the recorded initial states, with the recorded inputs.

    Attributes
    ----------
    time
        In s, shape ``(time,)``.
    errors
        Simulated minus recorded states, shape ``(run, time, state)``; NaN from where a rollout
        ended early.
    outside
        Share of the time outside the training range, shape ``(run,)``.
    """

    time: Array
    errors: Array
    outside: Array

    @property
    def completed(self) -> int:
        """Number of rollouts that reached the end."""
        return int(np.isfinite(self.errors).all(axis=(1, 2)).sum())

    @property
    def rmse(self) -> Array:
        """Over all runs and times, shape ``(state,)``; NaN if a rollout ended early."""
        return np.sqrt(np.mean(self.errors**2, axis=(0, 1)))

    @property
    def of_runs(self) -> Array:
        """RMSE of every run, shape ``(run, state)``; NaN for one that ended early."""
        return np.sqrt(np.mean(self.errors**2, axis=1))

    @property
    def typical(self) -> Array:
        """RMSE of the median run, shape ``(state,)``; one that ended early counts as worst."""
        worst_last = np.where(np.isnan(self.of_runs), np.inf, self.of_runs)
        return np.median(worst_last, axis=0)

    @property
    def growth(self) -> Array:
        """RMS over the runs at each time, shape ``(time, state)``; NaN once a rollout has ended."""
        return np.sqrt(np.mean(self.errors**2, axis=0))


@dataclass(frozen=True, eq=False)
class Assessed:
    """A model, what it cost to build, and its errors on test runs.

    Attributes
    ----------
    model
        The surrogate.
    seconds
        Wall time of the steps that only this model needs.
    slopes
        RMSE of its derivative against the true one along the test runs, shape ``(state,)``.
    rollouts
        On the test runs.
    """

    model: DFSM
    seconds: float
    slopes: Array
    rollouts: Rollouts


def assess(model: DFSM, seconds: float, system: ODESystem, tests: Sequence[Trajectory]) -> Assessed:
    """Compare a model with the system that made the test runs.

    Parameters
    ----------
    model
        Its states are the system's, in the system's order.
    seconds
        What it cost to build.
    system
        Knows the true derivatives.
    tests
        Runs of one length.

    Returns
    -------
    Assessed
    """
    errors = [slope(model, run) - system.derivative(run) for run in tests]
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    return Assessed(model, seconds, rms, roll(model, tests))


def slope(model: DFSM, run: Trajectory) -> Array:
    """f̂ along the states and inputs of a run, shape ``(time, state)``."""
    inputs = run.select([c.name for c in model.signals.inputs]).values
    return np.asarray(model.derivative(*model.split(inputs)))


def states(model: DFSM, run: Trajectory) -> Array:
    """Recorded states, shape ``(time, state)``."""
    return run.select(model.signals.names("states")).values


def roll(model: DFSM, runs: Sequence[Trajectory]) -> Rollouts:
    """Simulate a model with the inputs of runs of one length and compare the states."""
    recorded = np.stack([states(model, run) for run in runs])
    with hushed():
        simulations = simulate(model, runs, initial=recorded[:, 0])
    errors = np.full(recorded.shape, np.nan)
    for k, simulation in enumerate(simulations):
        simulated = states(model, simulation.trajectory)
        # The last sample of a rollout that ended early shows where it went; it is no error.
        count = len(simulated) - (simulation.status is not Status.COMPLETED)
        errors[k, :count] = simulated[:count] - recorded[k, :count]
    return Rollouts(runs[0].time, errors, np.array([s.outside for s in simulations]))

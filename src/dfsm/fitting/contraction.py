"""Whether rollouts from different initial states come together along recorded schedule paths.

Eigenvalues of A judge stability with the schedule frozen. Where the schedule moves as fast as the
states do, that is neither sufficient nor necessary: matrices that are stable one by one may, taken
in turns, make a system grow (Khalil 2002, Nonlinear Systems, Sec. 4.6). What counts is what a model
does along the paths that schedules take. Under the same inputs the difference of two rollouts of a
linear model follows δ̇ = A(w(t)) δ. Rollouts from initial states one training standard deviation
apart, state by state, thus make the columns of its transition matrix in standardised units, whose
largest singular value belongs to the worst pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import hushed
from dfsm.models.dfsm import DFSM
from dfsm.simulation.simulate import Simulation, Status, simulate

# By the slowest eigenvalue a distance must have shrunk to this share, so that one that has grown
# instead is worth a warning: over a short run, or with a slow mode, it may grow before it shrinks.
_SHRUNK = 0.1


@dataclass(frozen=True)
class Contraction:
    """What becomes of the distance between rollouts of one run from different initial states.

    Attributes
    ----------
    run
        Name of the run.
    seconds
        Its length.
    distance
        The worst distance at the end relative to that at the start; infinite where a rollout left
        the training range by far.
    frozen
        What the slowest mode would make of it with the schedule frozen, exp(Re λ T).
    """

    run: str
    seconds: float
    distance: float
    frozen: float

    @property
    def account(self) -> str:
        """The outcome in words."""
        pair = f"two initial states of run {self.run}"
        path = f"within {self.seconds:.4g} s along the recorded inputs"
        if not np.isfinite(self.distance):
            return f"{pair} part, until one leaves the training range, {path}"
        share = "less than 0.01 %" if self.distance < 1e-4 else f"{100 * self.distance:.3g} %"
        verb = "come together" if self.distance < 1 else "part"
        return f"{pair} {verb} to {share} of their distance {path}"

    @property
    def unexpected(self) -> bool:
        """Whether the distance grows although every frozen A makes it vanish in that time."""
        return self.distance >= 1 and self.frozen <= _SHRUNK


def contraction(
    model: DFSM,
    runs: Sequence[Trajectory],
    rollouts: Sequence[Simulation],
    start: float | None,
    stop: float | None,
) -> Contraction | None:
    """Follow pairs of rollouts along some runs.

    Parameters
    ----------
    model
        With or without corrective functions. Its latent pairs follow from inputs alone and are
        the same in both rollouts of a pair.
    runs
        Training runs.
    rollouts
        The model's own of these, from the recorded states.
    start, stop
        Time window in s.

    Returns
    -------
    Contraction or None
        Of the run in which states come together least; None where no rollout completed, or none of
        them is measured.
    """
    s = model.signals
    names = s.names("observed")
    spread = np.asarray(model.region.scale)[s.observed_columns]
    pairs = [
        (run, rollout.trajectory.select(names).values)
        for run, rollout in zip(runs, rollouts, strict=True)
        if rollout.status is Status.COMPLETED
    ]
    if not pairs or not names:
        return None
    with hushed():
        shifted = simulate(
            model,
            [run for run, _ in pairs for _ in names],
            start=start,
            stop=stop,
            initial=np.concatenate([path[0] + np.diag(spread) for _, path in pairs]),
        )
    fastest = max(float(values.real.max()) for _, values in model.eigenvalues())
    outcomes = []
    for k, (run, path) in enumerate(pairs):
        group = shifted[k * len(names) : (k + 1) * len(names)]
        seconds = run.window(start, stop).duration
        distance = _distance(path[-1], group, names, spread)
        outcomes.append(Contraction(run.name, seconds, distance, float(np.exp(fastest * seconds))))
    return max(outcomes, key=lambda outcome: outcome.distance)


def _distance(
    end: Array, group: Sequence[Simulation], names: Sequence[str], spread: Array
) -> float:
    """Largest singular value of the differences at the end, in standard deviations."""
    if any(other.status is not Status.COMPLETED for other in group):
        return np.inf
    ends = np.array([other.trajectory.select(names).values[-1] for other in group])
    return float(np.linalg.norm((ends - end) / spread, 2))

"""The adaptive loop where the truth is known: an arm turned with the least effort (Luus 2019).

    minimise ∫ u1² + u2² dt,  |u| ≤ 1,  from (ω1, ω2, θ2, θ1) = (0, 0, 0.5, 0) to (0, 0, 0.5, 0.522)

in 3 s, which is hardly more than the least time of 2.98 s: the torques are at their bounds for much
of it, and ending 0.001 beside the target is worth about a per cent of the cost. Its least value is
5.2337355.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.control import DirectTranscription, OptimalControlProblem, Solution, solve
from dfsm.core.settings import settings_class
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Trajectory
from dfsm.errors import hushed
from dfsm.fitting.corrective import CorrectiveSettings
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.loops.adaptive import AdaptiveResult, AdaptiveSettings, optimize_adaptively
from dfsm.models.dfsm import DFSM
from dfsm.simulators import ODESystem, two_link_robot
from dfsm.simulators.excitation import RandomKnots, Uniform

ROBOT = two_link_robot()
STATES = tuple(c.name for c in ROBOT.states)
START, END = (0.0, 0.0, 0.5, 0.0), (0.0, 0.0, 0.5, 0.522)
DURATION = 3.0  # s
TIME = np.linspace(0, DURATION, 301)
METHOD = DirectTranscription(mesh=30)


@settings_class
class AdaptiveRobotSettings:
    """How much to compute.

    Attributes
    ----------
    runs
        Training runs to begin with.
    corrective
        Kind of corrective function.
    settings
        When to stop.
    """

    runs: int = 10
    corrective: CorrectiveSettings = GP(samples=300)
    settings: AdaptiveSettings = AdaptiveSettings(most_rounds=15, method=METHOD)


@dataclass(frozen=True, eq=False)
class AdaptiveStudy:
    """Results of the study.

    Attributes
    ----------
    result
        Of the loop.
    truth
        Optimum on the arm's equations.
    training_runs
        Runs the loop began with.
    """

    result: AdaptiveResult
    truth: Solution
    training_runs: int

    @property
    def cost_error(self) -> float:
        """Relative error of the predicted cost of the best round."""
        true = self.truth.objective
        return abs(self.result.solution.objective - true) / true


def study(size: AdaptiveRobotSettings | None = None, seed: int = 0) -> AdaptiveStudy:
    """Run the loop from a few random runs, and solve on the arm's equations.

    Parameters
    ----------
    size
        How much to compute; None makes the full study.
    seed
        Seed of everything random.

    Returns
    -------
    AdaptiveStudy
    """
    size = size or AdaptiveRobotSettings()
    runs = training_runs(size.runs, seed)

    def fitted(known: Sequence[Trajectory]) -> DFSM:
        return surrogate(known, size.corrective)

    result = optimize_adaptively(runs, fitted, problem, simulated, size.settings)
    return AdaptiveStudy(result, solve(problem(ROBOT), METHOD), len(runs))


def training_runs(count: int, seed: int) -> list[Trajectory]:
    """Three seconds each, under random torques from around where the motion is expected."""
    return ROBOT.campaign(
        count,
        TIME,
        Uniform(low=(-0.5, -0.5, 0.3, -0.3), high=(0.5, 0.5, 1.5, 0.5)),
        RandomKnots(low=(-0.9, -0.9), high=(0.9, 0.9), spacing=0.3),
        seed=seed,
    )


def surrogate(runs: Sequence[Trajectory], corrective: CorrectiveSettings) -> DFSM:
    """Fit the arm."""
    with hushed():
        return fit(
            runs,
            FitSettings(
                states=tuple(StateSpec(name=n) for n in STATES),
                controls=("tau1", "tau2"),
                corrective=corrective,
                nonlinear_only=False,
            ),
        ).model


def problem(model: DFSM | ODESystem) -> OptimalControlProblem:
    """Turn the arm with the least effort."""
    return OptimalControlProblem(
        model=model,
        horizon=(0.0, DURATION),
        initial=dict(zip(STATES, START, strict=True)),
        final=dict(zip(STATES, END, strict=True)),
        bounds={"tau1": (-1.0, 1.0), "tau2": (-1.0, 1.0)},
        cost=lambda s: s.u.tau1**2 + s.u.tau2**2,
        name="two-link robot, least effort",
    )


def simulated(solution: Solution) -> Trajectory:
    """The true arm under optimal torques, which never leave their bounds between the nodes."""
    controls = tuple(c for c in solution.trajectory.channels if c.role == "control")
    values = np.clip(solution.at(TIME / DURATION)[1], -1.0, 1.0)
    return ROBOT.simulate(TIME, START, Trajectory(TIME, values, controls), name="optimum")

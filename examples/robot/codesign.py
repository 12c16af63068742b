"""Co-design where the truth is known: the mass of a link and the torques that move it.

The paper's arm in a vertical plane is lifted by `MOVE` in half a second, which is before chaos sets
in. A heavier link costs torque, a lighter one bends more (its deflection goes as 1/m2), so that the
best mass lies inside its bounds:

    minimise ∫ 10⁻³ (τ1² + τ2²) dt + STIFFNESS / m2    over τ(t) and m2

once on a surrogate with m2 as a parameter, once on the arm's own equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dfsm.control import DirectTranscription, End, OptimalControlProblem, Signals, Solution, solve
from dfsm.control.solve import optimum
from dfsm.core.settings import settings_class
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Trajectory
from dfsm.errors import hushed
from dfsm.fitting.corrective import CorrectiveSettings
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.fit import fit
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from dfsm.simulators import ODESystem, two_link_robot_with_gravity
from dfsm.simulators.excitation import RandomKnots, Uniform
from dfsm.simulators.two_link_robot import holding_torques

ARM = two_link_robot_with_gravity(vary_mass=True)
MASSES = (2.0, 3.0)  # kg
DURATION = 0.5  # s
# The middle of the motion, its extent, and how far around it the training runs start.
MIDDLE = np.array([0.7854, 0.0, -0.5236, 0.0])
MOVE = np.array([0.1, 0.0, 0.1, 0.0])
AROUND = np.array([0.15, 0.7, 0.3, 1.5])
PUSH = np.array([16.0, 12.0])  # N m, around what holds the arm with the middle mass
STIFFNESS = 1.5  # kg
METHOD = DirectTranscription(mesh=20)


@settings_class
class CodesignSettings:
    """How much to compute.

    Attributes
    ----------
    runs
        Training runs of 0.5 s with each of the masses.
    masses
        Number of masses to train on, evenly spaced between the bounds.
    corrective
        Kind of corrective function.
    """

    runs: int = 20
    masses: int = 5
    corrective: CorrectiveSettings = MLP()


@dataclass(frozen=True, eq=False)
class Codesign:
    """Results of the study.

    Attributes
    ----------
    surrogate, truth
        Optimum on the surrogate and on the arm's equations.
    split
        Cost on the arm's equations by mass, the torques optimized for each: the paper's co-design
        done one after the other.
    realised
        Least cost on the arm's equations with the mass that is best on the surrogate.
    miss
        Largest distance of the arm from where it should end, under the surrogate's optimal torques
        and with its mass: angles in rad, rates in rad/s.
    training_runs
        Number of simulations the surrogate has seen.
    """

    surrogate: Solution
    truth: Solution
    split: dict[float, float]
    realised: float
    miss: dict[str, float]
    training_runs: int

    @property
    def mass_error(self) -> float:
        """Relative error of the best mass."""
        true = self.truth.parameters["m2"]
        return abs(self.surrogate.parameters["m2"] - true) / true

    @property
    def cost_error(self) -> float:
        """Relative error of the predicted cost."""
        return abs(self.surrogate.objective - self.truth.objective) / self.truth.objective

    @property
    def loss(self) -> float:
        """What the surrogate's mass costs more than the best one, relative."""
        return (self.realised - self.truth.objective) / self.truth.objective


def study(settings: CodesignSettings | None = None, seed: int = 0) -> Codesign:
    """Optimize mass and torques on a surrogate and on the arm's equations.

    Parameters
    ----------
    settings
        How much to compute; None makes the full study.
    seed
        Seed of everything random.

    Returns
    -------
    Codesign
    """
    settings = settings or CodesignSettings()
    runs = training_runs(settings, seed)
    # What its departures cost is measured below, on the arm itself.
    solution = optimum(problem(surrogate(runs, settings.corrective)), METHOD)
    truth = solve(problem(ARM), METHOD)
    best = solution.parameters["m2"]
    split = {mass: _cost(mass) for mass in np.linspace(*MASSES, 5).tolist()}
    return Codesign(solution, truth, split, _cost(best), _miss(solution), len(runs))


def _cost(mass: float) -> float:
    return solve(problem(ARM, mass), METHOD, simulate=False).objective


# Functions of the module, so that problems on one arm share compilations.
def _effort(s: Signals) -> Any:
    return 1e-3 * (s.u.tau1**2 + s.u.tau2**2)


def _compliance(_start: End, end: End) -> Any:
    return STIFFNESS / end.p.m2


def problem(
    model: DFSM | ODESystem, mass: float | tuple[float, float] = MASSES
) -> OptimalControlProblem:
    """Lift the arm with little torque and a mass that is fixed or free."""
    # A fit calls the rate of an angle after the angle.
    rate = "dot" if isinstance(model, DFSM) else "rate"
    names = [str(n) for n in ("theta1", f"theta1_{rate}", "theta2", f"theta2_{rate}")]
    start, end = (dict(zip(names, MIDDLE + s * MOVE / 2, strict=True)) for s in (-1, 1))
    return OptimalControlProblem(
        model=model,
        horizon=(0.0, DURATION),
        initial=start,
        final=end,
        cost=_effort,
        final_cost=_compliance,
        parameters={"m2": mass},
        name="arm with a free mass",
    )


def training_runs(settings: CodesignSettings, seed: int) -> list[Trajectory]:
    """Half a second each, with every mass in turn, from random states under random torques."""
    hold = holding_torques(ARM, MIDDLE, [sum(MASSES) / 2])
    return ARM.campaign(
        settings.runs * settings.masses,
        np.linspace(0, DURATION, 51),
        Uniform(low=tuple(MIDDLE - AROUND), high=tuple(MIDDLE + AROUND)),
        RandomKnots(low=tuple(hold - PUSH), high=tuple(hold + PUSH), spacing=0.05),
        parameters=np.linspace(*MASSES, settings.masses)[:, None],
        seed=seed,
    )


def surrogate(runs: Sequence[Trajectory], corrective: CorrectiveSettings) -> DFSM:
    """Fit the arm with its mass as a parameter."""
    angles = ("theta1", "theta2")
    with hushed():
        return fit(
            runs,
            FitSettings(
                states=tuple(StateSpec(name=a, order=2, rate=f"{a}_rate") for a in angles),
                controls=("tau1", "tau2"),
                parameters=("m2",),
                corrective=corrective,
                nonlinear_only=False,
            ),
        ).model


def _miss(solution: Solution) -> dict[str, float]:
    """Where the arm ends under the surrogate's torques and with its mass, from where it should."""
    tau = np.linspace(0, 1, 201)
    controls = tuple(c for c in solution.trajectory.channels if c.role == "control")
    torque = Trajectory(DURATION * tau, solution.at(tau)[1], controls)
    run = ARM.simulate(
        torque.time, MIDDLE - MOVE / 2, torque, parameters=[solution.parameters["m2"]]
    )
    ends = run.select(c.name for c in ARM.states).values[-1]
    return {
        c.name: float(abs(end - wanted))
        for c, end, wanted in zip(ARM.states, ends, MIDDLE + MOVE / 2, strict=True)
    }

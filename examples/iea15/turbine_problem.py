"""The paper's optimal control problem of a floating 15 MW turbine (Sec. 4).

    minimise ∫ ( −η τ ω + w₁ τ² + w₂ β² ) dt     τ in MN m, ω in rpm, β in deg

over torque and blade pitch, with the wind known over the horizon, and with one of two sets of
bounds: the paper's, on a model of the wind region alone, and those of the turbine that was
simulated, on one model for all winds, inside its training data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from dfsm.control import OptimalControlProblem
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM

# Channels of the turbine, in OpenFAST's words and units: kN m, deg, deg, rpm, m/s, kN, kN m.
TORQUE, BLADE, PITCH, SPEED, WIND = "GenTq", "BldPitch1", "PtfmPitch", "GenSpeed", "RotWind"
SHEAR, MOMENT = "TwrBsFxt", "TwrBsMyt"
# Rotor radius in m, air density in kg/m³ and best power coefficient in steady wind of the IEA 15 MW
# turbine (Gaertner et al. 2020).
RADIUS, DENSITY, BEST_COEFFICIENT = 120.0, 1.225, 0.489
MEGAWATT = np.pi / 30e3  # of kN m × rpm
_TORQUE_WEIGHT, _BLADE_WEIGHT = 1e-5, 0.5
_PERCENTILE = 99.9  # of the loads in the training runs, in case (b)

Limits = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Case:
    """Bounds and generator efficiency.

    Attributes
    ----------
    key, title
        Short name, and what it is.
    efficiency
        η, of mechanical into electrical power.
    lowest_pitch
        Lower bound of the platform pitch in deg; the upper one is varied.
    bounds
        Of all other channels, in their units.
    inside
        Whether states and controls stay where the training data lie.
    """

    key: str
    title: str
    efficiency: float
    lowest_pitch: float
    bounds: Limits
    inside: bool = False

    @property
    def cost(self) -> Callable[..., Any]:
        """Integrand; the same function for the same efficiency, so that it is compiled once."""
        return _cost(self.efficiency)


@cache
def _cost(efficiency: float) -> Callable[..., Any]:
    def cost(s: Any) -> Any:
        torque = s.u[TORQUE] / 1e3
        power = efficiency * torque * s.x[SPEED]
        return -power + _TORQUE_WEIGHT * torque**2 + _BLADE_WEIGHT * s.u[BLADE] ** 2

    return cost


CONTROL_BOUNDS: Limits = {TORQUE: (1670.0, 19900.0), BLADE: (0.0, 22.6)}
PAPER = Case(
    "a",
    "the paper's bounds",
    0.99,
    0.0,
    {**CONTROL_BOUNDS, SPEED: (1.9, 7.2), SHEAR: (0.0, 5e3), MOMENT: (0.0, 4e5)},
)


@dataclass(frozen=True, eq=False)
class Region:
    """A range of wind speeds with its models and its runs.

    Attributes
    ----------
    name
        For tables, e.g. ``"12 m/s"``.
    wind
        Mean wind in m/s.
    own
        Model fitted to `training`, for case (a).
    model
        Model for case (b), which knows more winds.
    training, tests
        Runs; the winds of the latter are what controls are optimized for.
    start
        Where the horizons begin, in s; the start-up transients before it do not count.
    """

    name: str
    wind: float
    own: DFSM
    model: DFSM
    training: Sequence[Trajectory]
    tests: Sequence[Trajectory]
    start: float

    @cached_property
    def best_coefficient(self) -> float:
        """The best power coefficient that is known of this turbine, of the disk's mean wind.

        In steady wind, or of a training run, which takes more where there is turbulence within the
        disk.
        """
        runs = [run.window(self.start) for run in self.training]
        return max([BEST_COEFFICIENT, *(mean_power(r) / wind_power(r) for r in runs)])


def turbine_case(region: Region) -> Case:
    """Bounds for the turbine that was simulated: rated speed, and loads as in its own runs.

    Without being kept inside the training data, an optimizer in 18 m/s takes the rotor into stall,
    where no run has been.
    """
    runs = [run.window(region.start) for run in region.training]
    loads = {
        name: float(np.percentile(np.abs(np.concatenate([r[name] for r in runs])), _PERCENTILE))
        for name in (SHEAR, MOMENT)
    }
    bounds = {**CONTROL_BOUNDS, SPEED: (1.9, 7.56)} | {n: (-v, v) for n, v in loads.items()}
    return Case("b", "bounds of this turbine", 0.9576, -1.0, bounds, inside=True)


def mean(run: Trajectory, values: Array) -> float:
    """Mean over time of values at a run's samples, by the trapezoidal rule."""
    return float(np.trapezoid(values, run.time) / run.duration)


def mean_power(run: Trajectory) -> float:
    """Mean mechanical power in MW: torque times speed in rad/s."""
    return mean(run, run[TORQUE] * run[SPEED]) * MEGAWATT


def wind_power(run: Trajectory) -> float:
    """Mean power in MW of the disk's mean wind: of ρ/2 π R² w³."""
    return DENSITY / 2 * np.pi * RADIUS**2 * mean(run, run[WIND] ** 3) / 1e6


def problem(
    model: DFSM,
    wind: Trajectory,
    case: Case,
    most_pitch: float,
    horizon: tuple[float, float],
) -> OptimalControlProblem:
    """The paper's problem for one wind series.

    Parameters
    ----------
    model
        With the channels of this study.
    wind
        Run with the disturbances; what it holds before the horizon gives latent states.
    case
        Bounds and efficiency.
    most_pitch
        Θ_p,max in deg.
    horizon
        First and last time in s.

    Raises
    ------
    DfsmError
        The model lacks one of the study's channels, or the run is too short.
    """
    known = {
        c.name: c for g in ("states", "controls", "outputs") for c in getattr(model.signals, g)
    }
    for name in (TORQUE, BLADE, PITCH, SPEED, SHEAR, MOMENT):
        if name not in known:
            raise DfsmError(
                f"the model has no channel '{name}', which the turbine's problem needs: fit one "
                f"with states {PITCH} and {SPEED}, controls {TORQUE} and {BLADE}, and outputs "
                f"{SHEAR} and {MOMENT}"
            )
    return OptimalControlProblem(
        model=model,
        horizon=horizon,
        cost=case.cost,
        bounds={**case.bounds, PITCH: (case.lowest_pitch, most_pitch)},
        disturbances=wind,
        name=f"{wind.name}, case {case.key}, pitch up to {most_pitch:g} deg",
    )

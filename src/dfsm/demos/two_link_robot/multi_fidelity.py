"""Multi-fidelity against nonlinear-only, with the paper's recipe: Sec. 3.8.2, Figs. 4 to 6.

The recipe: k-means, each cluster's mean input with its mean residual, Gaussian units of one width
in all standardised inputs. Most of it is done on the arm without gravity, whose motion can be
predicted for seconds. The paper's arm is a double pendulum: over its 5 s neighbouring states part
exponentially, so there derivatives and short rollouts say more than long ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dfsm.core.progress import track
from dfsm.core.settings import settings_class
from dfsm.core.types import Array
from dfsm.data.derivatives import DerivativeSettings, StateSpec
from dfsm.data.trajectory import Trajectory
from dfsm.demos.two_link_robot.assess import Assessed, Rollouts, assess, roll, slope, states
from dfsm.demos.two_link_robot.extraction import DELTA, STATES
from dfsm.errors import hushed
from dfsm.fitting.corrective import CorrectiveSettings
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import FitResult, fit
from dfsm.fitting.settings import FitSettings
from dfsm.simulators import ODESystem, two_link_robot, two_link_robot_with_gravity
from dfsm.simulators.excitation import RandomKnots, Uniform

LINEAR, MULTI, NONLINEAR = "linear-fit", "multi-fidelity", "nonlinear-only"
OWN = "multi-fidelity, RBF by default"
TRAINING_RUNS, TEST_RUNS = 80, 20
_RATE = 300  # samples per s: 900 in 3 s
SPACING = 1 / 30  # s between knots of the torques: 90 in 3 s
_SHORT = 0.5  # s
# One for all n_s, as the spread of MATLAB's newrb: what cross-validation finds for n_s = 500.
_WIDTH = 0.5
_CHANGES: dict[str, dict[str, Any]] = {
    "weights fitted to all samples": {"targets": "all"},
    "a length for every input": {"directions": "per_input"},
    "both": {"targets": "all", "directions": "per_input"},
}


@settings_class
class MultiFidelitySettings:
    """How much to compute.

    Attributes
    ----------
    samples
        n_s of the models that are looked at closely.
    sweep
        n_s of the others.
    gravity
        Also study the arm with gravity.
    """

    samples: int = 500
    sweep: tuple[int, ...] = (100, 200, 500, 1000, 2000)
    gravity: bool = True


@dataclass(frozen=True, eq=False)
class Series:
    """One test run and what the models made of it.

    Attributes
    ----------
    time, controls
        In s, and shape ``(time, control)``.
    derivatives, states
        True, shape ``(time, state)``.
    predicted, simulated
        By model: derivatives along the true states, and rollouts.
    correction
        e along the true states.
    """

    time: Array
    controls: Array
    derivatives: Array
    states: Array
    predicted: dict[str, Array]
    simulated: dict[str, Array]
    correction: Array


@dataclass(frozen=True, eq=False)
class Sweep:
    """The same comparison for several sizes of the subsample.

    Attributes
    ----------
    samples
        n_s.
    assessed
        By model, one per n_s.
    """

    samples: tuple[int, ...]
    assessed: dict[str, tuple[Assessed, ...]]

    @property
    def speed_ups(self) -> Array:
        """Build time of nonlinear-only over that of multi-fidelity, shape ``(n_s,)``."""
        pairs = zip(self.assessed[NONLINEAR], self.assessed[MULTI], strict=True)
        return np.array([n.seconds / m.seconds for n, m in pairs])


@dataclass(frozen=True, eq=False)
class Chaos:
    """The arm with gravity over 5 s.

    Attributes
    ----------
    assessed
        By model, with rollouts over the whole time.
    short
        By model: rollouts of 0.5 s, begun at every half second of the test runs.
    spread
        Standard deviation of the true derivatives and states over the test runs.
    series
        One of them.
    """

    assessed: dict[str, Assessed]
    short: dict[str, Rollouts]
    spread: tuple[Array, Array]
    series: Series


@dataclass(frozen=True, eq=False)
class MultiFidelity:
    """What the paper's Figs. 4 to 6 show, and build times.

    Attributes
    ----------
    assessed
        By model, on the arm without gravity.
    series
        One test run.
    sweep
        Over n_s.
    changed
        Multi-fidelity models of the same size in which a part of the recipe is changed.
    chaos
        The arm with gravity; None where it was left out.
    """

    assessed: dict[str, Assessed]
    series: Series
    sweep: Sweep
    changed: dict[str, Assessed]
    chaos: Chaos | None


def draw(runs: int, duration: float, seed: int) -> list[Trajectory]:
    """Random simulations of the arm without gravity: states in (-1, 1)⁴, torques in (-1, 1)."""
    torques = RandomKnots(low=-1.0, high=1.0, spacing=SPACING)
    time = np.linspace(0.0, duration, round(_RATE * duration))
    return two_link_robot().campaign(runs, time, Uniform(low=-1.0, high=1.0), torques, seed=seed)


def fit_settings(system: ODESystem, corrective: CorrectiveSettings) -> FitSettings:
    """The defaults of `fit` for a system whose states are all recorded."""
    return FitSettings(
        states=tuple(StateSpec(name=c.name) for c in system.states),
        controls=tuple(c.name for c in system.controls),
        corrective=corrective,
        nonlinear_only=False,
    )


def recipe(system: ODESystem, samples: int) -> FitSettings:
    """The paper's way."""
    return replace(
        fit_settings(system, _units(samples)),
        derivatives=DerivativeSettings(method="cubic_spline"),
        nonlinear_only=True,
    )


def _units(samples: int) -> RBF:
    return RBF(samples=samples, width=_WIDTH, targets="cluster_means", directions="equal")


def multi_fidelity(
    train: Sequence[Trajectory],
    tests: Sequence[Trajectory],
    settings: MultiFidelitySettings,
    seed: int,
) -> MultiFidelity:
    """Fit linear, multi-fidelity and nonlinear-only models and simulate all test runs.

    Parameters
    ----------
    train, tests
        Runs of the arm without gravity.
    settings
        How much to compute.
    seed
        Seed of the simulations of the other arm.

    Returns
    -------
    MultiFidelity
    """
    robot = two_link_robot()
    # What JAX compiles in a process that fits for the first time is nobody's build time.
    _fit(train[:4], recipe(robot, min(settings.sweep)))
    assessed = {
        n: _compared(_fit(train, recipe(robot, n)), robot, tests)
        for n in track(sorted({*settings.sweep, settings.samples}), "subsample sizes")
    }
    sweep = Sweep(
        settings.sweep,
        {m: tuple(assessed[n][m] for n in settings.sweep) for m in (LINEAR, MULTI, NONLINEAR)},
    )
    chosen = assessed[settings.samples]
    chaos = _chaos(settings.samples, seed) if settings.gravity else None
    changed = {
        name: _changed(train, robot, tests, replace(_units(settings.samples), **parts))
        for name, parts in _CHANGES.items()
    }
    return MultiFidelity(chosen, _series(chosen, robot, tests, 0), sweep, changed, chaos)


def _fit(train: Sequence[Trajectory], settings: FitSettings) -> FitResult:
    with hushed():
        return fit(train, settings)


def _compared(
    result: FitResult, system: ODESystem, tests: Sequence[Trajectory]
) -> dict[str, Assessed]:
    if result.nonlinear is None:
        raise ValueError("the recipe asks for the nonlinear-only model")
    seconds = result.seconds
    linear = seconds["linear fit"]
    models = (
        (LINEAR, result.model.linear_fit(), linear),
        (MULTI, result.model, linear + seconds["corrective functions"]),
        (NONLINEAR, result.nonlinear, seconds["nonlinear-only"]),
    )
    return {name: assess(model, cost, system, tests) for name, model, cost in models}


def _changed(
    train: Sequence[Trajectory], robot: ODESystem, tests: Sequence[Trajectory], units: RBF
) -> Assessed:
    settings = recipe(robot, units.samples)
    result = _fit(train, replace(settings, corrective=units, nonlinear_only=False))
    cost = result.seconds["linear fit"] + result.seconds["corrective functions"]
    return assess(result.model, cost, robot, tests)


def _series(
    assessed: dict[str, Assessed], system: ODESystem, tests: Sequence[Trajectory], k: int
) -> Series:
    run = tests[k]
    true = states(assessed[MULTI].model, run)
    predicted = {name: slope(a.model, run) for name, a in assessed.items()}
    return Series(
        time=run.time,
        controls=run.select([c.name for c in system.controls]).values,
        derivatives=system.derivative(run),
        states=true,
        predicted=predicted,
        simulated={name: true + a.rollouts.errors[k] for name, a in assessed.items()},
        correction=predicted[MULTI] - predicted[LINEAR],
    )


def _chaos(samples: int, seed: int) -> Chaos:
    robot = two_link_robot_with_gravity()
    x = np.array(STATES)
    runs = robot.campaign(
        TRAINING_RUNS + TEST_RUNS,
        np.linspace(0.0, 5.0, 5 * _RATE),
        Uniform(low=tuple(x - DELTA), high=tuple(x + DELTA)),
        RandomKnots(low=-1.0, high=1.0, spacing=SPACING),
        seed=seed,
    )
    train, tests = runs[:TRAINING_RUNS], runs[TRAINING_RUNS:]
    assessed = _compared(_fit(train, recipe(robot, samples)), robot, tests)
    own = _fit(train, fit_settings(robot, RBF(samples=samples)))
    assessed[OWN] = assess(own.model, sum(own.seconds.values()), robot, tests)
    steps = round(_SHORT * _RATE)
    pieces = [
        replace(run, time=run.time[k : k + steps + 1], values=run.values[k : k + steps + 1])
        for run in tests
        for k in range(0, len(run) - steps, steps)
    ]
    slopes = np.concatenate([robot.derivative(run) for run in tests])
    recorded = np.concatenate([states(assessed[MULTI].model, run) for run in tests])
    return Chaos(
        assessed=assessed,
        short={name: roll(a.model, pieces) for name, a in assessed.items()},
        spread=(slopes.std(axis=0), recorded.std(axis=0)),
        series=_series(assessed, robot, tests, 0),
    )

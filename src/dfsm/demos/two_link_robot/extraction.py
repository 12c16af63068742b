"""How well a cubic spline differentiates simulated states: Sec. 3.3 and Fig. 1 of the paper.

The spline interpolates, so it has two kinds of error: its own, which falls with the sampling step
h, and the simulator's, which does not. Its own is of order h⁴ at interior samples of an even mesh
and h³ elsewhere. (Half way between samples it is of order h⁴ again, the leading term being a
Bernoulli polynomial that vanishes there; a quarter of the way it is largest.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from dfsm.core.progress import track
from dfsm.core.settings import settings_class
from dfsm.core.types import Array
from dfsm.data.derivatives import cubic_spline
from dfsm.data.trajectory import Trajectory
from dfsm.simulators import ODESystem, two_link_robot_with_gravity
from dfsm.simulators.excitation import RandomKnots, Uniform
from dfsm.simulators.two_link_robot import holding_torques

# Stationary point of the paper's Sec. 3.8.
STATES = (0.7854, 0.0, -0.5236, 0.0)
DELTA = 0.1
# s; the paper does not say how long it simulates. Its "nearly one million samples" from a hundred
# simulations make 10 000 points each.
DURATION = 0.3
# Knots of the inputs come at every tenth of a simulation, whatever it lasts.
_KNOTS = 10
_LONGER = (1.0, 3.0, 5.0)
_TIGHT, _TIGHTEST = 1e-12, 1e-13
# Refinement: simulations of 1 s in a wider box, so that the spline's own error stands out.
_REFINED_DURATION, _REFINED_DELTA, _COARSEST = 1.0, 1.0, 50
# Orders are read off between these numbers of steps: above, the solver's error shows.
_ASYMPTOTIC = (400, 3200)
# Samples at each end that are left out: there the not-a-knot condition costs an order.
_ENDS = 12
_SHOWN_POINTS = 500


@settings_class
class ExtractionSettings:
    """How much to compute.

    Attributes
    ----------
    runs, points
        Simulations, and samples in each.
    longer_runs
        Simulations of each longer duration.
    finest
        Steps of the finest mesh of the refinement, 50 times a power of two.
    refined_runs
        Simulations that are refined.
    """

    runs: int = 100
    points: int = 10_000
    longer_runs: int = 20
    finest: int = 12_800
    refined_runs: int = 10


@dataclass(frozen=True, eq=False)
class Refinement:
    """Mean absolute error against the sampling step.

    Attributes
    ----------
    step
        h in s, shape ``(mesh,)``.
    knots, between
        Mean error of ξ̇ at interior samples, and a quarter of the way to the next.
    loose
        As `knots`, with the solver's usual tolerance.
    orders
        Of `knots` and `between` in h, where the spline's own error prevails.
    """

    step: Array
    knots: Array
    between: Array
    loose: Array
    orders: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Extraction:
    """What differentiating the splines of many simulations gives.

    Attributes
    ----------
    runs, points
        Simulations, and samples in each.
    mean
        Mean absolute error of ξ̇ over all runs, samples and states.
    of_states
        The same per state, shape ``(state,)``.
    durations
        Duration in s, and `mean` at a tolerance of 1e-9 and of 1e-12, for longer simulations too.
    example
        Time, true and extracted ξ̇ of one run, shapes ``(time,)`` and ``(time, state)``.
    refinement
        See `Refinement`.
    """

    runs: int
    points: int
    mean: float
    of_states: Array
    durations: tuple[tuple[float, float, float], ...]
    example: tuple[Array, Array, Array]
    refinement: Refinement


def around(
    robot: ODESystem,
    runs: int,
    time: Array,
    delta: float,
    seed: int,
    tolerance: float | None = None,
) -> list[Trajectory]:
    """Simulations of the arm with gravity that begin near its stationary point (Sec. 3.8.1).

    Parameters
    ----------
    robot
        The arm.
    runs
        How many.
    time
        Samples in s.
    delta
        States at the start and knots of the torques lie within this of the stationary point.
    seed
        Seed of the draws.
    tolerance
        Of the solver, relative and absolute; None leaves the robot's.
    """
    if tolerance is not None:
        robot = replace(robot, rtol=tolerance, atol=tolerance)
    # The torques that the paper states leave accelerations of 4e-4 rad/s²: the arm would drift
    # further than the smallest perturbations reach.
    x, u = np.array(STATES), holding_torques(robot, STATES)
    return robot.campaign(
        runs,
        time,
        Uniform(low=tuple(x - delta), high=tuple(x + delta)),
        RandomKnots(low=tuple(u - delta), high=tuple(u + delta), spacing=float(time[-1]) / _KNOTS),
        seed=seed,
    )


def extraction(settings: ExtractionSettings, seed: int) -> Extraction:
    """Compare the derivative of a cubic spline with the true one (Fig. 1).

    Parameters
    ----------
    settings
        How much to compute.
    seed
        Seed of the simulations.

    Returns
    -------
    Extraction
    """
    robot = two_link_robot_with_gravity()

    def errors(duration: float, runs: int, tolerance: float | None) -> Array:
        time = np.linspace(0.0, duration, settings.points)
        runs_around = around(robot, runs, time, DELTA, seed, tolerance)
        return np.mean(
            [np.abs(extracted(r) - robot.derivative(r)).mean(axis=0) for r in runs_around], 0
        )

    mean = errors(DURATION, settings.runs, None)
    durations = [
        (DURATION, float(mean.mean()), float(errors(DURATION, settings.runs, _TIGHT).mean()))
    ]
    for duration in track(_LONGER, "longer simulations"):
        loose, tight = (errors(duration, settings.longer_runs, t).mean() for t in (None, _TIGHT))
        durations.append((duration, float(loose), float(tight)))
    one = around(robot, 1, np.linspace(0.0, _REFINED_DURATION, settings.points), DELTA, seed)[0]
    thin = slice(None, None, -(-settings.points // _SHOWN_POINTS))
    example = (one.time[thin], robot.derivative(one)[thin], extracted(one)[thin])
    return Extraction(
        runs=settings.runs,
        points=settings.points,
        mean=float(mean.mean()),
        of_states=mean,
        durations=tuple(durations),
        example=example,
        refinement=_refine(robot, settings, seed),
    )


def extracted(run: Trajectory) -> Array:
    """Derivatives of the cubic splines through the states of a run, shape ``(time, state)``."""
    columns = [cubic_spline(run.time, run[c.name])[1] for c in run.channels if c.role == "state"]
    return np.stack(columns, axis=1)


def _refine(robot: ODESystem, settings: ExtractionSettings, seed: int) -> Refinement:
    # Four samples per finest step, so that the truth is known a quarter of the way.
    time = np.linspace(0.0, _REFINED_DURATION, 4 * settings.finest + 1)
    loose, tight = (
        around(robot, settings.refined_runs, time, _REFINED_DELTA, seed, tolerance)
        for tolerance in (None, _TIGHTEST)
    )
    doublings = int(np.log2(settings.finest // _COARSEST))
    counts = _COARSEST * 2 ** np.arange(doublings + 1)
    strides = (4 * settings.finest // counts).tolist()
    knots, between = np.array([_mesh_errors(robot, tight, n) for n in strides]).T
    usual = [_mesh_errors(robot, loose, n)[0] for n in strides]
    step = _REFINED_DURATION / counts
    inside = (counts >= _ASYMPTOTIC[0]) & (counts <= _ASYMPTOTIC[1])
    first, second = (
        float(np.polyfit(np.log(step[inside]), np.log(e[inside]), 1)[0]) for e in (knots, between)
    )
    return Refinement(step, knots, between, np.array(usual), (first, second))


def _mesh_errors(robot: ODESystem, runs: Sequence[Trajectory], stride: int) -> tuple[float, float]:
    """Mean error at interior samples, and a quarter of the way between, for every n-th sample."""
    sums = np.zeros(2)
    for run in runs:
        truth = robot.derivative(run)
        values = run.select([c.name for c in robot.states]).values
        slopes = CubicSpline(run.time[::stride], values[::stride]).derivative()
        for k, offset in enumerate((0, stride // 4)):
            rows = np.arange(offset, len(run), stride)[_ENDS:-_ENDS]
            sums[k] += np.abs(slopes(run.time[rows]) - truth[rows]).mean()
    at, between = sums / len(runs)
    return float(at), float(between)

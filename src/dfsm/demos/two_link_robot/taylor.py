"""The linear fit against the first-order Taylor expansion: Sec. 3.8.1, Figs. 2 and 3.

The paper states the poles ±5.2160 and ±2.6533 for the expansion about the stationary point. They
are those at its states with u = 0; with the torques that hold the arm there they are ±4.9329 and
±1.9881, and it is to these that a fit to simulations near that point converges.
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
from dfsm.demos.two_link_robot.assess import slope
from dfsm.demos.two_link_robot.extraction import DURATION, STATES, around
from dfsm.errors import hushed
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LTI, fit_linear
from dfsm.fitting.samples import extract, select
from dfsm.fitting.settings import FitSettings
from dfsm.simulators import ODESystem, two_link_robot_with_gravity
from dfsm.simulators.two_link_robot import holding_torques

# The states of small perturbations are small numbers: an error of 1e-9 would show.
_TOLERANCE = 1e-13
# Decisions are made with few units: whether a row needs any does not depend on how many.
_UNITS = 50
_SHOWN_POINTS = 300


@settings_class
class TaylorSettings:
    """How much to compute.

    Attributes
    ----------
    runs, points
        Simulations for each δ, and samples in each.
    deltas
        Perturbations, largest first.
    """

    runs: int = 100
    points: int = 10_000
    deltas: tuple[float, ...] = (0.1, 0.03, 0.01, 1e-3, 1e-4)


@dataclass(frozen=True, eq=False)
class LinearFitAt:
    """The linear fit to simulations within δ of the stationary point.

    Attributes
    ----------
    delta
        δ, in the units of states and torques.
    poles
        Eigenvalues of A_L in 1/s, largest first, shape ``(state,)``.
    without_offset
        The same for the paper's L·I, which has no constant term.
    """

    delta: float
    poles: Array
    without_offset: Array


@dataclass(frozen=True, eq=False)
class TaylorComparison:
    """Linear fits against the Taylor expansion.

    Attributes
    ----------
    stationary, unforced
        Poles of ∂f/∂ξ at the stationary states with their torques, and with none.
    fits
        One per δ.
    decisions
        What `fit` decides for each row at the largest δ.
    samples, seconds
        How many samples the fit at the largest δ is made of, and what it takes.
    example
        Time, true ξ̇, that of the linear fit and that of the Taylor expansion on a run that was not
        fitted, at the largest δ.
    """

    stationary: Array
    unforced: Array
    fits: tuple[LinearFitAt, ...]
    decisions: tuple[dict[str, Any], ...]
    samples: int
    seconds: float
    example: tuple[Array, Array, Array, Array]

    def distance(self, which: Array, offset: bool = True) -> Array:
        """Largest distance of the fitted poles from `which`, for every δ."""
        computed = [f.poles if offset else f.without_offset for f in self.fits]
        return np.array([np.abs(poles - which).max() for poles in computed])


def compare_with_taylor(settings: TaylorSettings, seed: int) -> TaylorComparison:
    """Fit linearly near the stationary point, ever nearer, and look at the poles.

    Parameters
    ----------
    settings
        How much to compute.
    seed
        Seed of the simulations.

    Returns
    -------
    TaylorComparison
    """
    robot = two_link_robot_with_gravity()
    time = np.linspace(0.0, DURATION, settings.points)

    def runs(delta: float) -> list[Trajectory]:
        return around(robot, settings.runs + 1, time, delta, seed, _TOLERANCE)

    fits = []
    for delta in track(settings.deltas, "linear fits"):
        fits.append(_linear_fit(robot, runs(delta)[:-1], delta))
    *train, test = runs(settings.deltas[0])
    with hushed():
        fitted = fit(train, _settings(robot))
    thin = slice(None, None, -(-settings.points // _SHOWN_POINTS))
    truth, linear = robot.derivative(test), slope(fitted.model.linear_fit(), test)
    example = tuple(a[thin] for a in (test.time, truth, linear, _taylor(robot, test)))
    return TaylorComparison(
        stationary=robot.eigenvalues(STATES, holding_torques(robot, STATES)).real,
        unforced=robot.eigenvalues(STATES, (0.0, 0.0)).real,
        fits=tuple(fits),
        decisions=tuple(fitted.model.provenance.record["rows"]),
        samples=settings.runs * settings.points,
        seconds=fitted.seconds["linear fit"],
        example=example,  # pyright: ignore[reportArgumentType]
    )


def _settings(robot: ODESystem) -> FitSettings:
    return FitSettings(
        states=tuple(StateSpec(name=c.name) for c in robot.states),
        controls=tuple(c.name for c in robot.controls),
        derivatives=DerivativeSettings(method="cubic_spline"),
        corrective=RBF(samples=_UNITS),
        nonlinear_only=False,
    )


def _linear_fit(robot: ODESystem, train: Sequence[Trajectory], delta: float) -> LinearFitAt:
    settings = _settings(robot)
    samples = extract(select(train, settings), settings)
    names = [c.name for c in samples.signals.inputs]

    def poles(affine: bool) -> Array:
        blocks = samples.blocks(samples.inputs, samples.derivatives)
        fitted = fit_linear(blocks, names, LTI(affine=affine)).model.coefficients[0]
        values = np.linalg.eigvals(np.asarray(fitted)[:, len(robot.controls) :])
        return np.sort(values.real)[::-1]

    return LinearFitAt(delta, poles(True), poles(False))


def _taylor(robot: ODESystem, run: Trajectory) -> Array:
    """First-order expansion about the stationary point along a run, shape ``(time, state)``."""
    torques = holding_torques(robot, STATES)
    A, B, *_ = robot.jacobians(STATES, torques)
    here = np.concatenate([STATES, torques])
    names = [c.name for c in (*robot.states, *robot.controls)]
    point = replace(run, values=np.broadcast_to(here, (len(run), len(here))))
    start = robot.derivative(point.select(names))
    away = run.select(names).values - here
    return start + away @ np.concatenate([A, B], axis=1).T

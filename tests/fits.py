"""Systems whose f is known, fitted once per process for the tests of more than one file."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Trajectory
from dfsm.fitting.corrective import GP, RBF, NoCorrection
from dfsm.fitting.fit import FitResult, fit
from dfsm.fitting.linear import LPV
from dfsm.fitting.settings import FitSettings
from dfsm.models.dfsm import DFSM
from systems import DUFFING, OSCILLATOR, SCHEDULED

TIME = np.arange(0, 30.01, 0.05)
BOTH = (StateSpec(name="q"), StateSpec(name="v"))
SECOND = (StateSpec(name="q", order=2),)
LINEAR = FitSettings(
    states=BOTH,
    controls=("u",),
    disturbances=("w",),
    outputs=("y",),
    corrective=RBF(samples=40, width=0.5),
    nonlinear_only=False,
)
SMALL = GP(samples=80)


@cache
def linear_runs() -> list[Trajectory]:
    return OSCILLATOR.many(4, [(1, 2), (8, 3)], TIME)


@cache
def linear() -> FitResult:
    return fit(linear_runs(), LINEAR)


@cache
def duffing_runs() -> list[Trajectory]:
    return DUFFING.many(6, [(0, 3), (0, 2)], TIME, spread=0.8)


@cache
def duffing() -> FitResult:
    choices = replace(LINEAR, states=SECOND, outputs=("y", "z"), corrective=SMALL)
    return fit(duffing_runs(), choices)


@cache
def scheduled() -> DFSM:
    runs = SCHEDULED.many(8, [(0, 3), (10, 8)], TIME, seed=1)
    choices = replace(LINEAR, linear=LPV(schedule="w", points=5), corrective=NoCorrection())
    return fit(runs, choices).model

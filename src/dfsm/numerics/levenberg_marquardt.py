"""Levenberg-Marquardt: far fewer iterations, and far lower errors, than L-BFGS for small networks.

Each step solves ``(JᵀJ + (λ + μ) 1) Δ = -(Jᵀr + λ w)`` for the change Δ of the weights w (Levenberg
1944, Marquardt 1963; for networks Hagan & Menhaj 1994). The gain ratio, what a step gained over
what the quadratic model promised, accepts the step and sets the damping μ for the next (Nielsen
1999; Madsen, Nielsen & Tingleff 2004, Methods for Non-Linear Least Squares Problems, Sec. 3.2).
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy

from dfsm.core.types import Array

# Damping at first, relative to the mean curvature.
_FIRST_DAMPING = 1e-3
# Gain ratio from which a step is accepted; a model that promises a thousand times too much is none.
_LEAST_GAIN = 1e-3
# Damping stays where a step gains this share of what was promised, and falls to a third, Nielsen's
# factor, where it gains that much more. Nielsen's curve stays at a half and falls from nearly all
# on: it saves refused trials, which cost an error here, where a step costs a JᵀJ.
_FAIR, _GOOD, _LESS, _MORE = 0.25, 0.5, 1 / 3, 4.0
# Cosine between the residuals and every column of J; step relative to the weights; decrease of the
# error relative to the error: where one of them is smaller, nothing is left to gain.
_SMALL_SLOPE, _SMALL_STEP, _SMALL_DECREASE = 1e-8, 1e-8, 1e-9


class LeastSquares(Protocol):
    """What is to be made small: |r(w)|²."""

    def cost(self, weights: Array) -> float:
        """|r|², infinite where there is none."""
        ...

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ, or what stands for it, and Jᵀr, with J = dr/dw."""
        ...


class Stop(enum.Enum):
    """Why no further step follows; the value says what it means."""

    SLOPE = "converged: the error has no slope left"
    STEP = "converged: a step would hardly change the weights"
    DECREASE = "converged: a step would hardly lower the error"
    STUCK = "no step lowers the error, however short: its slopes may be wrong, or a wall is near"
    NOT_FINITE = "the error is not finite where the steps would begin"


@dataclass(frozen=True)
class Step:
    """Weights after an accepted step, or to start from.

    Attributes
    ----------
    weights
        Shape ``(weight,)``.
    damping
        μ for the next step; None takes a thousandth of the mean curvature.
    """

    weights: Array
    damping: float | None = None


class LevenbergMarquardt:
    """The steps that minimise ``|r(w)|² + λ |w|²``, one by one, until it stops or the caller does.

    Iterate once. Every step lowers the error; an approximate JᵀJ costs steps, not correctness,
    because the gain ratio is measured against the model that the step was made from.

    Parameters
    ----------
    problem
        r and its slopes.
    start
        Weights and damping to start with.
    penalty
        λ.
    fixed
        Damping falls to a third after every step that gains a fair share of its promise and grows
        fourfold where one is refused (Fletcher 1971), instead of going smoothly with the gain.

    Attributes
    ----------
    stop
        Why there is no further step; None until then, and where the caller ended the iteration.
    """

    def __init__(
        self, problem: LeastSquares, start: Step, penalty: float, *, fixed: bool = False
    ) -> None:
        self._problem, self._start, self._penalty = problem, start, penalty
        self._fixed = fixed
        self.stop: Stop | None = None

    def __iter__(self) -> Iterator[Step]:
        w, damping = self._start.weights, self._start.damping
        here = self._cost(w)
        if not np.isfinite(here):
            self.stop = Stop.NOT_FINITE
            return
        while True:
            curvature, slope = self._normal_equations(w)
            diagonal = np.diag(curvature)
            if (np.abs(slope) <= _SMALL_SLOPE * np.sqrt(diagonal * here)).all():
                self.stop = Stop.SLOPE
                return
            if damping is None:
                damping = _FIRST_DAMPING * float(diagonal.mean())
            trial = self._accepted(w, here, curvature, slope, damping)
            if isinstance(trial, Stop):
                self.stop = trial
                return
            if max(trial.promised, here - trial.cost) <= _SMALL_DECREASE * here:
                self.stop = Stop.DECREASE
            gain = (here - trial.cost) / trial.promised
            fixed = _LESS if gain >= _FAIR else 1.0
            damping = trial.damping * (fixed if self._fixed else _relief(gain))
            w, here = trial.weights, trial.cost
            yield Step(w, damping)
            if self.stop:
                return

    def _accepted(
        self, w: Array, here: float, curvature: Array, slope: Array, damping: float
    ) -> _Trial | Stop:
        """The first step that gains enough, under ever more damping, or why there is none."""
        growth = _MORE if self._fixed else 2.0
        reason: Stop | None = None
        while True:
            step = _damped_step(curvature, slope, damping)
            if step is not None:
                change, promised = step
                if np.linalg.norm(change) <= _SMALL_STEP * (np.linalg.norm(w) + _SMALL_STEP):
                    return reason or Stop.STEP
                # Beyond this, what is gained is lost in the rounding of the error.
                if promised <= np.finfo(float).eps * here:
                    return reason or Stop.DECREASE
                there = self._cost(w + change)
                if np.isfinite(there) and here - there >= _LEAST_GAIN * promised:
                    return _Trial(w + change, there, promised, damping)
                much = promised > _SMALL_DECREASE * here
                reason = reason or (Stop.STUCK if much else Stop.DECREASE)
            damping, growth = damping * growth, growth if self._fixed else 2 * growth

    def _cost(self, w: Array) -> float:
        return self._problem.cost(w) + self._penalty * float(w @ w)

    def _normal_equations(self, w: Array) -> tuple[Array, Array]:
        JtJ, Jtr = self._problem.normal_equations(w)
        return JtJ + self._penalty * np.eye(len(w)), Jtr + self._penalty * w


@dataclass(frozen=True)
class _Trial:
    """Weights tried, the error there, the decrease promised, and the damping that it took."""

    weights: Array
    cost: float
    promised: float
    damping: float


def _damped_step(curvature: Array, slope: Array, damping: float) -> tuple[Array, float] | None:
    """Δ, and by how much the quadratic model falls along it; None without enough damping."""
    try:
        factor = scipy.linalg.cho_factor(curvature + damping * np.eye(len(slope)), overwrite_a=True)
    except scipy.linalg.LinAlgError:
        return None
    change = -scipy.linalg.cho_solve(factor, slope)
    return change, float(change @ (damping * change - slope))


def _relief(gain: float) -> float:
    """Factor of the damping after a step, continuous in its gain ratio."""
    return float(_LESS ** min((gain - _FAIR) / _GOOD, 1.0))

"""Levenberg-Marquardt for small networks: far fewer iterations, and far lower errors, than L-BFGS.

Each step solves ``(JᵀJ + (μ + λ) 1) Δ = -(Jᵀr + λ w)`` for the weights w (Levenberg 1944, Marquardt
1963; for networks Hagan & Menhaj 1994).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from dfsm.core.types import Array

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-8, 1e12
_LESS, _MORE = 1 / 3, 4.0


class LeastSquares(Protocol):
    """What is to be made small: |r(w)|²."""

    def cost(self, weights: Array) -> float:
        """|r|²."""
        ...

    def normal_equations(self, weights: Array) -> tuple[Array, Array]:
        """JᵀJ and Jᵀr, with J = dr/dw."""
        ...


@dataclass(frozen=True)
class Step:
    """Weights after an accepted step, shape ``(weight,)``, and the damping μ for the next."""

    weights: Array
    damping: float = _FIRST_DAMPING


def levenberg_marquardt(problem: LeastSquares, start: Step, penalty: float) -> Iterator[Step]:
    """Minimise ``|r(w)|² + λ |w|²`` step by step, until the caller stops.

    Parameters
    ----------
    problem
        r and its slopes.
    start
        Weights and damping to start with.
    penalty
        λ.

    Yields
    ------
    Step
        Every accepted step; the error never grows. Ends where no step lowers the error.
    """
    w, damping = start.weights, start.damping
    here = problem.cost(w) + penalty * float(w @ w)
    while True:
        JtJ, Jtr = problem.normal_equations(w)
        slope = Jtr + penalty * w
        trial, there = w, np.inf
        while not there < here:
            if damping > _MOST_DAMPING:
                return
            try:
                factor = cho_factor(JtJ + (damping + penalty) * np.eye(len(w)), overwrite_a=True)
                trial = w - cho_solve(factor, slope)
                there = problem.cost(trial) + penalty * float(trial @ trial)
            except LinAlgError:
                pass
            if not there < here:
                damping *= _MORE
        w, here = trial, there
        damping = max(damping * _LESS, _LEAST_DAMPING)
        yield Step(w, damping)

"""How well a point satisfies the optimality conditions of a `Program`, whatever its solver says."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from dfsm.control.nlp.program import Program
from dfsm.control.nlp.watch import violation
from dfsm.control.solution import Optimality
from dfsm.core.types import Array

# Multipliers of this size on average do not loosen the conditions: s_max of Wächter and Biegler.
_LARGE = 100.0


def optimality(
    program: Program, z: Array, multipliers: Array, bound_multipliers: Array
) -> Optimality:
    """Measure the first-order conditions at a point, in scaled variables.

    With L = f + λᵀg + νᵀz, at a solution ∂L/∂z = 0, all limits hold, and a multiplier is positive
    only at an upper limit and negative only at a lower one. Stationarity and complementarity are
    relative to s = max(1, ‖∂f/∂z‖∞, mean of |λ| and |ν| / 100), after Wächter and Biegler (2006),
    Eq. 6 and Sec. 3.8.

    Parameters
    ----------
    program
        Functions, derivatives and limits.
    z
        Scaled variables, shape ``(variable,)``.
    multipliers, bound_multipliers
        λ of scaled constraints and ν of scaled variables, of the scaled objective.

    Returns
    -------
    Optimality
        NaN where a function is not finite.
    """
    lam = _possible(multipliers, program.g_lower, program.g_upper)
    nu = _possible(bound_multipliers, program.lower, program.upper)
    with np.errstate(all="ignore"):  # a solver may end where a function is not finite
        gradient, g = program.gradient(z), program.constraints(z)
        rows, starts = program.jacobian_pattern
        shape = (program.m, program.n)
        jacobian = sparse.csc_matrix((program.jacobian(z), rows, starts), shape=shape)
        slope = gradient + jacobian.T @ lam + nu
        # A variable that cannot move may have any slope.
        slope = np.where(program.lower < program.upper, slope, 0.0)
        mean = np.abs(np.concatenate([lam, nu])).mean() if len(lam) + len(nu) else 0.0
        size = max(1.0, float(np.abs(gradient).max(initial=0.0)), float(mean) / _LARGE)
        products = np.concatenate(
            [
                _products(lam, g, program.g_lower, program.g_upper),
                _products(nu, z, program.lower, program.upper),
            ]
        )
        beyond = np.concatenate(
            [
                violation(g, program.g_lower, program.g_upper),
                violation(z, program.lower, program.upper),
            ]
        )
        return Optimality(
            stationarity=float(np.abs(slope).max(initial=0.0)) / size,
            violation=float(beyond.max(initial=0.0)),
            complementarity=float(products.max(initial=0.0)) / size,
        )


def _possible(multipliers: Array, low: Array, high: Array) -> Array:
    """Multipliers without those that push from a limit that does not exist."""
    least = np.where(np.isfinite(low), -np.inf, 0.0)
    return np.clip(multipliers, least, np.where(np.isfinite(high), np.inf, 0.0))


def _products(multipliers: Array, values: Array, low: Array, high: Array) -> Array:
    """|multiplier × distance to its limit|; 0 for equalities, which are always at theirs."""
    gap = np.where(multipliers > 0, high - values, values - low)
    active = (multipliers != 0) & (low < high)
    return np.where(active, np.abs(multipliers * np.where(active, gap, 0.0)), 0.0)

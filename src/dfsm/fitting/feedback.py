"""Controls that follow the states, and what that does to their coefficients.

Least squares takes what it cannot explain for independent of the inputs. In closed loop it is not:
an unknown force moves the state, the controller answers, and the fit sees a control that moves
together with the force that it fights. Its effect comes out too small, often by far, and the state
less damped than it is (Ljung 1999, System Identification, Sec. 13.4). Neither shows in the
residual. Two figures together tell: how much of a row is left unexplained, and how much of a
control the states and their past explain,

    u(t) ≈ K₀ x(t) + Σ_k K_k x_k(t),    τ_k dx_k/dt = x - x_k ,

with lags τ_k from the control's own correlation time on. What is that slow stands for the
integrals and filters of a controller and cannot differentiate: a state's derivative holds the
control that moves it in open loop, too. There is one more way in which a state tells its control
in open loop, a state that follows at once: then the law K moves the fit's eigenvalues right,
where a controller moves them left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from dfsm.core.types import Array
from dfsm.fitting.residuals import Residuals, stacked
from dfsm.numerics.least_squares import correlation_length

# Share of a row's standard deviation that must be unexplained, and share of a control's variance
# that its states must explain. Simulated open loops reached 78 % at most (the inverse of a noisy
# plant), loops that are not excited 92 % and more.
_UNEXPLAINED, _FOLLOWS = 0.3, 0.85
# Share of a run, at its head, over which the slowest lags settle.
_SETTLES = 1 / 6


@dataclass(frozen=True)
class Law:
    """A control as a function of the states and their past.

    Attributes
    ----------
    explained
        Share of the control's variance, 0 to 1.
    gain
        What the control does where the states have been for about as long as it remembers,
        ``(state,)``.
    column
        Of the inputs.
    """

    explained: float
    gain: Array
    column: int


def follows(residuals: Residuals, control: int, states: Sequence[int]) -> Law:
    """Fit the law that a control follows.

    Parameters
    ----------
    residuals
        Of any row; its inputs are used.
    control, states
        Columns of the inputs.
    """
    runs = residuals.centred().inputs
    columns = list(states)
    shortest = min(len(run) for run in runs)
    memory = np.mean([correlation_length(run[:, [control]])[0] for run in runs]) / 2
    lags = [memory := max(float(memory), 1.0)]
    while lags[-1] * 2 < shortest / 3:
        lags.append(2 * lags[-1])
    inputs, targets, recent = [], [], []
    for run in runs:
        settled = int(len(run) * _SETTLES)
        x = run[:, columns]
        inputs.append(np.concatenate([x, *(_lagged(x, lag) for lag in lags)], axis=1)[settled:])
        targets.append(run[settled:, control])
        recent.append(_lagged(x, memory)[settled:])
    u = stacked(targets)
    u = u - u.mean()
    law, left = _regressed(u, stacked(inputs))
    gain, _ = _regressed(u, stacked(recent))
    total = float(np.sum(u**2))
    # As many coefficients explain by chance as they are of the independent samples.
    free = len(u) / (2 * memory) - len(law)
    chance = 1.0 if free <= 0 else (len(u) / (2 * memory)) / free
    explained = 1 - min(1.0, chance * left / max(total, np.finfo(float).tiny))
    return Law(explained, gain, control)


def _regressed(u: Array, inputs: Array) -> tuple[Array, float]:
    """Coefficients of least squares, and the sum of squares that they leave."""
    X = inputs - inputs.mean(axis=0)
    scale = np.maximum(X.std(axis=0), np.finfo(float).tiny)
    X /= scale
    solved = np.linalg.lstsq(X.T @ X, X.T @ u, rcond=1e-12)[0]
    return solved / scale, float(np.sum((u - X @ solved) ** 2))


def _lagged(x: Array, lag: float) -> Array:
    decay = float(np.exp(-1 / lag))
    # As equations with two diagonals: SciPy's signal package takes a second to import.
    bands = np.stack([np.ones(len(x)), np.full(len(x), -decay)])
    driving = np.concatenate([x[:1], (1 - decay) * x[1:]])
    return scipy.linalg.solve_banded((1, 0), bands, driving)


def is_feedback(law: Law, A: Array, b: Array) -> bool:
    """Whether a law is a controller's, and not the answer of a state that follows its control.

    Parameters
    ----------
    law
        Of one control.
    A, b
        Of the fit, ``(state, state)`` and ``(state,)``.
    """
    if law.explained < _FOLLOWS:
        return False
    closed = A + np.outer(b, law.gain)
    return bool(b @ law.gain < 0 or _growth(closed) < _growth(A))


def _growth(A: Array) -> float:
    return float(np.linalg.eigvals(A).real.max())


def much_unexplained(residuals: Residuals) -> bool:
    """Whether so much of a row is left over that feedback may have biased it."""
    return residuals.unexplained >= _UNEXPLAINED


def feedback_note(
    row: str,
    unexplained: float,
    controls: Sequence[str],
    coefficients: Sequence[float],
    laws: Sequence[Law],
) -> str:
    """Which coefficients of a row not to believe, why, and what to do."""
    shares = ", ".join(
        f"'{name}' ({law.explained:.0%} of its variance)"
        for name, law in zip(controls, laws, strict=True)
    )
    values = ", ".join(f"{value:.3g}" for value in coefficients)
    follow = "follows" if len(controls) == 1 else "follow"
    return (
        f"{row}: {unexplained:.0%} of it is unexplained and {shares} {follow} from the states and "
        f"their past: feedback biases the effect fitted there ({values}), and the eigenvalues with "
        "it, so do not believe either; train with runs in which a set-point or the control itself "
        "is excited, or that have the same disturbances and other controls, or set linear.known; "
        "damping the fit would only hide this"
    )


def alike_note(row: str, unexplained: float, control: str, coefficient: float, law: Law) -> str:
    """That a control and the states cannot be told apart, and what to do."""
    return (
        f"{row}: {unexplained:.0%} of it is unexplained and '{control}' is little else than the "
        f"states and their past ({law.explained:.1%} of its variance), so what it does cannot be "
        f"told from what these do: do not believe its effect ({coefficient:.3g}), nor the "
        "eigenvalues; if a controller chose it, train with runs in which a set-point or the "
        "control itself is excited, or set linear.known"
    )

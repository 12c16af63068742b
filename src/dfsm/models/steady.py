"""Steady states of a model: where it settles at a constant wind speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from numpy.typing import ArrayLike

from dfsm.core.types import Array, ComplexArray
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM, require_model

# Damped least squares: steps have no part along which nothing changes, so that a state that nothing
# depends on (an azimuth, say) stays put, and they do not run away as Newton's do.
_SOLVER = optimistix.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
_STEPS = 256


@dataclass(frozen=True)
class SteadyState:
    """A point with ξ̇ = 0.

    Attributes
    ----------
    states, controls, disturbances, parameters, outputs
        Values in the model's units, shapes ``(n,)``.
    eigenvalues
        Of the exact Jacobian A there, in 1/s.
    residual
        Largest remaining derivative, in standard deviations of its state per second.
    converged
        Whether the residual is zero to rounding.
    message
        What the result means and what to do about it.
    """

    states: Array
    controls: Array
    disturbances: Array
    parameters: Array
    outputs: Array
    eigenvalues: ComplexArray
    residual: float
    converged: bool
    message: str


def steady_state(
    model: DFSM,
    schedule: float | None = None,
    controls: ArrayLike | None = None,
    disturbances: ArrayLike | None = None,
    parameters: ArrayLike | None = None,
) -> SteadyState:
    """Find the states at which nothing changes, for inputs held constant.

    Parameters
    ----------
    model
        The surrogate.
    schedule
        Value of the scheduling signal (e.g. wind speed); needed for an LPV model.
    controls, disturbances, parameters
        Values to hold, shapes ``(n,)``; by default the mean of the training runs at that
        schedule value, in which the schedule itself is replaced.

    Returns
    -------
    SteadyState
        Check `converged`: a surrogate fitted to data far from rest may have no steady state.

    Raises
    ------
    DfsmError
        The schedule value is missing or outside the training range.
    """
    require_model(model)
    start = operating_point(model, schedule)
    x, u, w, p = model.split(start)
    u = u if controls is None else jnp.asarray(controls, dtype=float)
    w = w if disturbances is None else jnp.asarray(disturbances, dtype=float)
    p = p if parameters is None else jnp.asarray(parameters, dtype=float)
    scale = model.region.scale[model.signals.state_columns]
    held = _Held(model, x, scale, (u, w, p))
    z = optimistix.least_squares(
        _rates, _SOLVER, jnp.zeros_like(x), args=held, max_steps=_STEPS, throw=False
    ).value
    states = x + scale * z
    worst = float(jnp.max(jnp.abs(_rates(z, held))))
    converged = bool(np.isfinite(worst) and worst < 1e-9)
    A = model.jacobians(states, u, w, p)[0]
    eigenvalues = np.linalg.eigvals(A).astype(np.complex128)
    return SteadyState(
        states=np.asarray(states),
        controls=np.asarray(u),
        disturbances=np.asarray(w),
        parameters=np.asarray(p),
        outputs=np.asarray(model.output(states, u, w, p)),
        eigenvalues=eigenvalues[np.argsort(-eigenvalues.real)],
        residual=worst,
        converged=converged,
        message=_message(model, converged, worst, eigenvalues, model.join(states, u, w, p)),
    )


class _Held(NamedTuple):
    """What stays while states are sought: the model, where they start, their size, the inputs."""

    model: DFSM
    start: jax.Array
    scale: jax.Array
    groups: tuple[jax.Array, jax.Array, jax.Array]


def _rates(z: jax.Array, held: _Held) -> jax.Array:
    """Derivatives in standard deviations per second, as many of them from the start."""
    states = held.start + held.scale * z
    return held.model.derivative(states, *held.groups) / held.scale


def operating_point(model: DFSM, schedule: float | None) -> jax.Array:
    """Mean of the training runs at a schedule value, I = [u, w, ξ, p], shape ``(input,)``.

    Raises
    ------
    DfsmError
        The schedule value is missing or outside the training range.
    """
    region, column = model.region, model.f.schedule
    if column is None:
        return region.mean
    if schedule is None:
        raise DfsmError(f"an LPV model needs a value of its schedule '{model.schedule}'")
    low, high = float(region.low[column]), float(region.high[column])
    if not low <= schedule <= high:
        raise DfsmError(
            f"{model.schedule} = {schedule:g} is outside the training range {low:.4g} to {high:.4g}"
        )
    point = jax.vmap(lambda v: jnp.interp(schedule, region.grid, v))(region.operating.T)
    return point.at[column].set(schedule)


def _message(
    model: DFSM, converged: bool, worst: float, eigenvalues: ComplexArray, inputs: jax.Array
) -> str:
    if not converged:
        return (
            f"no steady state was found (largest residual {worst:.2g} standard deviations per "
            "second): hold other controls, or look at the eigenvalues of the linear fit"
        )
    notes = []
    if eigenvalues.real.max() > 0:
        notes.append(f"unstable, growing at {eigenvalues.real.max():.3g} 1/s")
    if bool(model.region.outside(inputs)):
        notes.append("outside the training range")
    return "steady state" + (": " + "; ".join(notes) if notes else " inside the training range")

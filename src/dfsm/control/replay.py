"""The optimal controls in diffrax: whether the model does what the transcription says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.control.guess import Start
from dfsm.control.mesh.grid import Grid
from dfsm.control.nlp.terms import common_of, functions_of
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.solution import Replay
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.between import polynomials
from dfsm.data.trajectory import Trajectory

TOLERANCE = 1e-9
_MOST_STEPS = 100_000
# Intervals are padded to a multiple of this, so that meshes share a compilation.
_PAD = 256
# Share of an interval within which an edge is met.
_EDGE = 1e-9


def replay(problem: OptimalControlProblem, grid: Grid, start: Start, scenario: int) -> Replay:
    """Integrate the model with the optimal controls, interval by interval.

    Parameters
    ----------
    problem
        What was solved.
    grid
        Mesh and scheme of the controls, which are the scheme's polynomials between nodes.
    start
        Optimal values at the nodes.
    scenario
        Which one.

    Returns
    -------
    Replay
        With relative and absolute tolerances of 1e-9 per step, the latter of each state's size.
    """
    functions = functions_of(problem)
    X, U = start.X[scenario], start.U[scenario]
    duration = start.stop - problem.start
    size = np.abs(X).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    shared = [*start.p, *([start.stop] if problem.free_time is not None else [])]
    p, _ = functions.unpack(from_host(shared), common_of(problem))
    ends = _integrate(
        functions.plant.derivative,
        _pieces(grid, U),
        X[0],
        size,
        p,
        _table(problem, scenario),
        np.array([problem.start, duration]),
        grid.scheme.points,
    )
    states = np.concatenate([X[:1], np.asarray(ends)[: grid.intervals].reshape(-1, X.shape[1])])
    gap = np.abs(states - X).max(axis=0)
    gap = np.where(np.isfinite(gap), gap, np.inf)
    channels = problem.plant.channels["states"]
    time = problem.start + grid.tau * duration
    names = [c.name for c in channels]
    return Replay(
        Trajectory(time, states, channels, name=problem.name),
        dict(zip(names, map(float, gap), strict=True)),
        float((gap / size).max()),
    )


def _pieces(grid: Grid, U: Array) -> dict[str, Array]:
    """Begin, length and controls, as monomials in θ, of every interval."""
    count = -(-grid.intervals // _PAD) * _PAD
    points = np.linspace(0, 1, len(grid.scheme.points))
    basis = np.linalg.inv(np.vander(points, increasing=True)) @ grid.scheme.control_basis(points)

    def pad(a: Array) -> Array:
        # An interval of no length changes nothing.
        return np.concatenate([a, np.zeros((count - len(a), *a.shape[1:]))])

    return {
        "begin": pad(grid.edges[:-1]),
        "length": pad(grid.lengths),
        "controls": pad(np.einsum("mn,knc->kmc", basis, U[grid.local])),
    }


def _table(problem: OptimalControlProblem, scenario: int) -> tuple[Array, ...]:
    """Times of the disturbances' samples, and these; polynomials if not all are lines."""
    names, run = problem.plant.names("disturbances"), problem.scenarios[scenario]
    if run is None or not names:
        return np.zeros(2), np.zeros((2, 0))
    kinds = problem.between[len(problem.plant.names("controls")) :]
    values = run.select(names).values
    if set(kinds) == {"linear"}:
        return run.time, values
    return run.time, values, polynomials(run.time, values, kinds)


def _on_polynomials(t: jax.Array, times: Array, polynomial: Array) -> jax.Array:
    k = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    s = t - jnp.asarray(times)[k]
    return s ** jnp.arange(3, -1, -1) @ jnp.asarray(polynomial)[:, k]


@eqx.filter_jit
def _integrate(
    derivative: Callable[..., Any],
    pieces: dict[str, Array],
    x0: Array,
    size: Array,
    p: jax.Array,
    disturbances: tuple[Array, ...],
    horizon: Array,
    points: Array,
) -> jax.Array:
    # Of the problem only its model comes in here, so that all problems on one share a compilation.
    import diffrax

    begin, duration = jnp.asarray(horizon)
    times, values, *polynomial = disturbances

    def slope(theta: jax.Array, z: jax.Array, piece: dict[str, jax.Array]) -> jax.Array:
        powers = theta ** jnp.arange(len(points))
        # What jumps at an edge is on this side of it.
        inside = jnp.clip(theta, _EDGE, 1 - _EDGE) if polynomial else theta
        t = begin + (piece["begin"] + inside * piece["length"]) * duration
        if polynomial:
            w = _on_polynomials(t, times, polynomial[0])
        else:
            w = jax.vmap(lambda v: jnp.interp(t, times, v), 1)(jnp.asarray(values))
        f = derivative(z * size, powers @ piece["controls"], w, p)
        return f * piece["length"] * duration / size

    def step(z: jax.Array, piece: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(slope),  # pyright: ignore[reportArgumentType]
            diffrax.Dopri8(),
            t0=0.0,
            t1=1.0,
            dt0=None,
            y0=z,
            args=piece,
            saveat=diffrax.SaveAt(ts=jnp.asarray(points[1:])),
            stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            max_steps=_MOST_STEPS,
            # Nobody differentiates backwards through it, and what that needs takes long to trace.
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        ys = jnp.asarray(solution.ys)
        return ys[-1], ys * size

    _, states = jax.lax.scan(step, jnp.asarray(x0) / size, jax.tree.map(jnp.asarray, pieces))
    return states

"""The integrators behind `simulate`: a batched RK4 scan, and diffrax's adaptive solvers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from dfsm.model import DFSM
from dfsm.trajectory import Trajectory
from dfsm.types import Array, IntArray

# Step counts are padded to a multiple of this, so that runs of similar length share a compilation.
_PAD = 1000
_MAX_STEPS = 1_000_000
# Steps per turn of the compiled loop: fewer turns, a little more to compile.
_UNROLL = 4
# Below this a second thread costs more than it gains.
_RUNS_PER_WORKER = 4


@dataclass(frozen=True)
class Mesh:
    """Times to integrate over and the inputs there.

    Attributes
    ----------
    time
        Ends and middles of all steps in s, shape ``(2 step + 1,)``.
    inputs
        Controls, disturbances and parameters at those times, ``(2 step + 1, exogenous)``.
    every
        Steps per sample of the run.
    """

    time: Array
    inputs: Array
    every: int

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.time) // 2

    @property
    def samples(self) -> slice:
        """Where the run's own samples stand."""
        return slice(0, len(self.time), 2 * self.every)


@dataclass(frozen=True)
class Rollout:
    """States, outputs and inputs at the run's samples ``(sample, n)``; whether it was solved."""

    states: Array
    outputs: Array
    inputs: Array
    solved: bool


def mesh_of(driven: Trajectory, step: float | None, interpolation: str) -> Mesh:
    """Divide the intervals between samples into steps and interpolate the inputs.

    Parameters
    ----------
    driven
        The exogenous channels of one run.
    step
        Largest step in s; None makes one step per sample.
    interpolation
        ``"linear"`` or ``"cubic"`` spline.
    """
    longest = float(np.diff(driven.time).max())
    every = 1 if step is None else max(1, int(np.ceil(longest / step * (1 - 1e-9))))
    parts = np.arange(2 * every) / (2 * every)
    time = _between(driven.time[:, None], parts)[:, 0]
    if interpolation == "cubic":
        inputs = CubicSpline(driven.time, driven.values)(time)
    else:
        inputs = _between(driven.values, parts)
    return Mesh(time, inputs, every)


def _between(values: Array, parts: Array) -> Array:
    """Values at fractions of every interval between rows, and the last row."""
    steps = np.diff(values, axis=0)[:, None, :] * parts[:, None]
    return np.concatenate(
        [(values[:-1, None, :] + steps).reshape(-1, values.shape[1]), values[-1:]]
    )


# -- fixed steps --------------------------------------------------------------------------------


def march(model: DFSM, meshes: Sequence[Mesh], x0: Array, psi0: Array) -> list[Rollout]:
    """Classical RK4 over all runs at once.

    Parameters
    ----------
    model
        The surrogate.
    meshes
        One per run; lengths may differ.
    x0, psi0
        Initial states ``(run, state)`` and azimuths in rad ``(run,)``.
    """
    padded = -(-max(m.steps for m in meshes) // _PAD) * _PAD
    h = np.zeros((len(meshes), padded))
    inputs = np.zeros((len(meshes), 2 * padded + 1, meshes[0].inputs.shape[1]))
    for i, m in enumerate(meshes):
        h[i, : m.steps] = np.diff(m.time[::2])
        inputs[i, : len(m.time)] = m.inputs
        inputs[i, len(m.time) :] = m.inputs[-1]
    states, outputs = _march_parts(model, x0, psi0, h, inputs)
    rollouts = []
    for i, m in enumerate(meshes):
        rows = slice(0, m.steps + 1, m.every)
        rollouts.append(Rollout(states[i, rows], outputs[i, rows], m.inputs[m.samples], True))
    return rollouts


def _march_parts(
    model: DFSM, x0: Array, psi0: Array, h: Array, inputs: Array
) -> tuple[Array, Array]:
    """Give each processor an equal part of the batch; XLA runs small steps on one only."""
    runs = len(x0)
    workers = min(os.cpu_count() or 1, runs // _RUNS_PER_WORKER) or 1
    size = -(-runs // workers)
    parts = [np.arange(i, i + size) % runs for i in range(0, runs, size)]

    def one(part: IntArray) -> tuple[Array, Array]:
        states, outputs = _march(model, x0[part], psi0[part], h[part], inputs[part])
        return np.asarray(states), np.asarray(outputs)

    if workers == 1:
        return one(parts[0])
    with ThreadPoolExecutor(workers) as pool:
        states, outputs = zip(*pool.map(one, parts), strict=True)
    return np.concatenate(states)[:runs], np.concatenate(outputs)[:runs]


@eqx.filter_jit
def _march(
    model: DFSM, x0: Array, psi0: Array, h: Array, inputs: Array
) -> tuple[jax.Array, jax.Array]:
    model = model.prepared()

    def step(x: jax.Array, drive: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        dt, v0, vm, v1 = drive
        k1 = _slope(model, x, v0)
        k2 = _slope(model, x + 0.5 * dt * k1, vm)
        k3 = _slope(model, x + 0.5 * dt * k2, vm)
        k4 = _slope(model, x + dt * k3, v1)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x, x

    def states(x0: jax.Array, h: jax.Array, v: jax.Array) -> jax.Array:
        _, xs = jax.lax.scan(step, x0, (h, v[:-2:2], v[1::2], v[2::2]), unroll=_UNROLL)
        return jnp.concatenate([x0[None], xs])

    xs = jax.vmap(states)(*map(jnp.asarray, (x0, h, inputs)))
    return xs, _observe(model, jnp.asarray(h), xs, jnp.asarray(inputs)[:, ::2], jnp.asarray(psi0))


def exogenous_groups(model: DFSM, v: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Controls, disturbances and parameters in a vector of exogenous inputs."""
    n_u, n_w = len(model.signals.controls), len(model.signals.disturbances)
    return v[..., :n_u], v[..., n_u : n_u + n_w], v[..., n_u + n_w :]


def _slope(model: DFSM, x: jax.Array, v: jax.Array) -> jax.Array:
    return model.derivative(x, *exogenous_groups(model, v))


def _observe(model: DFSM, h: jax.Array, xs: jax.Array, v: jax.Array, psi0: jax.Array) -> jax.Array:
    """Outputs along rollouts ``(..., time, n)``; the azimuth is the integral of their own speed."""
    turn, psi = model.signals.azimuth_rate, None
    if turn is not None:
        omega = turn[1] * xs[..., turn[0]]
        angle = jnp.cumsum(0.5 * h * (omega[..., 1:] + omega[..., :-1]), axis=-1)
        psi = psi0[..., None] + jnp.concatenate([jnp.zeros_like(omega[..., :1]), angle], axis=-1)
    return model.output(xs, *exogenous_groups(model, v), psi)


# -- adaptive steps -----------------------------------------------------------------------------


def adapt(
    model: DFSM, mesh: Mesh, x0: Array, psi0: float, method: str, tolerances: tuple[float, float]
) -> Rollout:
    """Integrate one run with diffrax.

    Parameters
    ----------
    model
        The surrogate.
    mesh
        From `mesh_of`; the inputs vary linearly between its points.
    x0, psi0
        Initial states ``(state,)`` and azimuth in rad.
    method
        ``"tsit5"`` or ``"kvaerno5"`` (stiff).
    tolerances
        Relative, and absolute in standard deviations of each state.
    """
    rows = mesh.samples
    # Tolerances as arrays: a Python number would be compiled in, and another compile again.
    rtol, atol = map(jnp.asarray, tolerances)
    states, outputs, solved = _adapt(
        model,
        mesh.time,
        mesh.inputs,
        jnp.asarray(x0),
        jnp.asarray(psi0),
        rtol,
        atol,
        method=method,
        every=mesh.every,
    )
    return Rollout(np.asarray(states), np.asarray(outputs), mesh.inputs[rows], bool(solved))


@eqx.filter_jit
def _adapt(
    model: DFSM,
    time: Array,
    inputs: Array,
    x0: jax.Array,
    psi0: jax.Array,
    rtol: jax.Array,
    atol: jax.Array,
    *,
    method: str,
    every: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    import diffrax

    path = diffrax.LinearInterpolation(jnp.asarray(time), jnp.asarray(inputs))
    n_uw = len(model.signals.controls) + len(model.signals.disturbances)
    spread = model.region.std[n_uw : n_uw + len(model.signals.states)]
    spread = jnp.where(spread > 0, spread, 1.0)
    term = diffrax.ODETerm(lambda t, z, _: _slope(model, z * spread, path.evaluate(t)) / spread)
    samples = jnp.asarray(time[:: 2 * every])
    solution = diffrax.diffeqsolve(
        term,
        diffrax.Tsit5() if method == "tsit5" else diffrax.Kvaerno5(),
        t0=samples[0],
        t1=samples[-1],
        dt0=None,
        # Scaled by their spread all states share one absolute tolerance.
        y0=x0 / spread,
        saveat=diffrax.SaveAt(ts=samples),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
        max_steps=_MAX_STEPS,
        throw=False,
    )
    states = jnp.asarray(solution.ys) * spread
    v = jnp.asarray(inputs[:: 2 * every])
    outputs = _observe(model, jnp.diff(samples), states, v, psi0)
    return states, outputs, solution.result == diffrax.RESULTS.successful

"""What the integrators behind `simulate` share, RK4 that JAX can follow, and adaptive steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.between import Between, polynomials
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM
from dfsm.numerics.runge_kutta import rk4_step
from dfsm.simulation.inputs import Pieces, each, pieces_of

__all__ = [
    "Case",
    "Drive",
    "Mesh",
    "Pieces",
    "Rollout",
    "adapt",
    "mesh_of",
    "pieces_of",
    "rk4",
    "stages",
    "stages_of",
    "stepped",
]

# Bends are padded to a multiple of this, so that runs with as many or a few more share a
# compilation.
_PAD = 1000
_MAX_STEPS = 1_000_000
# Fixed steps of one run.
_MOST_STEPS = 10_000_000


@dataclass(frozen=True)
class Mesh:
    """Samples of a run to march along and the inputs there.

    Attributes
    ----------
    time
        Samples in s, ``(sample,)``.
    values
        Controls, disturbances and parameters there, ``(sample, exogenous)``.
    kinds
        What each of them does between samples.
    every
        Steps per interval between samples.
    """

    time: Array
    values: Array
    kinds: tuple[Between, ...]
    every: int

    @property
    def steps(self) -> int:
        """Number of steps."""
        return self.every * (len(self.time) - 1)

    @property
    def splines(self) -> tuple[int, ...]:
        """Which inputs are splines."""
        return tuple(i for i, kind in enumerate(self.kinds) if kind == "cubic")

    def bends(self) -> Array:
        """Their coefficients of the powers three to one of the time since the sample before.

        Shape ``(3, sample - 1, spline)``.
        """
        values = self.values[:, list(self.splines)]
        return polynomials(self.time, values, ("cubic",) * values.shape[1])[:3]


Drive = TypeVar("Drive", Mesh, Pieces)
# Length of a step, and exogenous inputs at its start, middle and end.
_Drive = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
Stages = tuple[jax.Array, jax.Array, jax.Array]


@dataclass(frozen=True)
class Case(Generic[Drive]):
    """Where a rollout starts and what drives it.

    Attributes
    ----------
    drive
        Times and inputs.
    x0
        Initial states ``(state,)``.
    psi0
        Initial azimuth in rad.
    field
        Harmonics of the wind field for the outputs, at the samples of the run,
        ``(sample, channel)``.
    """

    drive: Drive
    x0: Array
    psi0: float
    field: Array


@dataclass(frozen=True)
class Rollout:
    """What a rollout gives at the run's samples.

    Attributes
    ----------
    states, outputs
        Shapes ``(sample, state)`` and ``(sample, output)``.
    outside
        Whether any input is outside its training range, ``(sample,)``.
    distance
        Squared distance from the training data, ``(sample,)``, see `Region.distance`.
    solved
        Whether the solver reached the end.
    """

    states: Array
    outputs: Array
    outside: Array
    distance: Array
    solved: bool


def mesh_of(driven: Trajectory, step: float | None, between: Between | Sequence[Between]) -> Mesh:
    """Divide the intervals between samples into steps.

    Parameters
    ----------
    driven
        The exogenous channels of one run.
    step
        Largest step in s; None makes one step per sample.
    between
        What inputs do between samples: one kind for all, or one each.

    Raises
    ------
    DfsmError
        So small a step that there would be more than can be waited for.
    """
    longest, intervals = float(np.diff(driven.time).max()), len(driven) - 1
    parts = 1.0 if step is None else longest / step * (1 - 1e-9)
    if parts > 1 and parts * intervals > _MOST_STEPS:
        # A little more than the smallest, so that the rounded figure is allowed too.
        least = 1.01 * longest / max(1, _MOST_STEPS // intervals)
        raise DfsmError(
            f"{driven.where}: steps of {step:g} s over {driven.duration:g} s make "
            f"{parts * intervals:.3g} steps, at most {_MOST_STEPS:,} are allowed: choose a step "
            f"of at least {least:.3g} s, or a shorter time window"
        )
    every = max(1, int(np.ceil(parts)))
    return Mesh(driven.time, driven.values, each(driven, between), every)


def stages_of(driven: Trajectory, between: Sequence[Between], every: int) -> tuple[Array, ...]:
    """Inputs at the start, the middle and the end of `every` steps per interval.

    Parameters
    ----------
    driven, between
        As for `mesh_of`.
    every
        Steps per interval.

    Returns
    -------
    tuple of ndarray
        Three of shape ``(interval, every, exogenous)``.
    """
    d, c, b, a = polynomials(driven.time, driven.values, each(driven, between))[:, :, None]
    step = np.diff(driven.time)[:, None, None] / every
    begin = step * np.arange(every)[:, None]
    times = (begin, begin + step / 2, begin + step)
    return tuple(a + t * (b + t * (c + t * d)) for t in times)


# -- fixed steps --------------------------------------------------------------------------------


def stepped(
    model: DFSM,
    x: jax.Array,
    psi: jax.Array,
    h: float | jax.Array,
    drive: tuple[jax.Array, ...],
) -> tuple[jax.Array, jax.Array]:
    """States and azimuth one step of classical RK4 on; `drive` as in `rk4_step`."""
    new, _ = rk4_step(partial(rate, model), x, h, (drive[0], drive[1], drive[2]))
    turn = model.signals.azimuth_rate
    if turn is not None:
        psi = psi + 0.5 * h * turn[1] * (x[turn[0]] + new[turn[0]])
    return new, psi


def stages(v: jax.Array, held: NDArray[np.bool_] | jax.Array | None) -> Stages:
    """Inputs at the start, the middle and the end of every step, each ``(step, exogenous)``.

    Parameters
    ----------
    v
        At ends and middles, ``(2 step + 1, exogenous)``.
    held
        Which are the same throughout each step, as in its middle, ``(exogenous,)``; None for none.
    """
    begin, middle, end = v[:-2:2], v[1::2], v[2::2]
    if held is None:
        return begin, middle, end
    return jnp.where(held, middle, begin), middle, jnp.where(held, middle, end)


def rk4(
    model: DFSM, x0: jax.Array, h: jax.Array, drive: Stages, bound: float = np.inf
) -> jax.Array:
    """Classical RK4 over steps of any lengths; JAX can follow it.

    Parameters
    ----------
    model
        The surrogate, best `prepared`.
    x0
        Initial states ``(state,)``.
    h
        Steps in s ``(step,)``; a step of zero changes nothing.
    drive
        Exogenous inputs along the steps, see `stages`.
    bound
        States are held within this many training half-ranges of the range's middle.

    Returns
    -------
    Array
        States at the ends of all steps, ``(step + 1, state)``.
    """
    low, high = clip_range(model, bound)

    def step(x: jax.Array, along: _Drive) -> tuple[jax.Array, jax.Array]:
        x, _ = rk4_step(partial(rate, model), x, along[0], along[1:])
        if np.isfinite(bound):
            x = jnp.clip(x, low, high)
        return x, x

    _, xs = jax.lax.scan(step, x0, (h, *drive))
    return jnp.concatenate([x0[None], xs])


def clip_range(model: DFSM, bound: float) -> tuple[jax.Array, jax.Array]:
    """Lowest and highest states within `bound` training half-ranges of the range's middle."""
    columns = model.signals.state_columns
    low, high = model.region.low[columns], model.region.high[columns]
    middle, reach = (low + high) / 2, (high - low) / 2 * bound
    return middle - reach, middle + reach


def rate(model: DFSM, x: jax.Array, v: jax.Array) -> jax.Array:
    """f̂ at states ``(state,)`` and exogenous inputs ``(exogenous,)``."""
    return model.derivative(x, *model.signals.order.split_exogenous(v))


def observe(
    model: DFSM,
    h: jax.Array,
    xs: jax.Array,
    drive: tuple[jax.Array, jax.Array],
    psi0: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Outputs along rollouts ``(..., time, n)``, what is outside the training range, distances.

    `drive` are the exogenous inputs and the wind field. The azimuth is the integral of the
    rollout's own speed.
    """
    turn, psi = model.signals.azimuth_rate, None
    if turn is not None:
        omega = turn[1] * xs[..., turn[0]]
        angle = jnp.cumsum(0.5 * h * (omega[..., 1:] + omega[..., :-1]), axis=-1)
        psi = psi0[..., None] + jnp.concatenate([jnp.zeros_like(omega[..., :1]), angle], axis=-1)
    return seen(model, xs, *drive, psi)


def seen(
    model: DFSM, xs: jax.Array, inputs: jax.Array, field: jax.Array, psi: jax.Array | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Outputs ``(..., output)`` at states, exogenous inputs, wind field and azimuth ``(...)``.

    And whether the training range is left there, and the squared distance from the training data,
    both ``(...)``.
    """
    groups = model.signals.order.split_exogenous(inputs)
    return model.output(xs, *groups, psi, field), *model.region.judged(model.join(xs, *groups))


# -- adaptive steps -----------------------------------------------------------------------------


def adapt(model: DFSM, case: Case[Pieces], method: str, tolerances: tuple[float, float]) -> Rollout:
    """Integrate one run with diffrax.

    A step ends wherever the inputs bend: across a bend no method has its order, and while the
    model is at rest the errors by which steps are chosen say nothing about what the inputs do next.

    Parameters
    ----------
    model
        The surrogate.
    case
        Start and inputs.
    method
        ``"tsit5"`` or ``"kvaerno5"`` (stiff).
    tolerances
        Relative, and absolute in standard deviations of each state.
    """
    drive = case.drive
    # At least one, and their number is compiled in: bends beyond the end change nothing.
    bends = np.full((2, (len(drive.bends) // _PAD + 1) * _PAD), np.inf)
    bends[:, : len(drive.bends)] = drive.bends, drive.after
    # Tolerances as arrays: a Python number would be compiled in, and another compile again.
    start = (case.x0, case.psi0, case.field)
    driven = (drive.time, drive.values, drive.starts, drive.coefficients)
    *path, solved = _adapt(
        model,
        tuple(map(from_host, driven)),
        tuple(map(from_host, bends)),
        tuple(map(from_host, tolerances)),
        start=tuple(map(from_host, start)),
        method=method,
    )
    return Rollout(*map(np.asarray, path), solved=bool(solved))


@eqx.filter_jit
def _adapt(
    model: DFSM,
    path: tuple[jax.Array, ...],
    bends: tuple[jax.Array, ...],
    tolerances: tuple[jax.Array, ...],
    *,
    start: tuple[jax.Array, ...],
    method: str,
) -> tuple[jax.Array, ...]:
    import diffrax

    from dfsm.simulation.bends import EndingAtBends

    (samples, values, starts, coefficients), (rtol, atol) = path, tolerances
    x0, psi0, field = start

    def inputs(t: jax.Array) -> jax.Array:
        piece = jnp.maximum(jnp.searchsorted(starts, t, side="right") - 1, 0)
        (d, c, b, a), since = coefficients[:, piece], t - starts[piece]
        return a + since * (b + since * (c + since * d))

    spread = model.region.std[model.signals.state_columns]
    spread = jnp.where(spread > 0, spread, 1.0)
    term = diffrax.ODETerm(lambda t, z, _: rate(model, z * spread, inputs(jnp.asarray(t))) / spread)
    solution = diffrax.diffeqsolve(
        term,
        diffrax.Tsit5() if method == "tsit5" else diffrax.Kvaerno5(),
        t0=samples[0],
        t1=samples[-1],
        dt0=None,
        # Scaled by their spread all states share one absolute tolerance.
        y0=x0 / spread,
        saveat=diffrax.SaveAt(ts=samples),
        stepsize_controller=EndingAtBends(  # its fields; diffrax's bases are abstract
            controller=diffrax.PIDController(rtol=rtol, atol=atol),  # pyright: ignore[reportCallIssue]
            begins=bends[0],
            ends=bends[1],
        ),
        max_steps=_MAX_STEPS,
        # Nobody differentiates backwards through it, and what that needs takes long to trace.
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    states = jnp.asarray(solution.ys) * spread
    seen = observe(model, jnp.diff(samples), states, (values, field), psi0)
    return states, *seen, solution.result == diffrax.RESULTS.successful

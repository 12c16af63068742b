"""The solvers behind `ODESystem`: diffrax for right-hand sides in JAX, SciPy for those in NumPy.

Both are explicit Runge-Kutta methods with adaptive steps that end at the corners of the inputs, so
that no step sees a jump: Tsitouras 5(4) in JAX, Dormand-Prince 8(5,3) in NumPy.
"""

from __future__ import annotations

import os
import time as clock
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.simulators.evaluate import Function, as_jax
from dfsm.simulators.waveforms import Signal

Solved = tuple[Array, float | None]

_MAX_STEPS = 1_000_000
# Steps below this share of the duration are lost in the rounding of time: the solver gives up.
_SMALLEST_STEP = 1e-16


@dataclass(frozen=True)
class Start:
    """What one simulation begins with and is driven by.

    Attributes
    ----------
    initial, parameters
        Shapes ``(state,)`` and ``(parameter,)``.
    controls, disturbances
        Known at every time.
    name
        Of the run.
    """

    initial: Array
    controls: Signal
    disturbances: Signal
    parameters: Array
    name: str

    @property
    def corners(self) -> Array:
        """Where an input is not smooth, in s, increasing, each time once."""
        return np.unique(np.concatenate([self.controls.corners, self.disturbances.corners]))

    def at(self, time: float) -> tuple[Array, Array, Array]:
        """Controls, disturbances and parameters at a time in s."""
        return self.controls(time), self.disturbances(time), self.parameters


# -- JAX ----------------------------------------------------------------------------------------


def solve_jax(
    f: Function, time: Array, starts: Sequence[Start], tolerances: tuple[float, float]
) -> Generator[Solved]:
    """Integrate a right-hand side that JAX can trace, one thread per processor.

    Runs are solved one by one and not as a batch: a batch takes as many steps as its slowest run
    and leaves the processor's cache, which measured ten times slower on long runs. It also makes a
    run independent of its neighbours to the last bit.

    Parameters
    ----------
    f
        ``f(states, controls, disturbances, parameters)``, one sample at a time.
    time
        Samples in s, shape ``(time,)``.
    starts
        One per run.
    tolerances
        Relative and absolute.

    Yields
    ------
    ndarray, None
        States of each run, shape ``(time, state)``, not finite from where the solver gave up. The
        seconds are not known: runs share processors, and the first one compiles.
    """

    def one(start: Start) -> Solved:
        # An accelerator would spend its time on starting the thousands of tiny operations.
        with jax.default_device(jax.devices("cpu")[0]):
            # Tolerances as arrays: a number would be compiled in, and another compile again.
            limits = from_host(tolerances[0]), from_host(tolerances[1])
            drive = (start.controls, start.disturbances, start.parameters)
            states = _integrate(f, time, start.initial, drive, start.corners, limits)
            return np.asarray(states), None

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            # The first run compiles for the others.
            yield one(starts[0])
            yield from pool.map(one, starts[1:])
        finally:
            pool.shutdown(cancel_futures=True)


@eqx.filter_jit
def _integrate(
    f: Function,
    time: Array,
    initial: Array,
    drive: tuple[Signal, Signal, Array],
    corners: Array,
    tolerances: tuple[jax.Array, jax.Array],
) -> jax.Array:
    import diffrax

    controls, disturbances, parameters = drive
    samples = jnp.asarray(time)
    term = diffrax.ODETerm(
        lambda t, x, _: as_jax(f(x, controls(t), disturbances(t), jnp.asarray(parameters)))
    )
    controller: diffrax.AbstractStepSizeController = diffrax.PIDController(
        rtol=tolerances[0],
        atol=tolerances[1],
        dtmin=_SMALLEST_STEP * (samples[-1] - samples[0]),
        force_dtmin=False,
    )
    if len(corners):
        controller = diffrax.ClipStepSizeController(controller, jump_ts=jnp.asarray(corners))
    solution = diffrax.diffeqsolve(
        term,
        # Not Dopri8: between its steps diffrax is a thousand times less accurate than at them.
        diffrax.Tsit5(),
        t0=samples[0],
        t1=samples[-1],
        dt0=None,
        y0=jnp.asarray(initial),
        saveat=diffrax.SaveAt(ts=samples),
        stepsize_controller=controller,
        max_steps=_MAX_STEPS,
        # Nobody differentiates backwards through it, and what that needs takes long to trace.
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    return jnp.asarray(solution.ys)


# -- NumPy --------------------------------------------------------------------------------------


def solve_numpy(
    f: Function, time: Array, starts: Sequence[Start], tolerances: tuple[float, float]
) -> Generator[Solved]:
    """Integrate a right-hand side in NumPy or plain Python, one run after the other.

    Parameters
    ----------
    f, time, starts, tolerances
        As for `solve_jax`.

    Yields
    ------
    ndarray, float
        States as from `solve_jax`, and the seconds it took.
    """
    for start in starts:
        # A state on its way to infinity overflows; the caller is told by the values.
        with np.errstate(all="ignore"):
            begin = clock.perf_counter()
            states = _solve_segments(f, time, start, tolerances)
        yield states, clock.perf_counter() - begin


def _solve_segments(
    f: Function, time: Array, start: Start, tolerances: tuple[float, float]
) -> Array:
    from scipy.integrate import solve_ivp

    states = np.full((len(time), len(start.initial)), np.nan)
    states[0] = x = start.initial
    corners = start.corners
    inside = corners[(corners > time[0]) & (corners < time[-1])]
    for begin, end in pairwise([time[0], *inside, time[-1]]):
        # At its end a segment still has the inputs from before the jump there.
        last = np.nextafter(end, begin)

        def slope(t: float, x: Array, last: float = last) -> Array:
            return np.asarray(f(x, *start.at(min(t, last))), dtype=np.float64)

        if not np.isfinite(slope(begin, x)).all():
            break  # SciPy would search for a first step for ever
        rows = (time > begin) & (time <= end)
        solution = solve_ivp(
            slope,
            (begin, end),
            x,
            method="DOP853",
            t_eval=np.unique([*time[rows], end]),
            rtol=tolerances[0],
            atol=tolerances[1],
        )
        solved = solution.y.T[: rows.sum()]
        states[np.flatnonzero(rows)[: len(solved)]] = solved
        if not solution.success:
            break
        x = solution.y[:, -1]
    return states

"""Latent states: unmeasured states with stable linear dynamics of their own, driven by the inputs.

    ζ̇ = λ ζ + b·v,      λ = -σ - iω,      v = [u, w]

Each complex ζ is a damped pair of real states (Re ζ, Im ζ). They remember what the measured states
cannot: an inflow that settles, waves that went by. Nothing measured drives them, so a recorded run
tells their value at any time from its inputs alone, and they are stable whatever is learned.

In a model they are the last states, with rows that do not depend on the schedule; everything that
evaluates a model treats them like any other state. Induced velocities stand before them and follow
the measured states, too: see `wakes`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from dfsm.core.host import from_host
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.past import repeated_until, with_past
from dfsm.models.terms import Terms
from dfsm.models.terms.form import Schedule
from dfsm.models.wakes import settled_wakes
from dfsm.models.wider import with_more_states, with_range

# Step counts are padded to a multiple of this, so that runs of similar length share a compilation.
_PAD = 1000


class Poles(NamedTuple):
    """Dynamics of the latent pairs.

    Attributes
    ----------
    decay, frequency
        σ in 1/s and ω in rad/s, shape ``(pair,)``.
    drive
        b, complex, shape ``(pair, control + disturbance)``.
    offset
        What is added to b·v, complex, shape ``(pair,)``.
    """

    decay: jax.Array
    frequency: jax.Array
    drive: jax.Array
    offset: jax.Array


@eqx.filter_jit
def poles(model: DFSM) -> Poles:
    """Dynamics of a model's latent pairs."""
    driving, first, even, odd = _places(model)
    L, b = model.f.coefficients[0], model.f.offsets[0]
    return Poles(
        -L[even, first + even],
        L[even, first + odd],
        L[even, driving] + 1j * L[odd, driving],
        b[even] + 1j * b[odd],
    )


def with_poles(model: DFSM, dynamics: Poles) -> DFSM:
    """The model with other dynamics of its latent pairs; JAX can follow it."""
    return replace(model, f=_with_poles(model, dynamics))


# Not the model: compiled code would hand out the provenance of the first.
@eqx.filter_jit
def _with_poles(model: DFSM, dynamics: Poles) -> LinearModel:
    driving, first, even, odd = _places(model)
    L, b = model.f.coefficients, model.f.offsets
    for rows, others, sign, part in ((even, odd, 1.0, jnp.real), (odd, even, -1.0, jnp.imag)):
        L = L.at[:, rows, first + rows].set(-dynamics.decay)
        L = L.at[:, rows, first + others].set(sign * dynamics.frequency)
        L = L.at[:, rows, driving].set(part(dynamics.drive))
        b = b.at[:, rows].set(part(dynamics.offset))
    return replace(model.f, coefficients=L, offsets=b)


def _places(model: DFSM) -> tuple[slice, int, IntArray, IntArray]:
    """Columns that drive the pairs, the states' first, and rows of real and imaginary parts."""
    s = model.signals
    rows = np.arange(s.marched, len(s.states))
    return s.order.driving_columns, s.state_columns.start, rows[::2], rows[1::2]


@jax.jit
def evolve(
    dynamics: Poles, h: jax.Array, v: jax.Array, rest: jax.Array, ends: jax.Array | None = None
) -> jax.Array:
    """Follow the latent pairs along inputs that vary linearly within each step.

    Parameters
    ----------
    dynamics
        The dynamics.
    h
        Steps in s ``(step,)``; a step of zero changes nothing.
    v
        Controls and disturbances at the ends of the steps, ``(step + 1, control + disturbance)``.
    rest
        The pairs start at rest under these, ``(control + disturbance,)``.
    ends
        Inputs at the end of each step as it comes, ``(step, control + disturbance)``, where some
        jump between steps: `v` then holds those at its beginning. None where none does.

    Returns
    -------
    Array
        Complex, ``(step + 1, pair)``.
    """
    rate = -dynamics.decay - 1j * dynamics.frequency
    x = h[:, None] * rate
    # exp(x) and the weights of both ends to the order of RK4, which marches the other states.
    growth = 1 + x * (1 + x / 2 * (1 + x / 3 * (1 + x / 4)))
    end = h[:, None] * (1 / 2 + x / 6 + x**2 / 24)
    begin = h[:, None] * (1 + x / 2 + x**2 / 6 + x**3 / 24) - end
    force = v @ dynamics.drive.T + dynamics.offset
    last = force[1:] if ends is None else ends @ dynamics.drive.T + dynamics.offset
    added = begin * force[:-1] + end * last
    start = -(dynamics.drive @ rest + dynamics.offset) / rate

    def step(z: jax.Array, terms: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        z = terms[0] * z + terms[1]
        return z, z

    _, path = jax.lax.scan(step, start, (growth, added))
    return jnp.concatenate([start[None], path])


@jax.jit
def as_states(pairs: jax.Array) -> jax.Array:
    """Real states ``(..., 2 pair)`` in a model's order from complex pairs ``(..., pair)``."""
    both = jnp.stack([pairs.real, pairs.imag], axis=-1)
    return both.reshape(*pairs.shape[:-1], -1)


@eqx.filter_jit
def at_rest(model: DFSM, inputs: jax.Array) -> jax.Array:
    """Input vectors ``(..., input)`` with the latent states that their own inputs lead to."""
    s = model.signals
    if not s.latents or s.startup:
        return inputs
    dynamics = poles(model)
    force = inputs[..., s.order.driving_columns] @ dynamics.drive.T + dynamics.offset
    pairs = as_states(force / (dynamics.decay + 1j * dynamics.frequency))
    return settled_wakes(model, inputs.at[..., s.pair_columns].set(pairs))


def latent_path(model: DFSM, run: Trajectory) -> Array:
    """Latent pairs along the recorded inputs of a run, as states.

    Parameters
    ----------
    model
        The surrogate.
    run
        Holds its controls and disturbances, from as long before the time of interest as possible;
        before that they are taken to have been as `with_past` says.

    Returns
    -------
    ndarray
        Shape ``(time, 2 pair)``.

    Raises
    ------
    DfsmError
        A channel is missing or not finite.
    """
    if not model.signals.pairs:
        return np.zeros((len(run), 0))
    held = _held(model)
    inputs, count, mean = with_past(run.select(model.signals.driving).require_finite(), held)
    padded = -(-(len(inputs) - 1) // _PAD) * _PAD
    h = np.zeros(padded)
    h[: len(inputs) - 1] = np.diff(inputs.time)
    more = padded + 1 - len(inputs)
    v = np.concatenate([inputs.values, np.repeat(inputs.values[-1:], more, 0)])
    ends = from_host(np.where(held, v[:-1], v[1:])) if held.any() else None
    path = as_states(evolve(poles(model), h, v, mean, ends))
    return np.asarray(path)[count : count + len(run)]


def _held(model: DFSM) -> NDArray[np.bool_]:
    """Which controls and disturbances are held between samples."""
    s = model.signals
    return np.array([kind == "hold" for kind in s.between_samples()[: len(s.driving)]], dtype=bool)


def latents_at(model: DFSM, run: Trajectory, time: Array) -> Array:
    """Latent pairs at times in s within a run, ``(time, 2 pair)``; see `latent_path`."""
    time = np.clip(time, run.time[0], run.time[-1])
    both = np.union1d(run.time, time)
    inputs = run.select(model.signals.driving)
    fine, held = inputs.resample(both), _held(model)
    if held.any():
        last = inputs.values[np.searchsorted(run.time, both, side="right") - 1]
        fine = replace(fine, values=np.where(held, last, fine.values))
    path = latent_path(model, fine)
    return path[np.searchsorted(both, time)]


def latent_state(model: DFSM, run: Trajectory, start: float) -> Array:
    """Latent pairs at a time in s, shape ``(2 pair,)``, from the inputs recorded up to it.

    Near the beginning of the record what comes after it counts, too, see `with_past`. The arguments
    are those of `latent_path`.
    """
    if not model.signals.pairs:
        return np.empty(0)
    now = max(1, int(np.searchsorted(run.time, start, side="right")))
    end = max(now, repeated_until(run.time) + 1)
    inputs = run.select(model.signals.driving)
    # A fault of the record that comes later spoils nothing.
    faults = np.flatnonzero(~np.isfinite(inputs.values[now:end]).all(axis=1))
    end = max(2, now + faults[0]) if faults.size else end
    inputs = replace(inputs, time=inputs.time[:end], values=inputs.values[:end])
    return latent_path(model, inputs)[now - 1]


# -- adding them to a model ---------------------------------------------------------------------


def add_latents(
    model: DFSM,
    dynamics: Poles,
    coupling: Array,
    paths: Sequence[Array],
    gains: Mapping[int, Array] | None = None,
) -> DFSM:
    """A model with latent states in addition.

    Parameters
    ----------
    model
        Has none but perhaps induced velocities.
    dynamics
        Their dynamics.
    coupling
        What one unit of each adds to the derivatives of the other states,
        ``(state, 2 pair)``.
    paths
        Their values along the training runs, each ``(time, 2 pair)``.
    gains
        What one unit of each adds to the first signal of some known terms, by the term's place,
        ``(2 pair,)``.
    """
    s, count = model.signals, coupling.shape[1]
    at = s.state_columns.stop
    names = tuple(Channel(f"latent{k + 1}", "-") for k in range(count))
    wide = with_more_states(model, names, coupling, paths)
    # They reach a balance of known torques through its term.
    known = {(row, c) for row in model.balances for c in range(at, at + count)}
    f = replace(wide.f, known=tuple(sorted({*wide.f.known, *known})))
    wide = replace(wide, f=f, terms=_reached(wide, at, names, gains or {}))
    return with_poles(wide, dynamics)


def _reached(
    wide: DFSM, at: int, names: Sequence[Channel], gains: Mapping[int, Array]
) -> Terms | None:
    """The terms, some of which latent states reach."""
    if wide.terms is None:
        return None
    schedule, parts = Schedule(wide.f.schedule, np.asarray(wide.f.grid)), list(wide.terms.parts)
    for place, weights in gains.items():
        parts[place] = parts[place].with_latents([c.name for c in names], at, weights, schedule)
    return replace(wide.terms, parts=tuple(parts))


def with_latent_range(model: DFSM, paths: Sequence[Array]) -> DFSM:
    """The model with the training range of its latent states taken from their paths."""
    s = model.signals
    region = with_range(model.region, s.latent_columns, paths)
    return replace(model, region=replace(region, operating=at_rest(model, region.operating)))

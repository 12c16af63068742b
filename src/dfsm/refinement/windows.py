"""Windows of a run, and where rollouts over them start.

Measured states start as recorded. Latent pairs and the wakes of rotors follow from the record
before a window, by the model's own parameters, in which they therefore have slopes.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array, IntArray
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import as_states, evolve, poles
from dfsm.models.wakes import wake_targets, wakes_along, wakes_following
from dfsm.refinement.parameters import Parametrization
from dfsm.refinement.record import Record
from dfsm.refinement.slopes import pairs_along, pairs_at_rest


class Windows(NamedTuple):
    """The windows of one run.

    Attributes
    ----------
    step
        In s.
    states
        Shape ``(window, time, state)``.
    inputs
        At ends and middles, ``(window, 2 time - 1, exogenous)``.
    first
        Steps from the start of the record to that of each window.
    record, rest
        Controls and disturbances of the record at the ends of all steps, and before these.
    held, record_ends
        As `Record.held`, and what `Record.driving` says of the record.
    before, along
        Steps of the record before its first state, and from there on the states
        ``(time, state)`` and the exogenous inputs; None for a model without induced velocities.
    """

    step: float
    states: Array
    inputs: Array
    first: IntArray
    record: Array
    rest: Array
    held: NDArray[np.bool_] | None
    record_ends: Array | None
    before: int
    along: tuple[Array, Array] | None


def windows_of(record: Record, length: float | None, *, wakes: bool) -> Windows:
    """Windows of one run.

    Parameters
    ----------
    record
        The run.
    length
        Of the windows in s; None takes the whole run.
    wakes
        Whether the model has induced velocities.
    """
    steps = len(record.states) - 1
    each = steps if length is None else min(steps, round(length / record.step))
    first = np.arange(0, steps - each + 1, each)
    begin = 2 * (first + record.before)
    driving, ends = record.driving()
    return Windows(
        record.step,
        np.stack([record.states[i : i + each + 1] for i in first]),
        np.stack([record.inputs[i : i + 2 * each + 1] for i in begin]),
        first + record.before,
        driving,
        record.rest,
        record.held,
        ends,
        record.before,
        (record.states, record.inputs[2 * record.before :: 2]) if wakes else None,
    )


def starts(model: DFSM, windows: Windows) -> jax.Array:
    """States at the start of every window; latent ones follow from the inputs before it."""
    measured, first = jnp.asarray(windows.states[:, 0]), windows.first
    if not model.signals.latents:
        return measured
    path = _latent_path(model, windows)
    if windows.along is None:
        return jnp.concatenate([measured, path[first]], axis=1)
    before, (states, inputs) = windows.before, map(jnp.asarray, windows.along)
    wakes = wakes_along(model, windows.step, states, inputs, path[before:])
    return jnp.concatenate([measured, wakes[first - before], path[first]], axis=1)


def _latent_path(model: DFSM, windows: Windows) -> jax.Array:
    """Latent pairs along the whole record as states, ``(time, latent)``."""
    record = jnp.asarray(windows.record)
    h = jnp.full(len(record) - 1, windows.step)
    ends = None if windows.record_ends is None else jnp.asarray(windows.record_ends)
    return as_states(evolve(poles(model), h, record, jnp.asarray(windows.rest), ends))


def start_slopes(
    parameters: Parametrization, w: jax.Array, windows: Windows
) -> tuple[jax.Array, jax.Array]:
    """Slopes at the starts of the latent pairs and of the marched states, nearly.

    Those of pairs, ``(window, pair, 2, own)``, in their own parameters; those of wakes, which are
    the only marched states that have any, in all, ``(window, marched state, parameter)``.
    """
    model, first = parameters.at(w), windows.first
    s = model.signals
    latent = _latent_path(model, windows)
    pairs = _pair_slopes(parameters, model, windows, latent)
    marched = jnp.zeros((len(first), s.marched, w.size))
    if windows.along is not None:
        # Of the record, what lies before the last of the starts.
        count, length = windows.states.shape[:2]
        last = (count - 1) * (length - 1) + 1
        at, part = first - windows.before, slice(windows.before, windows.before + last)
        along = jax.tree.map(lambda a: jnp.asarray(a)[:last], windows.along)
        columns, wakes = _wake_slopes(parameters, w, windows.step, along, latent[part], pairs[part])
        marched = marched.at[:, len(s.observed) :, columns].set(wakes[at])
    return pairs[first], marched


def _pair_slopes(
    parameters: Parametrization, model: DFSM, windows: Windows, latent: jax.Array
) -> jax.Array:
    """Slopes of the latent pairs along the whole record, ``(time, pair, 2, own)``."""
    if not latent.size:
        return jnp.zeros((len(latent), 0, 2, parameters.latent_columns.shape[1]))
    order, columns = model.signals.order, model.signals.pair_columns

    def along(driving: jax.Array, latent: jax.Array) -> jax.Array:
        inputs = jnp.zeros((*driving.shape[:-1], len(model.signals.inputs)))
        return inputs.at[..., order.driving_columns].set(driving).at[..., columns].set(latent)

    record = jnp.asarray(windows.record)
    ends = record[1:] if windows.record_ends is None else jnp.asarray(windows.record_ends)
    middles = along((record[:-1] + ends) / 2, (latent[:-1] + latent[1:]) / 2)
    start = pairs_at_rest(parameters, model, along(jnp.asarray(windows.rest), latent[0]))
    return pairs_along(parameters, model, windows.step, start, middles)


def _wake_slopes(
    parameters: Parametrization,
    w: jax.Array,
    step: float,
    along: tuple[jax.Array, jax.Array],
    latent: jax.Array,
    pairs: jax.Array,
) -> tuple[IntArray, jax.Array]:
    """Slopes of the wakes along a record, see `wakes_along`.

    They have some in the parameters of terms, and in those of the latent pairs that a rotor feels.

    Returns
    -------
    tuple
        These parameters, and the slopes ``(time, wake, parameter of these)``.
    """
    model, terms, own = parameters.at(w), parameters.term_columns, parameters.latent_columns
    s, (states, exogenous) = model.signals, along
    x = jnp.concatenate([states, jnp.zeros((len(states), s.induced)), latent], axis=1)
    inputs = model.join(x, *s.order.split_exogenous(exogenous))

    def moved(now: jax.Array) -> DFSM:
        return parameters.at(w.at[terms].set(now))

    def target(now: jax.Array, latent: jax.Array, inputs: jax.Array) -> jax.Array:
        return wake_targets(moved(now), inputs.at[s.pair_columns].set(latent))

    def following(now: jax.Array, targets: jax.Array) -> jax.Array:
        return wakes_following(moved(now), step, targets)

    now, targets = w[terms], jax.vmap(partial(wake_targets, model))(inputs)
    # Backwards: a wake has two numbers and dozens of parameters.
    by_time = jax.vmap(jax.jacrev(target, (0, 1)), (None, 0, 0))
    by_term, by_latent = by_time(now, latent, inputs)
    by_pair = by_latent.reshape(*by_latent.shape[:3], -1, 2)
    by_pair = jnp.einsum("trakc,tkcp->trakp", by_pair, pairs)
    slopes = [by_term, by_pair.reshape(*by_term.shape[:3], -1)]

    def follow(direction: jax.Array, slopes: jax.Array) -> jax.Array:
        return jax.jvp(following, (now, targets), (direction, slopes))[1]

    directions = jnp.eye(len(now) + own.size, len(now))
    found = jax.vmap(follow, (0, 3), 2)(directions, jnp.concatenate(slopes, axis=3))
    return np.concatenate([np.arange(terms.start, terms.stop), own.ravel()]), found

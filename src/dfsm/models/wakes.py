"""Induced velocities of rotors as states of a model, see `terms.induction`.

They stand before all other latent states, in rows that hold nothing but the rate that the rotor's
term gives. Where a rollout begins they have settled; along a record they follow what was recorded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM
from dfsm.models.terms import RotorTerm, Terms
from dfsm.models.terms.induction import quickness, share_at_once
from dfsm.models.wider import with_more_states

# Shorter steps, as shares of the lag, change nothing.
_SHORTEST = 1e-9


def _lagging(model: DFSM) -> list[RotorTerm]:
    """Terms with a wake."""
    parts = () if model.terms is None else model.terms.parts
    return [part for part in parts if isinstance(part, RotorTerm) and part.about.lags]


def wake_columns(model: DFSM) -> list[int]:
    """Where the states of its rotors' induced velocities stand in I."""
    return [column for rotor in _lagging(model) for column in rotor.wake_columns]


@eqx.filter_jit
def settled_wakes(model: DFSM, inputs: jax.Array) -> jax.Array:
    """Input vectors ``(..., input)`` with the induced velocities that they lead to."""
    for rotor in _lagging(model):
        settled = jnp.vectorize(rotor.wake, signature="(i)->(),()")(inputs)[0]
        for column in rotor.wake_columns:
            inputs = inputs.at[..., column].set(settled)
    return inputs


def wakes_where(model: DFSM, known: Mapping[str, float]) -> Array:
    """Induced velocities at some inputs, by name, and else in the middle of the training there.

    Returns
    -------
    ndarray
        Shape ``(induced velocity,)``.
    """
    s, region, column = model.signals, model.region, model.f.schedule
    names = [c.name for c in s.inputs]
    inputs = np.array(region.mean)
    if column is not None and (value := known.get(names[column])) is not None:
        inputs = region.usual(np.array([value]))[0]
    for k, name in enumerate(names):
        inputs[k] = known.get(name, inputs[k])
    return np.asarray(settled_wakes(model, jnp.asarray(inputs)))[s.induced_columns]


@eqx.filter_jit
def wakes_along(
    model: DFSM,
    h: jax.Array | float,
    states: jax.Array,
    exogenous: jax.Array,
    pairs: jax.Array,
) -> jax.Array:
    """Induced velocities along a record, settled at first.

    Parameters
    ----------
    model
        The surrogate.
    h
        Steps in s, ``(step,)``, or one for all.
    states, exogenous, pairs
        Measured states, exogenous inputs and latent pairs at their ends, ``(step + 1, n)``; what
        the wake settles to varies linearly in between.

    Returns
    -------
    Array
        Shape ``(step + 1, induced velocity)``.
    """
    s = model.signals
    none = jnp.zeros((len(states), s.induced))
    x = jnp.concatenate([states, none, pairs], axis=1)
    inputs = model.join(x, *s.order.split_exogenous(exogenous))
    return wakes_following(model, h, jax.vmap(partial(wake_targets, model))(inputs))


def wake_targets(model: DFSM, inputs: jax.Array) -> jax.Array:
    """What the wake of every rotor settles to in m/s, and its slow lag in s, ``(rotor, 2)``.

    At one input vector, shape ``(input,)``.
    """
    return jnp.array([rotor.wake(inputs) for rotor in _lagging(model)]).reshape(-1, 2)


def wakes_following(model: DFSM, h: jax.Array | float, targets: jax.Array) -> jax.Array:
    """Induced velocities that follow `wake_targets`, settled at first.

    Parameters
    ----------
    model
        The surrogate.
    h
        Steps in s, ``(step,)``, or one for all.
    targets
        At their ends, ``(step + 1, rotor, 2)``.

    Returns
    -------
    Array
        Shape ``(step + 1, induced velocity)``.
    """
    paths = list[jax.Array]()
    for rotor, target in zip(_lagging(model), jnp.moveaxis(targets, 1, 0), strict=True):
        settled, lags = target[:, 0], target[:, 1]
        slow = _following(settled, lags, h)
        if rotor.about.lags > 1:
            k = share_at_once(rotor.pace, rotor.about.lags)
            quick = quickness(rotor.pace) * lags
            paths.append(_following(k * settled + (1 - k) * slow, quick, h))
        paths.append(slow)
    return jnp.stack(paths, axis=1) if paths else jnp.zeros((len(targets), 0))


def _following(target: jax.Array, lags: jax.Array, h: jax.Array | float) -> jax.Array:
    """What follows a target that is linear within steps with a lag, there at first, ``(time,)``."""
    x = jnp.maximum(h * (1 / lags[1:] + 1 / lags[:-1]) / 2, _SHORTEST)
    kept = jnp.exp(-x)
    mean = -jnp.expm1(-x) / x
    added = (mean - kept) * target[:-1] + (1 - mean) * target[1:]

    def step(w: jax.Array, along: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        w = along[0] * w + along[1]
        return w, w

    path = jax.lax.scan(step, target[0], (kept, added))[1]
    return jnp.concatenate([target[:1], path])


# -- adding them to a model ---------------------------------------------------------------------


def with_wakes(model: DFSM, names: Mapping[int, Sequence[str]], inputs: Array) -> DFSM:
    """A model in which the induced velocities of some rotors are states.

    Parameters
    ----------
    model
        Has no latent states and no outputs yet.
    names
        What the states are called, by place of the rotor's term, in their order.
    inputs
        I of training samples, ``(sample, input)``, which tell the states' range.

    Raises
    ------
    DfsmError
        Another signal has the name of such a state or of its rate.
    """
    terms, s = model.terms, model.signals
    if terms is None or not names:
        return model
    called = [name for states in names.values() for name in states]
    at, count = s.state_columns.stop, len(called)
    taken = {c.name for c in (*s.inputs, *s.outputs, *terms.channels)}
    for name in called:
        if {name, f"{name}_rate"} & taken:
            raise DfsmError(
                f"the induced velocity of a rotor is called '{name}', as another signal is: give "
                "the rotor another 'name'"
            )
    lagging = _with_lags(terms.with_more_inputs(at, count), names, at)
    wide = jnp.asarray(np.insert(inputs, [at] * count, 0.0, axis=1))
    wide = settled_wakes(replace(model, terms=lagging), wide)
    channels = tuple(Channel(name, "m/s") for name in called)
    coupling = np.zeros((len(s.states), count))
    more = with_more_states(model, channels, coupling, [np.asarray(wide[:, at : at + count])])
    more = replace(more, signals=replace(more.signals, induced=count), terms=lagging)
    more = _with_rates(more, terms, names)
    moments = lagging.along(np.asarray(wide))
    lagging = replace(
        lagging, mean=jnp.asarray(moments.mean(axis=0)), std=jnp.asarray(moments.std(axis=0))
    )
    operating = settled_wakes(more, more.region.operating)
    region = replace(more.region, operating=operating)
    return replace(more, terms=lagging, region=region)


def _with_lags(terms: Terms, names: Mapping[int, Sequence[str]], at: int) -> Terms:
    parts = list(terms.parts)
    for place, states in names.items():
        rotor = parts[place]
        if not isinstance(rotor, RotorTerm):
            raise TypeError("only rotors have wakes")
        parts[place] = rotor.lagging(states, at)
        at += len(states)
    return replace(terms, parts=tuple(parts))


def _with_rates(model: DFSM, before: Terms, names: Mapping[int, Sequence[str]]) -> DFSM:
    """The model whose linear fits take the rates, which no other row than their own uses."""
    s, n = model.signals, len(model.signals.inputs)
    ends = np.cumsum([len(part.channels) for part in before.parts])
    # Rates come last of their term; those before it have moved them on.
    places = [n + int(ends[place]) for place, states in names.items() for _ in states]
    L = np.insert(np.asarray(model.f.coefficients), places, 0.0, axis=2)
    columns = [place + k for k, place in enumerate(places)]
    known = {(row, c + sum(p <= c for p in places)) for row, c in model.f.known}
    wakes = range(len(s.observed), s.marched)
    for k, row in enumerate(wakes):
        L[:, row, columns[k]] = 1.0
        known |= {(row, c) for c in range(L.shape[2])}
    hidden = {*range(s.induced_columns.start, s.induced_columns.stop), *columns}
    known |= {(row, c) for row in range(len(s.observed)) for c in hidden}
    f = replace(model.f, coefficients=jnp.asarray(L), known=tuple(sorted(known)))
    return replace(model, f=f)

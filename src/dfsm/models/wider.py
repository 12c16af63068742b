"""Models with more states than they had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from dfsm.core.host import from_host
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region


def with_more_states(
    model: DFSM, channels: Sequence[Channel], coupling: Array, paths: Sequence[Array]
) -> DFSM:
    """A model with more latent states behind its states, whose own derivatives are zero.

    Parameters
    ----------
    model
        The model.
    channels
        The new states.
    coupling
        What one unit of each adds to the derivatives of the other states, ``(state, new state)``.
    paths
        Their values along the training runs, each ``(time, new state)``.
    """
    s, count = model.signals, len(channels)
    at, n = s.state_columns.stop, len(s.states)

    def wider(linear: LinearModel, extra_rows: int) -> LinearModel:
        L = np.insert(np.asarray(linear.coefficients), np.full(count, at), 0.0, axis=2)
        L = np.pad(L, ((0, 0), (0, extra_rows), (0, 0)))
        b = np.pad(np.asarray(linear.offsets), ((0, 0), (0, extra_rows)))
        if extra_rows:
            L[:, :n, at : at + count] = coupling
        schedule = linear.schedule
        return replace(
            linear,
            schedule=schedule + count if schedule is not None and schedule >= at else schedule,
            coefficients=from_host(L),
            offsets=from_host(b),
            known=tuple(sorted((row, c + count if c >= at else c) for row, c in linear.known)),
        )

    return replace(
        model,
        f=wider(model.f, count),
        e=None if model.e is None else model.e.with_more_inputs(at, count),
        g=None if model.g is None else wider(model.g, 0),
        e_g=None if model.e_g is None else model.e_g.with_more_inputs(at, count),
        region=with_range(model.region, slice(at, at), paths),
        signals=replace(s, states=(*s.states, *channels), latents=(*s.latents, *channels)),
        terms=None if model.terms is None else model.terms.with_more_inputs(at, count),
    )


def with_columns(region: Region, at: int, values: Array) -> Region:
    """The region of more inputs, from column `at` on, of which there are samples ``(time, n)``."""
    return with_range(region, slice(at, at), [values])


def with_range(region: Region, gone: slice, paths: Sequence[Array]) -> Region:
    """Ranges and moments of the inputs with those of some columns replaced."""
    z, W = np.concatenate(paths), region.whitening
    place = np.full(z.shape[1], gone.start)
    schedule = region.schedule
    if schedule is not None and schedule >= gone.stop:
        schedule += len(place) - (gone.stop - gone.start)

    def put(values: jax.Array, new: Array) -> jax.Array:
        kept = np.delete(np.asarray(values), gone, axis=-1)
        return from_host(np.insert(kept, place, new, axis=-1))

    return replace(
        region,
        low=put(region.low, z.min(axis=0)),
        high=put(region.high, z.max(axis=0)),
        mean=put(region.mean, z.mean(axis=0)),
        std=put(region.std, z.std(axis=0)),
        operating=put(region.operating, np.tile(z.mean(axis=0), (len(region.grid), 1))),
        # Latent states follow from what was counted already: they add no distance.
        whitening=put(W, np.zeros(len(place))) if W.size else W,
        schedule=schedule,
    )

"""Closed loops with their exact slopes with respect to some of a controller's numbers.

Slopes march beside the loop itself: each step is linearized once, and that is applied to every
direction in turn. Nothing is kept of the past, and a gradient costs about as many loops as there
are numbers; going backwards through the loop, or carrying directions as one array, costs several
times more, since XLA then compiles no loop in one piece.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from dfsm.controllers.gains import with_numbers
from dfsm.models.dfsm import DFSM
from dfsm.simulation.loop import Drive, March, Path
from dfsm.simulation.wires import Wires


@eqx.filter_jit
def roll_with_slopes(
    model: DFSM,
    wires: Wires,
    controller: Any,
    numbers: Mapping[str, jax.Array],
    directions: Sequence[Mapping[str, jax.Array]],
    drive: Drive,
) -> tuple[Path, jax.Array]:
    """Close the loop over one run, and differentiate it.

    Parameters
    ----------
    model, wires, controller, drive
        As for `roll`.
    numbers
        Of the controller, by name: they stand in place of its own.
    directions
        Slopes of these numbers, one mapping per parameter.

    Returns
    -------
    tuple
        The path, and the slopes of observed states, controls and outputs at the ends of plant
        steps, shape ``(parameter, step + 1, channel)``.
    """
    march = March(model.prepared(), wires, drive)
    ways = [dict(direction) for direction in directions]

    def begin(numbers: Any) -> Any:
        return march.begin(with_numbers(controller, numbers))

    def call(numbers: Any, carry: Any, leg: Any) -> Any:
        return march.call(with_numbers(controller, numbers), carry, leg)

    start, along = jax.linearize(begin, dict(numbers))
    slopes = [along(way) for way in ways]

    def step(carry: Any, leg: Any) -> Any:
        at, slopes = carry
        (new, out), along = jax.linearize(lambda n, c: call(n, c, leg), dict(numbers), at)
        moved = [along(way, slope) for way, slope in zip(ways, slopes, strict=True)]
        return (new, [m[0] for m in moved]), (out, [m[1] for m in moved])

    (last, ends), (out, outs) = jax.lax.scan(step, (start, slopes), march.legs)
    count = len(model.signals.observed)

    def shown(last: Any, out: Any) -> tuple[jax.Array, Path]:
        path = march.path(last, out)._replace(outside=None)
        return jnp.concatenate([path.states[:, :count], path.controls, path.outputs], axis=1), path

    _, along, path = jax.linearize(shown, last[0], out, has_aux=True)
    return path, jnp.stack([along(e[0], o) for e, o in zip(ends, outs, strict=True)])

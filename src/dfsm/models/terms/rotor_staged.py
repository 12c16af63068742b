"""A rotor's forces for loops: what is known of the wind first, and splines laid out to be read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dfsm.core.host import from_host
from dfsm.models.terms.rotor_place import lead_time
from dfsm.models.terms.rotor_surface import surface_of_rows
from dfsm.models.terms.rotor_term import RotorTerm
from dfsm.numerics.hats import hats


class StagedRotor(RotorTerm):
    """A `RotorTerm` that evaluates like it, but for the last digits.

    Attributes
    ----------
    rows
        Weights of the splines with both forces side by side, flat.
    shape
        Theirs, ``(cell + 3, pitch cell + 3, 2)``.
    """

    rows: jax.Array
    shape: tuple[int, int, int] = eqx.field(static=True)

    def of_numbers(self, signals: Sequence[jax.Array]) -> jax.Array:
        """Thrust and torque; what disturbances do to the wind comes before what moves in it."""
        about, rest = self.about, list(signals)
        wind, speed, pitch = (rest.pop(0) for _ in range(3))
        moving = about.arm * rest.pop(0) if about.arm is not None else jnp.zeros(())
        if about.surges:
            moving = moving + rest.pop(0)
        if about.overhang is not None:
            rate, distance = rest.pop(0), jnp.asarray(about.overhang)
            if about.lean is not None:
                distance = distance - about.lean * rest.pop(0)
            if about.drifts:
                distance = distance - rest.pop(0)
            moving = moving - lead_time(distance, wind) * rate
        for k in range(self.gains.shape[0]):
            wind = wind + self.gains[k] * rest.pop(0)
        induced = jnp.array([rest.pop(0) for _ in range(about.lags)])
        if latents := self.late.shape[1] - 1:
            late = hats(self.grid_of_late, rest[latents]) @ self.late
            wind = wind + late[-1]
            moving = moving - late[:-1] @ jnp.stack(rest[:latents])
        tips = about.radius * about.speed_factor * speed
        return self.felt((wind - moving, tips, about.pitch_factor * pitch), induced)

    def surface(self, wind: jax.Array, tips: jax.Array, pitch: jax.Array) -> jax.Array:
        """As `RotorTerm.surface`."""
        return surface_of_rows(self.rows, self.shape, self.grid, (wind, tips, pitch))


def staged_rotor(term: RotorTerm) -> StagedRotor:
    """The term as loops take it."""
    rows = np.moveaxis(np.asarray(term.weights), 0, 2)
    parts = {f.name: getattr(term, f.name) for f in fields(RotorTerm)}
    return StagedRotor(**parts, rows=from_host(rows.ravel()), shape=rows.shape)

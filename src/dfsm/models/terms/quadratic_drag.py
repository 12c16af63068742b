"""Quadratic drag: |v| v of a velocity, or of the difference of two."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp

from dfsm.core.settings import settings_class
from dfsm.core.units import agree
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.terms.form import Term
from dfsm.models.terms.inputs import input_columns


@settings_class
class QuadraticDrag:
    """|v| v: the drag of a body, but for its coefficient, which the fit chooses.

    Attributes
    ----------
    velocity
        The channel v.
    against
        Another channel in the same unit that is taken off v, e.g. the velocity of the water.
    name
        What the value is called; ``"drag(v)"`` or ``"drag(v - other)"`` unless one is chosen.
    """

    velocity: str
    against: str | None = None
    name: str | None = None
    kind: Literal["quadratic_drag"] = "quadratic_drag"

    def __post_init__(self) -> None:
        if self.against == self.velocity:
            raise DfsmError(
                f"quadratic_drag.against is '{self.against}', which is the velocity itself: name "
                "the channel that it is relative to, or leave it out"
            )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Channels that it takes."""
        return (self.velocity,) if self.against is None else (self.velocity, self.against)

    def term(
        self,
        channels: Mapping[str, Channel],
        columns: Mapping[str, int],
        spreads: Mapping[str, float] | None = None,  # noqa: ARG002
    ) -> QuadraticDragTerm:
        """The term of a model with these inputs.

        Parameters
        ----------
        channels, columns
            Channel and column in I of every input, by name.
        spreads
            Typical size of every input; not needed here.

        Raises
        ------
        DfsmError
            A channel is no input, or the two have different units.
        """
        taken, at = input_columns(self.kind, self.inputs, channels, columns)
        units = [c.unit for c in taken]
        if len(units) == 2 and not agree(*units):
            raise DfsmError(
                f"{self.kind}: '{self.velocity}' is in '{units[0]}' and '{self.against}' in "
                f"'{units[1]}', expected one unit: convert one of them"
            )
        name = self.name or f"drag({' - '.join(self.inputs)})"
        unit = f"({units[0]})^2" if units[0] else ""
        return QuadraticDragTerm(columns=at, channels=(Channel(name, unit),))


class QuadraticDragTerm(Term):
    """|v| v with v the first signal, less the second if there is one; C¹ where v changes sign."""

    kind = "quadratic_drag"

    def values(self, signals: jax.Array) -> jax.Array:
        """The value at one sample, shape ``(signal,)`` to ``(1,)``."""
        v = signals[0] if len(self.columns) == 1 else signals[0] - signals[1]
        return (v * jnp.abs(v))[None]

    def structure(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    @classmethod
    def restored(
        cls,
        columns: tuple[int, ...],
        channels: tuple[Channel, ...],
        arrays: Mapping[str, jax.Array],  # noqa: ARG003
        structure: Mapping[str, Any],  # noqa: ARG003
    ) -> QuadraticDragTerm:
        """The term on these columns."""
        return cls(columns=columns, channels=channels)

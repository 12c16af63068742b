"""Products of inputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp

from dfsm.core.settings import require, settings_class
from dfsm.data.trajectory import Channel
from dfsm.models.terms.form import Term
from dfsm.models.terms.inputs import input_columns


@settings_class
class Product:
    """The product of two or more channels.

    Attributes
    ----------
    factors
        Channel names; one that stands there twice is squared.
    name
        What the value is called; the factors with ``*`` between them unless one is chosen.
    """

    factors: tuple[str, ...]
    name: str | None = None
    kind: Literal["product"] = "product"

    def __post_init__(self) -> None:
        told = ", ".join(self.factors) or "empty"
        require(len(self.factors) > 1, "product.factors", told, "two channels or more")

    @property
    def inputs(self) -> tuple[str, ...]:
        """Channels that it takes, one that is squared twice."""
        return self.factors

    def term(
        self,
        channels: Mapping[str, Channel],
        columns: Mapping[str, int],
        spreads: Mapping[str, float] | None = None,  # noqa: ARG002
    ) -> ProductTerm:
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
            A channel is no input.
        """
        taken, at = input_columns(self.kind, self.factors, channels, columns)
        unit = _joined(c.unit for c in taken if c.unit)
        return ProductTerm(
            columns=at, channels=(Channel(self.name or _joined(self.factors), unit),)
        )


def _joined(texts: Any) -> str:
    """``a*b^2`` of a, b and b; what is made of several parts itself stands in brackets."""
    parts = []
    for text, power in Counter(texts).items():
        whole = text if text.isalnum() or (power == 1 and "/" not in text) else f"({text})"
        parts.append(whole + (f"^{power}" if power > 1 else ""))
    return "*".join(parts)


class ProductTerm(Term):
    """The product of all signals."""

    kind = "product"

    def values(self, signals: jax.Array) -> jax.Array:
        """The value at one sample, shape ``(signal,)`` to ``(1,)``."""
        # Not jnp.prod, whose derivative costs more than the factors written out.
        value = signals[0]
        for i in range(1, len(self.columns)):
            value = value * signals[i]
        return jnp.reshape(value, 1)

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
    ) -> ProductTerm:
        """The term on these columns."""
        return cls(columns=columns, channels=channels)

"""What an instrument makes of a state that nobody sees as it is: a term of the output function."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax

from dfsm.data.trajectory import Channel
from dfsm.models.terms.form import Term

Sensing = Literal["direct", "absolute", "square", "clipped"]


class Sensor(NamedTuple):
    """An instrument: hashable, so that compiled code knows it.

    Attributes
    ----------
    sensing
        ``"absolute"`` and ``"square"`` lose the sign, ``"clipped"`` ends at `low` and `high`.
    low, high
        Ends of the range of a clipped one.
    up
        Where the sign is lost, 1 or -1: whether more is seen, or less, the farther x is from zero.
    """

    sensing: Sensing = "direct"
    low: float = -math.inf
    high: float = math.inf
    up: int = 1

    @property
    def folds(self) -> bool:
        """Whether the sign is lost."""
        return self.sensing in ("absolute", "square")

    def seen(self, x: Any) -> Any:
        """What is seen of states of any shape, arrays of NumPy or JAX."""
        if self.sensing == "absolute":
            return self.up * abs(x)
        if self.sensing == "square":
            return self.up * x * x
        return x.clip(self.low, self.high) if self.sensing == "clipped" else x

    def behind(self, seen: float) -> tuple[float, float]:
        """The two values of a state that are seen like this, or one twice."""
        if not self.folds:
            return seen, seen
        size = max(self.up * seen, 0.0)
        size = size if self.sensing == "absolute" else math.sqrt(size)
        return size, -size


class SensorTerm(Term):
    """What an instrument makes of one signal.

    Attributes
    ----------
    sensor
        The instrument.
    """

    kind = "sensor"
    sensor: Sensor = eqx.field(static=True, default_factory=Sensor)

    def values(self, signals: jax.Array) -> jax.Array:
        """The value at one sample, shape ``(1,)`` to ``(1,)``."""
        return self.sensor.seen(signals)

    def structure(self) -> dict[str, Any]:
        """The instrument; ends that there are not are left out."""
        told = self.sensor._asdict()
        return {k: v for k, v in told.items() if not (isinstance(v, float) and math.isinf(v))}

    @classmethod
    def restored(
        cls,
        columns: tuple[int, ...],
        channels: tuple[Channel, ...],
        arrays: Mapping[str, jax.Array],  # noqa: ARG003
        structure: Mapping[str, Any],
    ) -> SensorTerm:
        """The term on these columns."""
        if structure["sensing"] not in get_args(Sensing):
            raise ValueError(f"sensing, expected one of {', '.join(get_args(Sensing))}")
        ends = {k: float(structure[k]) for k in ("low", "high") if k in structure}
        up = 1 if structure["up"] > 0 else -1
        sensor = Sensor(structure["sensing"], **ends, up=up)
        return cls(columns=columns, channels=channels, sensor=sensor)

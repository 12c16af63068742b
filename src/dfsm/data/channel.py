"""Channel: what is known about one signal of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from dfsm.errors import printable

Role = Literal["state", "control", "disturbance", "output", "parameter"]


@dataclass(frozen=True)
class Channel:
    """What is known about one signal.

    Attributes
    ----------
    name
        Name as in the file.
    unit
        Unit as in the file, without brackets; never guessed.
    step
        Quantisation step in `unit`, where the file states it (16-bit `.outb`), else None. A
        rounding error is uniform over one step, so its variance is ``step**2 / 12``.
    role
        What the signal is to a model, once that has been chosen.
    computed
        Whether it follows from other channels of the run, up to a processor's rounding.
    """

    name: str
    unit: str = ""
    step: float | None = None
    role: Role | None = None
    computed: bool = False

    @property
    def label(self) -> str:
        """Name and unit as an axis label shows them."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


def labels(channels: Sequence[Channel], most: int = 8) -> str:
    """Names and units of the first channels, for one line of text."""
    shown = ", ".join(printable(c.label) for c in channels[:most])
    return f"{shown}, …" if len(channels) > most else shown or "none"

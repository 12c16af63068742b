"""Systems of our own with the structure of published benchmarks; their hidden states are known.

Two tanks with overflow and an unmeasured upper level; a Duffing oscillator whose input is smooth
between samples; an oscillator with a hidden internal force (Bouc 1967, Wen 1976).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory

# Steps of the integration per sample.
_FINE = 20


@dataclass(frozen=True)
class Twin:
    """A system of which one state is measured.

    Attributes
    ----------
    name, unit
        Of the system, and of what is measured.
    rate
        Derivatives of its states under one input.
    start
        States at the start of a record.
    step
        Between samples in s.
    held
        Whether the input stays between samples, or is smooth.
    level, size
        Mean of the input, and how far it goes from there.
    band
        Highest frequency of the input in Hz.
    highest
        Of the measured state; above, it overflows.
    """

    name: str
    unit: str
    rate: Callable[[Array, float], Array]
    start: tuple[float, ...]
    step: float
    held: bool
    level: float
    size: float
    band: float
    highest: float = np.inf

    def record(self, samples: int, seed: int, noise: float = 0.0) -> Trajectory:
        """One record with channels u and y, from its start under a multisine of its own."""
        rng = np.random.default_rng(seed)
        time = self.step * np.arange(samples)
        rates = 2 * np.pi * np.linspace(self.band / 30, self.band, 30)
        phases = rng.uniform(0, 2 * np.pi, 30)

        def u(t: Array | float) -> Array:
            waves = np.cos(np.multiply.outer(t, rates) + phases).sum(axis=-1)
            return self.level + self.size * waves / np.sqrt(15)

        fine = self.step / _FINE
        x, y = np.array(self.start, dtype=float), np.empty(samples)
        for k, t in enumerate(time):
            y[k] = min(x[0], self.highest)
            for i in range(_FINE):
                begin = t + i * fine
                at = np.full(3, t) if self.held else begin + fine * np.array([0, 0.5, 1])
                x = self._stepped(x, fine, u(at))
        y += noise * rng.standard_normal(samples)
        channels = (Channel("u", "V"), Channel("y", self.unit))
        return Trajectory(time, np.stack([u(time), y], axis=1), channels, name=f"{self.name}{seed}")

    def _stepped(self, x: Array, h: float, v: Array) -> Array:
        k1 = self.rate(x, v[0])
        k2 = self.rate(x + h / 2 * k1, v[1])
        k3 = self.rate(x + h / 2 * k2, v[1])
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + self.rate(x + h * k3, v[2]))


def _tanks(x: Array, u: float) -> Array:
    """Levels of the lower and the upper tank; what the upper spills goes half into the lower."""
    low, high = np.maximum(x, 0.0)
    out = 0.06 * np.sqrt(high)
    spilt = max(0.0, x[1] - 10.0)
    return np.array(
        [out - 0.05 * np.sqrt(low) + 0.1 * spilt - 0.5 * max(0.0, x[0] - 10.0),
         0.05 * u - out - 0.2 * spilt]
    )  # fmt: skip


def _duffing(x: Array, u: float) -> Array:
    w = 2 * np.pi * 68
    return np.array([x[1], w**2 * (u - x[0] - 4.0 * x[0] ** 3) - 0.1 * w * x[1]])


def _bouc_wen(x: Array, u: float) -> Array:
    """Displacement, velocity, and an internal force that lags behind as the motion turns."""
    y, v, z = x
    turning = 0.8 * abs(v) * z - 0.4 * v * abs(z)
    return np.array([v, 2.0 * u - 4.0 * y - 0.3 * v - 2.0 * z, 1.5 * v - turning])


TWINS = {
    twin.name: twin
    for twin in (
        Twin("tanks", "V", _tanks, (4.0, 5.0), 4.0, True, 2.9, 1.6, 0.006, 10.0),
        Twin("duffing", "V", _duffing, (0.0, 0.0), 1 / 610.35, False, 0.0, 0.08, 150.0),
        Twin("bouc_wen", "mm", _bouc_wen, (0.0, 0.0, 0.0), 0.1, False, 0.0, 1.5, 0.8),
    )
}

"""Systems of our own with the structure of published benchmarks; their hidden states are known.

Two tanks with overflow and an unmeasured upper level; a Duffing oscillator whose input is smooth
between samples; an oscillator with a hidden internal force (Bouc 1967, Wen 1976); a nonlinearity
between two filters (Wiener, Hammerstein); three masses of which the last is seen, on a spring that
hardens; two drives and a belt, of which the speed's absolute value is seen; two bodies that
radiate. Defaults of hidden states are judged by them: their test records have no noise.
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
    seen
        What the instrument makes of the first state.
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
    seen: Callable[[float], float] = float

    def record(self, samples: int, seed: int, noise: float = 0.0) -> Trajectory:
        """One record with channels u and y, from its start under a multisine of its own.

        `noise` is that of the instrument, white, relative to the spread of what is seen.
        """
        rng = np.random.default_rng(seed)
        time = self.step * np.arange(samples)
        rates = 2 * np.pi * np.linspace(self.band / 30, self.band, 30)
        phases = rng.uniform(0, 2 * np.pi, 30)

        def u(t: Array) -> Array:
            waves = np.cos(np.multiply.outer(t, rates) + phases).sum(axis=-1)
            return self.level + self.size * waves / np.sqrt(15)

        fine = self.step / _FINE
        begins = np.repeat(time, _FINE) + np.tile(fine * np.arange(_FINE), samples)
        parts = np.zeros(3) if self.held else fine * np.array([0, 0.5, 1])
        held = np.repeat(time, _FINE) if self.held else begins
        drive = u(held[:, None] + parts)
        x, y = np.array(self.start, dtype=float), np.empty(samples)
        for k, v in enumerate(drive):
            if k % _FINE == 0:
                y[k // _FINE] = self.seen(x[0])
            x = self._stepped(x, fine, v)
        y += noise * y.std() * rng.standard_normal(samples)
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


def _overflowing(level: float) -> float:
    return min(level, 10.0)


def _duffing(x: Array, u: float) -> Array:
    w = 2 * np.pi * 68
    return np.array([x[1], w**2 * (u - x[0] - 4.0 * x[0] ** 3) - 0.1 * w * x[1]])


def _bouc_wen(x: Array, u: float) -> Array:
    """Displacement, velocity, and an internal force that lags behind as the motion turns."""
    y, v, z = x
    turning = 0.8 * abs(v) * z - 0.4 * v * abs(z)
    return np.array([v, 2.0 * u - 4.0 * y - 0.3 * v - 2.0 * z, 1.5 * v - turning])


def _wiener_hammerstein(x: Array, u: float) -> Array:
    """A lag, what lets one direction through more easily than the other, and two filters."""
    y, v, w = x
    bent = np.tanh(1.5 * w) + 0.3 * w**2
    return np.array([v, 4.0 * (bent - y) - 1.2 * v, 2.0 * (u - w)])


def _chain(x: Array, u: float) -> Array:
    """Three masses in a row, driven at the first; the last hangs on a spring that hardens."""
    q, v = x[:3], x[3:]
    stretch = q[0] - q[1]
    last = 6.0 * stretch + 3.0 * stretch**3 + 0.3 * (v[0] - v[1])
    middle = 9.0 * (q[1] - q[2]) + 0.3 * (v[1] - v[2])
    first = u - 4.0 * q[2] - 0.4 * v[2]
    return np.array([*v, -last - 2.0 * q[0] - 0.2 * v[0], last - middle, middle + first])


def _drives(x: Array, u: float) -> Array:
    """Two drives, a belt with a pulley: its speed, its acceleration, and that of the drives."""
    speed, rate, drive = x
    return np.array([rate, 25.0 * (drive - speed) - 3.0 * rate, 1.5 * (2.0 * u - drive)])


def _bodies(x: Array, u: float) -> Array:
    """Temperatures of a shell and of the core that heats it, in hundreds of K; both radiate."""
    shell, core = x
    through = 0.004 * (core - shell) + 0.0008 * (core**4 - shell**4) / 100
    return np.array([2.0 * through - 0.00008 * (shell**4 - 81.0), 0.01 * u - through])


TWINS = {
    twin.name: twin
    for twin in (
        Twin("tanks", "V", _tanks, (4.0, 5.0), 4.0, True, 2.9, 1.6, 0.006, _overflowing),
        Twin("duffing", "V", _duffing, (0.0, 0.0), 1 / 610.35, False, 0.0, 0.08, 150.0),
        Twin("bouc_wen", "mm", _bouc_wen, (0.0, 0.0, 0.0), 0.1, False, 0.0, 1.5, 0.8),
        Twin("wiener_hammerstein", "V", _wiener_hammerstein, (0.0,) * 3, 0.2, False, 0.2, 0.8, 0.8),
        Twin("chain", "mm", _chain, (0.0,) * 6, 0.15, False, 0.0, 2.0, 1.0),
        Twin("drives", "V", _drives, (0.5, 0.0, 0.5), 0.05, True, 0.2, 0.6, 1.0, abs),
        Twin("bodies", "100 K", _bodies, (3.2, 4.0), 10.0, True, 1.6, 0.7, 0.004),
    )
}

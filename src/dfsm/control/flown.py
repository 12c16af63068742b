"""Controls as they were commanded and as they were flown, and what lies between them."""

from __future__ import annotations

import numpy as np

from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import printable

# Differences below this share of a control's size are none: printed digits, and mesh to samples.
_SAME = 1e-2
# Shares of a difference that a cause must explain, and of the samples at which it must be seen.
_EXPLAINED, _SEEN = 0.8, 0.02
# Delays are looked for up to this share of the time compared.
_LATEST = 0.1


def commands_told(commanded: Trajectory, flown: Trajectory) -> tuple[str, ...]:
    """Say which controls were flown otherwise than commanded, by how much, and why.

    Parameters
    ----------
    commanded, flown
        The solution and the run at the same times, with the same channels.

    Returns
    -------
    tuple of str
        A sentence for each control that differs by more than 1 % of its size.
    """
    told = []
    for channel in commanded.channels:
        if channel.role != "control":
            continue
        a, b = commanded[channel.name], flown[channel.name]
        size = max(float(np.ptp(a)), _SAME * float(np.abs(a).max()))
        gap = float(np.sqrt(np.mean((b - a) ** 2)))
        slack = _SAME * size + (flown.channel(channel.name).step or 0.0)
        if gap <= slack:
            continue
        unit = f" {channel.unit}" if channel.unit else ""
        told.append(
            f"{printable(channel.name)} was flown otherwise than commanded: rms {gap:.3g}{unit}, "
            f"at most {np.abs(b - a).max():.3g}{unit}; {_why(commanded.time, a, b, slack)}"
        )
    return tuple(told)


def _why(time: Array, a: Array, b: Array, slack: float) -> str:
    """The cause that leaves least of a difference, if it explains most of it."""
    if np.ptp(b) <= 0.1 * slack:
        return (
            f"it stays at {b[0]:.4g} throughout: the controller did not take the file (OL_Mode, "
            "PC_ControlMode 0, column numbers)"
        )
    before = float(np.sqrt(np.mean((b - a) ** 2)))
    offered = [_cut(a, b, slack), _slowed(time, a, b), _late(time, a, b), _shifted(a, b)]
    left, why = min((o for o in offered if o is not None), key=lambda o: o[0])
    if left <= (1 - _EXPLAINED) * before:
        return why
    return "no limit, rate limit, delay or offset alone explains it"


def _cut(a: Array, b: Array, slack: float) -> tuple[float, str] | None:
    """Flown within limits that the command leaves."""
    low, high = float(b.min()), float(b.max())
    below, above = a < low - slack, a > high + slack
    if max(below.mean(), above.mean()) < _SEEN:
        return None
    limits = [f"{low:.4g} from below"] if below.mean() >= _SEEN else []
    limits += [f"{high:.4g} from above"] if above.mean() >= _SEEN else []
    left = float(np.sqrt(np.mean((b - np.clip(a, low, high)) ** 2)))
    return left, f"it was held at {' and '.join(limits)}: a limit of the controller"


def _slowed(time: Array, a: Array, b: Array) -> tuple[float, str] | None:
    """Flown no faster than a rate that the command exceeds."""
    steps = np.diff(time)
    fastest = float(np.quantile(np.abs(np.diff(b) / steps), 0.995))
    if np.mean(np.abs(np.diff(a) / steps) > 1.02 * fastest) < _SEEN:
        return None
    limited = np.empty_like(a)
    limited[0] = b[0]
    for k, step in enumerate(steps):
        most = fastest * step
        limited[k + 1] = limited[k] + np.clip(a[k + 1] - limited[k], -most, most)
    left = float(np.sqrt(np.mean((b - limited) ** 2)))
    return left, f"its rate stays below {fastest:.3g} per second: a rate limit of the controller"


def _late(time: Array, a: Array, b: Array) -> tuple[float, str]:
    """Flown later than commanded: a delay, or an actuator that lags."""
    delays = np.linspace(0, _LATEST * (time[-1] - time[0]), 201)[1:]
    left = [float(np.sqrt(np.mean((b - np.interp(time - d, time, a)) ** 2))) for d in delays]
    k = int(np.argmin(left))
    return left[k], f"it follows about {delays[k]:.3g} s late: an actuator or filter (PA_Mode)"


def _shifted(a: Array, b: Array) -> tuple[float, str]:
    """Flown with an offset."""
    offset = float(np.mean(b - a))
    left = float(np.std(b - a))
    return left, f"it differs by {offset:.4g} throughout: check units and zero of the two"

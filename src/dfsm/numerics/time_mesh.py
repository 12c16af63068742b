"""Time meshes."""

from __future__ import annotations

import numpy as np

from dfsm.core.types import Array


def time_step(time: Array) -> float | None:
    """Sampling interval in s if a mesh is equidistant (to 1e-6 of a step), else None."""
    steps = np.diff(time)
    # A file's times carry rounding of their own, which grows with the time itself.
    slack = 1e-6 * steps.mean() + 4 * np.spacing(np.abs(time).max())
    return float(steps.mean()) if np.ptp(steps) <= slack else None

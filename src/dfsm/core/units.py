"""Units that few places need to understand; everywhere else a unit is a text that must agree."""

from __future__ import annotations

import numpy as np

# What one unit is in rad, N m, kW and rad/s, by the unit as `plain` writes it.
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
TORQUES = {"Nm": 1.0, "kNm": 1e3, "MNm": 1e6}
POWERS = {"W": 1e-3, "kW": 1.0, "MW": 1e3}
SPEEDS = {"rpm": np.pi / 30, "rad/s": 1.0, "deg/s": np.pi / 180}


def plain(unit: str) -> str:
    """A unit without the signs between its factors: 'kN-m', 'kN·m' and 'kN m' are the same."""
    return "".join(c for c in unit if c not in " -·*.")

"""WEC-Sim's ``output``, saved as a struct: what its parts are called, and their units.

Every body, constraint, PTO, cable and mooring has its time and matrices of six columns: three
translations, three rotations. All is in SI, angles in rad. The ``output`` that WEC-Sim leaves in
the workspace is an object, which only MATLAB reads: ``output = struct(output)`` makes it a struct.

Source: WEC-Sim, ``responseClass``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

_SIX = re.compile(r"(position|velocity|acceleration|force|power)(?:[A-Z]\w*)?")
_ELEVATION = re.compile(r"elevation|waveGauge\d+Elevation")
# Of translations and of rotations.
_UNITS = {
    "position": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
    "acceleration": ("m/s^2", "rad/s^2"),
    "force": ("N", "N m"),
    "power": ("W", "W"),
}


def is_wecsim(content: Mapping[str, Any]) -> bool:
    """Whether variables are WEC-Sim's ``output``, or hold it."""
    inside = content.get("output", content)
    bodies = inside.get("bodies") if isinstance(inside, Mapping) else None
    first = bodies[0] if isinstance(bodies, list) and bodies else bodies
    return isinstance(first, Mapping) and {"time", "position", "forceTotal"} <= set(first)


def is_label(value: Any) -> bool:
    """Whether a variable names a part, or is one of the pressures that were not asked for."""
    return isinstance(value, str) or (isinstance(value, np.ndarray) and not value.size)


def wecsim_unit(name: str, column: int, width: int) -> str:
    """Unit of a signal, "" where it is not of the documented ones.

    Parameters
    ----------
    name
        As ``bodies_1.forceTotal``.
    column, width
        Which column of how many, from 0.
    """
    last = name.rsplit(".", 1)[-1]
    if width == 1 and _ELEVATION.fullmatch(last):
        return "m"
    match = _SIX.fullmatch(last) if width == 6 else None
    return _UNITS[match[1]][column // 3] if match else ""

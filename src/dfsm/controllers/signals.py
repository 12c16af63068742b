"""What turbine controllers measure: by role, channel and unit, and the factor to SI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dfsm.core.units import ANGLES, POWERS, SPEEDS, TORQUES, plain
from dfsm.errors import DfsmError, near_matches

_TURNS = {"rad/s^2": 1.0, "deg/s^2": np.pi / 180}
_WATTS = {unit: 1e3 * factor for unit, factor in POWERS.items()}

# Role: channel as OpenFAST calls it, its unit, and what its units are in SI.
_ROLES: dict[str, tuple[str, str, dict[str, float]]] = {
    "generator_speed": ("GenSpeed", "rpm", SPEEDS),
    "rotor_speed": ("RotSpeed", "rpm", SPEEDS),
    "wind": ("RotWind", "m/s", {"m/s": 1.0}),
    "nacelle_pitch_acceleration": ("NcIMURAys", "deg/s^2", _TURNS),
    "nacelle_acceleration": ("YawBrTAxp", "m/s^2", {"m/s^2": 1.0}),
    "power": ("GenPwr", "kW", _WATTS),
    "torque": ("GenTq", "kN-m", TORQUES),
    "pitch": ("BldPitch1", "deg", ANGLES),
}


@dataclass(frozen=True)
class Signals:
    """Channels of some roles.

    Attributes
    ----------
    roles
        What each channel is to the controller.
    names, units
        Channels and their units.
    factors
        What one unit is in SI.
    """

    roles: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    factors: tuple[float, ...]


def signals(roles: Sequence[str], channels: Mapping[str, str | tuple[str, str]]) -> Signals:
    """Channels for roles, OpenFAST's where no other is told.

    Parameters
    ----------
    roles
        In the order in which their values come.
    channels
        Channel, or channel and unit, by role.

    Raises
    ------
    DfsmError
        A role that does not exist, or a unit that is not known for it.
    """
    for role in channels:
        if role not in _ROLES:
            raise DfsmError(f"channels: there is no role '{role}'; {near_matches(role, _ROLES)}")
    names, units, factors = [], [], []
    for role in roles:
        name, unit, known = _ROLES[role]
        told = channels.get(role, name)
        name, unit = (told, unit) if isinstance(told, str) else told
        if plain(unit) not in known:
            raise DfsmError(
                f"channels: {role} '{name}' is in '{unit}', expected one of {', '.join(known)}"
            )
        names.append(name)
        units.append(unit)
        factors.append(known[plain(unit)])
    return Signals(tuple(roles), tuple(names), tuple(units), tuple(factors))

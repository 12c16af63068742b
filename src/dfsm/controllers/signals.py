"""What turbine controllers measure: by role, channel and unit, and the factor to SI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dfsm.core.units import factor
from dfsm.errors import DfsmError, near_matches

# What channels are given as, in the sentences about others.
BY_ROLE = "channels by role, {'wind': 'RotWind'}"
# Role: channel as OpenFAST calls it, its unit, and the unit in SI.
_ROLES: dict[str, tuple[str, str, str]] = {
    "generator_speed": ("GenSpeed", "rpm", "rad/s"),
    "rotor_speed": ("RotSpeed", "rpm", "rad/s"),
    "wind": ("RotWind", "m/s", "m/s"),
    "nacelle_pitch_acceleration": ("NcIMURAys", "deg/s^2", "rad/s^2"),
    "nacelle_acceleration": ("YawBrTAxp", "m/s^2", "m/s^2"),
    "power": ("GenPwr", "kW", "W"),
    "torque": ("GenTq", "kN-m", "N-m"),
    "pitch": ("BldPitch1", "deg", "rad"),
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
        name, unit, si = _ROLES[role]
        told = channels.get(role, name)
        name, unit = (told, unit) if isinstance(told, str) else told
        size = factor(unit, si)
        if size is None:
            raise DfsmError(
                f"channels: {role} '{name}' is in '{unit}', which is no unit like "
                f"{_ROLES[role][1]} or {si}: name another channel, or its right unit"
            )
        names.append(name)
        units.append(unit)
        factors.append(size)
    return Signals(tuple(roles), tuple(names), tuple(units), tuple(factors))

"""From a DISCON.IN to what ROSCO in JAX needs: modes, parameters by key, the rotor's table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.controllers.discon import Discon
from dfsm.controllers.discon_check import check_discon
from dfsm.data.readers.rotor_table import read_rotor_table
from dfsm.errors import DfsmError, printable

# Values of the modes that are implemented; every other is refused.
_KNOWN: dict[str, tuple[int, ...]] = {
    "F_LPFType": (1, 2),
    "VS_ControlMode": (1, 2, 3, 4),
    "VS_ConstPower": (0, 1),
    "PC_ControlMode": (1,),
    "SS_Mode": (0, 1),
    "WE_Mode": (0, 1, 2),
    "PS_Mode": (0, 1),
    "Fl_Mode": (0, 1, 2),
    "PA_Mode": (0, 1, 2),
    **dict.fromkeys(
        (
            *("IPC_ControlMode", "VS_FBP", "Y_ControlMode", "PRC_Mode", "SU_Mode", "SD_Mode"),
            *("TD_Mode", "TRA_Mode", "Flp_Mode", "OL_Mode", "PF_Mode", "AWC_Mode", "Ext_Mode"),
            *("ZMQ_Mode", "CC_Mode", "StC_Mode"),
        ),
        (0,),
    ),
}
# Parameters, and the mode without which they play no part.
_PARAMETERS: dict[str, tuple[str, ...]] = {
    "": (
        *("F_LPFCornerFreq", "F_WECornerFreq", "PC_GS_angles", "PC_GS_KP", "PC_GS_KI"),
        *("PC_MaxPit", "PC_MinPit", "PC_MaxRat", "PC_MinRat", "PC_RefSpd", "PC_FinePit"),
        *("PC_Switch", "VS_GenEff", "VS_MaxRat", "VS_MaxTq", "VS_MinTq", "VS_MinOMSpd"),
        *("VS_Rgn2K", "VS_RtPwr", "VS_RtTq", "VS_RefSpd", "VS_KP", "VS_KI"),
        *("WE_BladeRadius", "WE_GearboxRatio"),
    ),
    "SS_Mode": ("F_SSCornerFreq", "SS_VSGain", "SS_PCGain"),
    "WE_Mode": ("WE_Jtot", "WE_RhoAir", "WE_Gamma", "WE_FOPoles_v", "WE_FOPoles"),
    "PS_Mode": ("PS_WindSpeeds", "PS_BldPitchMin"),
    "Fl_Mode": ("F_FlCornerFreq", "F_FlHighPassFreq", "Fl_Kp", "Fl_U"),
    "PA_Mode": ("PA_CornerFreq", "PA_Damping"),
    "F_NumNotchFilts": ("F_NotchFreqs", "F_NotchBetaNum", "F_NotchBetaDen"),
    "VS_ControlMode": ("VS_ArSatTq", "VS_TSRopt", "F_VSRefSpdCornerFreq"),
    "F_LPFType": ("F_LPFDamping",),
}
_TABLES = (
    *("PC_GS_angles", "PC_GS_KP", "PC_GS_KI", "WE_FOPoles_v", "WE_FOPoles", "PS_WindSpeeds"),
    *("PS_BldPitchMin", "F_FlCornerFreq", "Fl_Kp", "Fl_U"),
    *("F_NotchFreqs", "F_NotchBetaNum", "F_NotchBetaDen"),
)
# Tables are read at these; ROSCO stops where they do not rise.
_RISING = ("PC_GS_angles", "WE_FOPoles_v", "PS_WindSpeeds", "Fl_U")


@dataclass(frozen=True)
class Modes:
    """What a DISCON.IN switches on, by its key; and the notch filters in use, counted from 0."""

    F_LPFType: int
    VS_ControlMode: int
    VS_ConstPower: int
    SS_Mode: int
    WE_Mode: int
    PS_Mode: int
    Fl_Mode: int
    PA_Mode: int
    speed_notches: tuple[int, ...]
    acceleration_notches: tuple[int, ...]


class Power(NamedTuple):
    """Power coefficient over tip speed ratio and blade pitch in deg, shape ``(ratio, pitch)``."""

    ratio: jax.Array
    pitch: jax.Array
    coefficient: jax.Array


def deck_modes(discon: Discon) -> Modes:
    """Modes of a DISCON.IN.

    Raises
    ------
    DfsmError
        What `check_discon` refuses, or a mode that is not implemented, by its key.
    """
    check_discon(discon)
    values = {key: discon.integer(key, 0) for key in _KNOWN}
    for key, value in values.items():
        if value not in _KNOWN[key]:
            raise DfsmError(
                f"{printable(str(discon.path))}: {key} is {value}, and ROSCO in JAX has "
                f"{' or '.join(str(k) for k in _KNOWN[key])}: change it, or take the library "
                "(BladedLibrary)"
            )
    chosen = {key: values[key] for key in Modes.__annotations__ if key in values}
    return Modes(
        **chosen,
        speed_notches=_notches(discon, "F_GenSpdNotch"),
        acceleration_notches=_notches(discon, "F_TwrTopNotch"),
    )


def _notches(discon: Discon, stem: str) -> tuple[int, ...]:
    known = discon.integer("F_NumNotchFilts", 0)
    count = discon.integer(f"{stem}_N", 0) if known else 0
    indices = discon.array(f"{stem}_Ind")[:count] if count else []
    for index in indices:
        if not 1 <= index <= known:
            raise DfsmError(
                f"{printable(str(discon.path))}: {stem}_Ind names notch filter {index:g} of "
                f"{known}, expected 1 to {known}: correct it"
            )
    return tuple(int(index) - 1 for index in indices)


def deck_parameters(discon: Discon) -> dict[str, jax.Array]:
    """Numbers that ROSCO computes with, by key, those of modes that are off left out.

    Raises
    ------
    DfsmError
        A value is no number, or a table does not rise.
    """
    found: dict[str, jax.Array] = {}
    for mode, keys in _PARAMETERS.items():
        if mode and not discon.integer(mode, 0):
            continue
        for key in keys:
            # ROSCO's default.
            values = discon.array(key) if key in discon else np.zeros(1)
            if key in _RISING and len(values) > 1 and not (np.diff(values) > 0).all():
                raise DfsmError(
                    f"{printable(str(discon.path))}: {key} does not rise from value to value: "
                    "sort it, or leave out what stands twice"
                )
            if (bad := ~np.isfinite(values)).any():
                raise DfsmError(
                    f"{printable(str(discon.path))}: {key} holds {values[bad][0]}, expected "
                    "finite numbers: correct it"
                )
            found[key] = jnp.asarray(values if key in _TABLES else values[0])
    return found


def deck_power(discon: Discon) -> Power | None:
    """The rotor's table, where the wind estimator reads one.

    Raises
    ------
    DfsmError
        The table is missing, incomplete, or of another size than PerfTableSize.
    """
    if not discon.integer("WE_Mode", 0):
        return None
    table = read_rotor_table(discon.file("PerfFileName"))
    size = [int(n) for n in discon.array("PerfTableSize")]
    found = [len(table.pitch), len(table.tip_speed_ratio)]
    if size != found:
        raise DfsmError(
            f"{printable(str(discon.path))}: PerfTableSize is {size}, and {table.source} has "
            f"{found} pitch angles and tip speed ratios: make them agree"
        )
    return Power(*(jnp.asarray(a) for a in (table.tip_speed_ratio, table.pitch, table.cp)))

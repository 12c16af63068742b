"""Whether a DISCON.IN holds what ROSCO 2.10 reads in the modes that it chooses."""

from __future__ import annotations

from collections.abc import Callable

from dfsm.controllers.discon import COUNTS, FILES, Discon, check_count
from dfsm.core.files import existing_file
from dfsm.errors import DfsmError, printable

_MODES = (
    *("F_LPFType", "VS_ControlMode", "PC_ControlMode", "SS_Mode", "WE_Mode", "PS_Mode"),
    *("Fl_Mode", "PA_Mode", "F_NumNotchFilts", "OL_Mode", "Ext_Mode"),
)
_ALWAYS = (
    *("F_LPFCornerFreq", "F_SSCornerFreq", "F_WECornerFreq"),
    *("VS_GenEff", "VS_MaxRat", "VS_MaxTq", "VS_MinTq", "VS_RtPwr", "VS_RtTq", "VS_RefSpd"),
    *("VS_n", "VS_KP", "VS_KI", "WE_BladeRadius", "WE_GearboxRatio"),
    # The library takes 0, constant torque, for files of ROSCO before 2.9, whose VS_ControlMode
    # said which.
    "VS_ConstPower",
)
# Keys that a mode needs, by the mode and its values; 0 stands for a mode that is not there.
_NEEDED: tuple[tuple[str, Callable[[int], bool], tuple[str, ...]], ...] = (
    ("F_LPFType", lambda m: m == 2, ("F_LPFDamping",)),
    ("VS_ControlMode", lambda m: m == 1, ("VS_ArSatTq",)),
    ("VS_ControlMode", lambda m: m != 2, ("VS_Rgn2K",)),
    ("VS_ControlMode", lambda m: m > 1, ("VS_TSRopt", "F_VSRefSpdCornerFreq")),
    (
        "PC_ControlMode",
        lambda m: m > 0,
        (
            *("PC_GS_n", "PC_GS_angles", "PC_GS_KP", "PC_GS_KI", "PC_GS_KD", "PC_GS_TF"),
            *("PC_MaxPit", "PC_MinPit", "PC_MaxRat", "PC_MinRat", "PC_RefSpd"),
            *("PC_FinePit", "PC_Switch"),
        ),
    ),
    ("SS_Mode", lambda m: m > 0, ("SS_VSGain", "SS_PCGain")),
    ("WE_Mode", lambda m: m > 0, ("WE_Jtot", "PerfFileName", "PerfTableSize")),
    ("WE_Mode", lambda m: m == 1, ("WE_Gamma",)),
    ("WE_Mode", lambda m: m == 2, ("WE_RhoAir", "WE_FOPoles_N", "WE_FOPoles_v", "WE_FOPoles")),
    ("PS_Mode", lambda m: m > 0, ("PS_BldPitchMin_N", "PS_WindSpeeds", "PS_BldPitchMin")),
    ("Fl_Mode", lambda m: m > 0, ("F_FlCornerFreq", "F_FlHighPassFreq", "Fl_Kp")),
    ("PA_Mode", lambda m: m > 0, ("PA_CornerFreq", "PA_Damping")),
    (
        "F_NumNotchFilts",
        lambda m: m > 0,
        (
            *("F_NotchFreqs", "F_NotchBetaNum", "F_NotchBetaDen"),
            *("F_GenSpdNotch_N", "F_TwrTopNotch_N"),
        ),
    ),
    ("OL_Mode", lambda m: m > 0, ("OL_Filename", "Ind_Breakpoint")),
    ("Ext_Mode", lambda m: m > 0, ("DLL_FileName", "DLL_InFile", "DLL_ProcName")),
)
# Keys that ROSCO no longer reads, and the version that dropped them.
_EARLIER = {
    **dict.fromkeys(("F_NotchType", "F_NotchCornerFreq", "F_NotchBetaNumDen"), "2.9"),
    **dict.fromkeys(("Y_IPC_n", "Y_IPC_omegaLP", "Y_IPC_zetaLP"), "2.6"),
    **dict.fromkeys(("Y_omegaLPFast", "Y_omegaLPSlow"), "2.6"),
    "SD_CornerFreq": "2.10",
}
# The mode under which a named file is read.
_READ_UNDER = dict(zip(FILES, ("WE_Mode", "OL_Mode", "Ext_Mode", "Ext_Mode"), strict=True))
# ROSCO keeps so many letters of a word.
_LONGEST_WORD = 200


def check_discon(discon: Discon) -> None:
    """Refuse a DISCON.IN that ROSCO 2.10 would refuse, or would read as something else.

    Raises
    ------
    DfsmError
        Keys are missing (those of another version are told), a key has another number of values
        than the key that counts them says, or a file that it names is not there or has a name that
        ROSCO cuts off.
    """
    mode = {name: discon.integer(name, 0) for name in _MODES}
    needed = [
        *_ALWAYS,
        *(key for name, holds, keys in _NEEDED if holds(mode[name]) for key in keys),
    ]
    lacking = [key for key in needed if key not in discon]
    if lacking:
        earlier = [key for key in _EARLIER if key in discon]
        of_another = (
            f", and has {_some(earlier)} of ROSCO before {_EARLIER[earlier[0]]}" if earlier else ""
        )
        raise DfsmError(
            f"{printable(str(discon.path))} lacks {_some(lacking)}, which ROSCO 2.10 needs in the "
            f"modes that it chooses{of_another}: write it again with the ROSCO toolbox, or add "
            "those lines"
        )
    for counted in needed:
        if counted in COUNTS:
            check_count(discon, counted, COUNTS[counted])
    for key in FILES:
        if mode[_READ_UNDER[key]] > 0:
            _check_file(discon, key)


def _check_file(discon: Discon, key: str) -> None:
    words = discon.words(key)
    if len(words) != 1 or len(words[0]) > _LONGEST_WORD:
        raise DfsmError(
            f"{printable(str(discon.path))}: {key} is '{printable(' '.join(words))}', and ROSCO "
            f"cuts names at blanks, commas and {_LONGEST_WORD} letters: give the file another name"
        )
    try:
        existing_file(discon.file(key))
    except DfsmError as error:
        raise DfsmError(f"{printable(str(discon.path))}: {key}: {error}") from None


def _some(keys: list[str]) -> str:
    return ", ".join(keys[:8]) + (f" and {len(keys) - 8} more" if len(keys) > 8 else "")

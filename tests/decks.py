"""A small DISCON.IN of ROSCO 2.10, a turbine of 15 MW on a floater, and the table of its rotor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

PITCHES = np.arange(-4.0, 30.5, 2.0)  # deg
RATIOS = np.arange(2.0, 14.5, 1.0)

_DECK = """\
! A turbine of 15 MW

!------- FLAGS ------------------
2                    ! LoggingLevel   - debug files
1                    ! Echo
2                    ! F_LPFType
0                    ! IPC_ControlMode
2                    ! VS_ControlMode - torque, isn't it
0                    ! VS_ConstPower
0                    ! VS_FBP
1                    ! PC_ControlMode
0                    ! Y_ControlMode
1                    ! SS_Mode
0                    ! PRC_Mode
2                    ! WE_Mode
1                    ! PS_Mode
0                    ! SU_Mode
0                    ! SD_Mode
2                    ! Fl_Mode
0                    ! TD_Mode
0                    ! TRA_Mode
0                    ! Flp_Mode
0                    ! OL_Mode
2                    ! PA_Mode
0                    ! PF_Mode
0                    ! AWC_Mode
0                    ! Ext_Mode
0                    ! ZMQ_Mode
0                    ! CC_Mode
0                    ! StC_Mode
!------- FILTERS ----------------
1.00810              ! F_LPFCornerFreq
0.70000              ! F_LPFDamping
2                    ! F_NumNotchFilts
3.3550 1.2           ! F_NotchFreqs
0.0000 0.1           ! F_NotchBetaNum
0.2500 0.5           ! F_NotchBetaDen
1                    ! F_GenSpdNotch_N
2                    ! F_GenSpdNotch_Ind
1                    ! F_TwrTopNotch_N
1                    ! F_TwrTopNotch_Ind
0.62830              ! F_SSCornerFreq
0.20944              ! F_WECornerFreq
0.17952              ! F_YawErr
0.2130   1.0000      ! F_FlCornerFreq
0.01042              ! F_FlHighPassFreq
0.20944              ! F_VSRefSpdCornerFreq
!------- PITCH ------------------
4                                        ! PC_GS_n
0.062     0.143      0.220      0.360    ! PC_GS_angles - rad
-1.143    -0.6612    -0.3108    -0.05    ! PC_GS_KP
-0.1196   -0.08392   -0.05799   -0.035   ! PC_GS_KI
0.0       0.0        0.0        0.0      ! PC_GS_KD
0.0       0.0        0.0        0.0      ! PC_GS_TF
1.570000000000       ! PC_MaxPit
0.000000000000       ! PC_MinPit
0.034900000000       ! PC_MaxRat
-0.03490000000       ! PC_MinRat
0.791680000000       ! PC_RefSpd
0.000000000000       ! PC_FinePit
0.017450000000       ! PC_Switch
0.2618               ! IPC_IntSat
!------- TORQUE -----------------
95.75600             ! VS_GenEff
1.97868e+07          ! VS_ArSatTq
4.50000D+06          ! VS_MaxRat
2.17654e+07          ! VS_MaxTq
0.00000e+00          ! VS_MinTq
0.52360              ! VS_MinOMSpd
3.28052e+07          ! VS_Rgn2K
1.50000e+07          ! VS_RtPwr
1.97868e+07          ! VS_RtTq
0.79168              ! VS_RefSpd
1                    ! VS_n
-3.57306e+07         ! VS_KP
-4.49937e+06         ! VS_KI
9.00000              ! VS_TSRopt
1.00000              ! SS_VSGain
0.05000              ! SS_PCGain
!------- WIND -------------------
120.970              ! WE_BladeRadius
25.0                 ! WE_Gamma
1.0                  ! WE_GearboxRatio
312456272.00000      ! WE_Jtot
1.225                ! WE_RhoAir
"rotor/Cp_Ct_Cq.txt" ! PerfFileName
18   13              ! PerfTableSize
3                    ! WE_FOPoles_N
3.0      11.0    25.0          ! WE_FOPoles_v
-0.02568 -0.0942 -0.35         ! WE_FOPoles
4                              ! PS_BldPitchMin_N
3.0   7.0    10.5   25.0       ! PS_WindSpeeds
0.06  0.001  0.03   0.0        ! PS_BldPitchMin
1                    ! Fl_n
-9.1984              ! Fl_Kp
11.2770              ! Fl_U
1.570800000000       ! PA_CornerFreq
0.707000000000       ! PA_Damping
"""


def write_deck(folder: Path, deck: str = _DECK, **changes: str) -> Path:
    """DISCON.IN and rotor/Cp_Ct_Cq.txt in `folder`; `changes` are values as they are written."""
    lines = deck.splitlines(keepends=True)
    for key, text in changes.items():
        at = [i for i, line in enumerate(lines) if line.partition("!")[2].split()[:1] == [key]]
        lines[at[-1]] = f"{text}    ! {key}\n"
    path = folder / "DISCON.IN"
    path.write_text("".join(lines))
    (folder / "rotor").mkdir(exist_ok=True)
    write_rotor(folder / "rotor" / "Cp_Ct_Cq.txt")
    return path


def write_rotor(path: Path) -> None:
    """Coefficients of a rotor that is best at a ratio of 9 and no pitch, in ROSCO's layout."""
    ratio, pitch = RATIOS[:, None], PITCHES[None, :]
    bell = np.exp(-(((ratio - 9) / 5) ** 2) - (pitch / 11) ** 2)
    cp = 0.48 * bell - 0.02 * (ratio / 9) ** 3 * (pitch + 4) / 34
    ct = np.clip(0.9 - 0.03 * pitch - 0.02 * (ratio - 9), 0.02, 1.2)
    rows = ["# ----- Rotor performance tables -----", "# by formula", ""]
    rows += ["# Pitch angle vector - x axis (matrix columns) (deg)", _row(PITCHES)]
    rows += ["# TSR vector - y axis (matrix rows) (-)", _row(RATIOS)]
    rows += ["# Wind speed vector - z axis (m/s)", "11.0", ""]
    for name, table in (("Power", cp), ("Thrust", ct), ("Torque", cp / ratio)):
        rows += [f"# {name} coefficient", "", "", *(_row(row) for row in table), ""]
    path.write_text("\n".join(rows) + "\n")


def _row(values: np.ndarray) -> str:
    return "   ".join(f"{v:.6f}" for v in values)

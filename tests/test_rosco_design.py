"""ω, ζ and peak shaving of a DISCON.IN, against what ROSCO's toolbox 2.10.6 makes of them.

`data/rosco-toolbox-2.10.6.json` holds keys that the toolbox wrote for its file of the IEA-15
floating turbine as it is shipped (ω 0.2, ζ 1.0, torque 0.12 and 0.85, peak shaving 0.8), and with
ω 0.3, ζ 0.7, torque 0.2 and 1.0, peak shaving 0.9.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import dfsm
from decks import write_deck
from dfsm.controllers.tunable import tunable
from dfsm.errors import DfsmError

TABLE = Path(__file__).parents[1] / "examples" / "iea15" / "Cp_Ct_Cq.IEA15MW.txt"
TOOLBOX = json.loads((Path(__file__).parent / "data" / "rosco-toolbox-2.10.6.json").read_text())
NAMES = ("omega_pc", "zeta_pc", "omega_vs", "zeta_vs", "ps_percent")


def deck(folder, keys, **changes):
    words = {key: " ".join(repr(v) for v in values) for key, values in keys.items()}
    none = " ".join(["0.0"] * 30)
    counts = {"PC_GS_n": "30", "PS_BldPitchMin_N": "60", "PC_GS_KD": none, "PC_GS_TF": none}
    table = {"PerfFileName": f'"{TABLE}"', "PerfTableSize": "36 26"}
    return dfsm.read_discon(write_deck(folder, **(words | counts | table | changes)))


def test_a_deck_tells_its_tuning_and_another_gives_what_the_toolbox_gives(tmp_path):
    discon = deck(tmp_path, TOOLBOX["before"])
    tuned = tunable(dfsm.read_rosco(discon, interval=0.05), NAMES, discon)
    np.testing.assert_allclose(tuned.start, [0.2, 1.0, 0.12, 0.85, 0.8], rtol=1e-3)
    assert tuned.changes(tuned.start) == {}
    found = tuned.changes(np.array([0.3, 0.7, 0.2, 1.0, 0.9]))
    assert set(found) == {"PC_GS_KP", "PC_GS_KI", "VS_KP", "VS_KI", "PS_BldPitchMin"}
    for key, values in found.items():
        theirs = np.array(TOOLBOX["after"][key])
        np.testing.assert_allclose(
            np.asarray(values, dtype=float), theirs, atol=1e-3 * np.abs(theirs).max()
        )
    # Only the lines of these keys are others.
    lines = discon.changed(found).lines
    pairs = zip(lines, discon.lines, strict=True)
    assert len([a for a, b in pairs if a != b]) == len(found)
    # The schedule of the toolbox stands in no table: the wind follows from rated power.
    away = {"PS_BldPitchMin_N": "2", "PS_WindSpeeds": "3 25", "PS_BldPitchMin": "0 0"}
    other = deck(tmp_path, TOOLBOX["before"], **away)
    omega = tunable(dfsm.read_rosco(other, interval=0.05), ["omega_pc"], other).start
    assert omega == pytest.approx(0.2, rel=0.1)


def test_slopes_of_numbers_are_those_of_differences(tmp_path):
    discon = deck(tmp_path, TOOLBOX["before"])
    names = (*NAMES, "Kp_float", "SS_VSGain", "PC_GS_KI.factor", "F_FlCornerFreq[0]")
    tuned = tunable(dfsm.read_rosco(discon, interval=0.05), names, discon)
    theta, e = tuned.start * 1.05, 1e-6
    for i, way in enumerate(tuned.directions(theta)):
        ends = [tuned.numbers(list(theta + s * e * np.eye(len(names))[i])) for s in (1, -1)]
        for key, slope in way.items():
            numeric = (np.asarray(ends[0][key]) - np.asarray(ends[1][key])) / (2 * e)
            size = np.abs(numeric).max() + 1e-9
            np.testing.assert_allclose(slope, numeric, atol=1e-5 * size)


def test_what_cannot_be_tuned_is_told(tmp_path):
    discon = deck(tmp_path, TOOLBOX["before"], PS_Mode="0", PC_GS_KI=" ".join(["0.01"] * 30))
    rosco = dfsm.read_rosco(discon, interval=0.05)
    for names, sentence in (
        (["omega_p"], "no gain 'omega_p'; did you mean 'omega_pc'"),
        (["ps_percent"], "does not use PS_BldPitchMin: switch its mode on"),
        (["omega_pc"], "PC_GS_KI has the sign of a loop that cannot be stable"),
        (["PC_GS_KP"], r"PC_GS_KP has 30 values: name one, as PC_GS_KP\[0\]"),
        (["PC_GS_KP[30]"], "an index counts from 0"),
        (["zeta_vs", "VS_KP"], "zeta_vs and VS_KP both set VS_KP"),
    ):
        with pytest.raises(DfsmError, match=sentence):
            tunable(rosco, names, discon)
    with pytest.raises(DfsmError, match="give discon="):
        tunable(rosco, ["omega_pc"])

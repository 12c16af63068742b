"""DISCON.IN read and written by key: what nobody changes stays, byte by byte."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from decks import write_deck
from dfsm.controllers.discon import LONGEST_LINE, read_discon, write_discon
from dfsm.controllers.discon_check import check_discon
from dfsm.errors import DfsmError


@pytest.fixture
def deck(tmp_path: Path) -> Path:
    return write_deck(tmp_path)


def test_numbers_are_read_with_all_their_digits(deck):
    discon = read_discon(deck)
    assert discon.number("IPC_IntSat") == 0.2618
    assert discon.number("vs_maxrat") == 4.5e6
    assert discon.number("WE_Jtot") == 312456272.0
    np.testing.assert_array_equal(discon.array("F_FlCornerFreq"), [0.213, 1.0])
    assert discon.integer("VS_ControlMode") == 2
    assert discon.integer("Nothing", 7) == 7
    assert discon.file("PerfFileName") == deck.parent / "rotor/Cp_Ct_Cq.txt"
    check_discon(discon)


def test_only_the_lines_of_changed_values_change(deck):
    discon = read_discon(deck)
    gains = np.array([-1.143, 1 / 3, -0.3108, -1e-300])
    changed = discon.changed({"pc_gs_kp": gains, "Fl_Kp": -9.1984, "PS_Mode": 0.0})
    before, after = discon.lines, changed.lines
    lines = [i for i, (a, b) in enumerate(zip(before, after, strict=True)) if a != b]
    assert [before[i].split("!")[1].split()[0] for i in lines] == ["PS_Mode", "PC_GS_KP"]
    np.testing.assert_array_equal(changed.array("PC_GS_KP"), gains)
    row = after[lines[1]]
    assert row.startswith("-1.143  0.3333333333333333  -0.3108  -1e-300 ")
    assert row.endswith("! PC_GS_KP\n")
    assert after[lines[0]] == "0                    ! PS_Mode\n"


def test_other_bytes_survive(tmp_path):
    path = write_deck(tmp_path)
    odd = b"\xff\xfe not a letter\r\nmy own words, isn't it\r\n7 ! MyKey with \xe9\r\n"
    path.write_bytes(path.read_bytes() + odd + b"0.5 MyOther ! LastWord\x0c")
    discon = read_discon(path)
    assert discon.number("MyKey") == 7
    assert discon.number("MyOther") == 0.5
    assert "t" not in discon
    assert "LastWord" not in discon
    write_discon(discon.changed({"MyKey": 8}), tmp_path / "new.IN")
    assert (tmp_path / "new.IN").read_bytes() == path.read_bytes().replace(b"\n7 ! ", b"\n8 ! ")


def test_the_last_of_two_lines_counts(deck):
    deck.write_text(deck.read_text() + "0.5 ! SS_PCGain\n")
    discon = read_discon(deck)
    assert discon.repeated == ("SS_PCGain",)
    assert discon.number("SS_PCGain") == 0.5
    changed = discon.changed({"SS_PCGain": 0.25})
    assert changed.lines[:-1] == discon.lines[:-1]
    assert changed.lines[-1] == "0.25 ! SS_PCGain\n"


def test_files_are_named_from_the_new_folder(deck, tmp_path):
    (tmp_path / "tuned").mkdir()
    write_discon(read_discon(deck), tmp_path / "tuned" / "DISCON.IN")
    moved = read_discon(tmp_path / "tuned" / "DISCON.IN")
    assert moved.file("PerfFileName").resolve() == tmp_path / "rotor" / "Cp_Ct_Cq.txt"
    check_discon(moved)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"Fl_Kpp": 1.0}, "has no key Fl_Kpp; did you mean 'Fl_Kp'"),
        ({"Fl_Kp": np.nan}, "Fl_Kp is to become nan, expected finite numbers"),
        ({"SS_Mode": 0.5}, "SS_Mode is to become 0.5, expected whole numbers"),
        ({"PC_GS_KP": [1.0, 2.0]}, "PC_GS_KP has 2 values, expected PC_GS_n = 4"),
        ({"PC_GS_n": 3}, "PC_GS_angles has 4 values, expected PC_GS_n = 3"),
        ({"PerfFileName": "x" * LONGEST_LINE}, "ROSCO reads 2048"),
    ],
)
def test_changes_that_rosco_would_not_read_are_refused(deck, values, told):
    with pytest.raises(DfsmError, match=told):
        read_discon(deck).changed(values)


def test_what_is_no_deck_is_told(deck, tmp_path):
    other = tmp_path / "ServoDyn.dat"
    other.write_text("0.01 DT - step\n")
    with pytest.raises(DfsmError, match="has neither VS_ControlMode nor PC_ControlMode"):
        read_discon(other)
    broken = read_discon(write_deck(tmp_path, VS_KP="much", SS_Mode="on"))
    with pytest.raises(DfsmError, match="VS_KP is 'much', expected numbers"):
        broken.number("VS_KP")
    with pytest.raises(DfsmError, match="SS_Mode is 'on', expected a whole number"):
        broken.integer("SS_Mode")


def test_decks_of_another_version_say_which_keys(deck):
    text = deck.read_text()
    lines = [line for line in text.splitlines(keepends=True) if "VS_ConstPower" not in line]
    deck.write_text("".join(lines) + "1 ! F_NotchType\n")
    with pytest.raises(
        DfsmError, match=r"lacks VS_ConstPower, which .* has F_NotchType of ROSCO before 2\.9"
    ):
        check_discon(read_discon(deck))
    lines = [line for line in lines if "VS_TSRopt" not in line]
    deck.write_text("".join(lines))
    with pytest.raises(DfsmError, match="lacks VS_ConstPower, VS_TSRopt, which ROSCO"):
        check_discon(read_discon(deck))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"PS_BldPitchMin": "0.1 0.2"}, "PS_BldPitchMin has 2 values, expected PS_BldPitchMin_N"),
        ({"PerfFileName": '"rotor/none.txt"'}, r"PerfFileName: .*none.txt: no such file"),
        ({"PerfFileName": '"my rotor.txt"'}, "'my rotor.txt', and ROSCO cuts names at blanks"),
    ],
)
def test_decks_that_rosco_would_not_read_are_refused(tmp_path, changes, told):
    with pytest.raises(DfsmError, match=told):
        check_discon(read_discon(write_deck(tmp_path, **changes)))

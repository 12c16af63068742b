from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from dfsm.core.types import Array
from dfsm.data.readers.rotor_table import RotorTable, read_rotor_table
from dfsm.errors import DfsmError

IEA15 = Path(__file__).parents[1] / "examples" / "iea15" / "Cp_Ct_Cq.IEA15MW.txt"
PITCH = np.array([-2.0, 0.0, 2.0, 5.0, 10.0])
RATIO = np.array([2.0, 4.0, 6.0, 8.0, 10.0, 12.0])


def coefficients(pitch: Array = PITCH, ratio: Array = RATIO) -> dict[str, Array]:
    b, x = np.meshgrid(pitch, ratio)
    cp = 0.45 - 0.01 * (x - 8) ** 2 - 0.006 * (b - 0.5) ** 2
    return {
        "pitch": pitch,
        "tip_speed_ratio": ratio,
        "cp": cp,
        "ct": 0.1 * x - 0.03 * b,
        "cq": cp / x,
    }


def long_table(
    header: str = "Pitch (deg),TSR,Cp,Ct,Cq", pitch_factor: float = 1.0, delimiter: str = ","
) -> list[str]:
    c = coefficients()
    lines = [header.replace(",", delimiter)]
    for j, b in enumerate(PITCH):
        for i, x in enumerate(RATIO):
            row = [pitch_factor * b, x, c["cp"][i, j], c["ct"][i, j], c["cq"][i, j]]
            row = row[: header.count(",") + 1]
            lines.append(delimiter.join(f"{v:.10g}" for v in row))
    return lines


def written(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


# -- reading ------------------------------------------------------------------------------------


def test_rosco_table_is_read_as_it_stands():
    table = read_rotor_table(IEA15)
    # Read by position: headings, axes and three blocks of 26 rows.
    lines = IEA15.read_text().splitlines()
    numbers = [np.array(line.split(), dtype=float) for line in lines if line and line[0] != "#"]
    np.testing.assert_array_equal(table.pitch, numbers[0])
    np.testing.assert_array_equal(table.tip_speed_ratio, numbers[1])
    np.testing.assert_array_equal(table.cp, numbers[3:29])
    np.testing.assert_array_equal(table.ct, numbers[29:55])
    np.testing.assert_array_equal(table.cq, numbers[55:81])
    assert table.cp.shape == (26, 36)
    assert table.optimum == (8.5, -1.0)
    assert table.source == str(IEA15)


@pytest.mark.parametrize(
    "heading",
    [
        "{} coefficient (rows: TSR, columns: pitch angle)",
        "{} coefficient",
        "[pitch angle across, TSR down] {} coefficient",
        "Over TSR and pitch angle: {} coefficient",
        "{} coefficient, rows along the TSR axis",
        "({} coefficient)",
    ],
)
def test_headings_of_rosco_may_tell_their_axes(tmp_path, heading):
    c = coefficients()
    lines = ["# Rotor performance, power coefficient over pitch angle and TSR"]
    lines += ["# Pitch angle vector, 5 entries - x axis of the power coefficient (deg)"]
    lines += [" ".join(f"{v:g}" for v in PITCH), "# TSR vector, 6 entries - y axis (-)"]
    lines += [" ".join(f"{v:g}" for v in RATIO), "# Wind speed vector - z axis (m/s)", "11.0"]
    for name, field in {"Power": "cp", "Thrust": "ct", "Torque": "cq"}.items():
        lines += ["", f"# {heading.format(name)}", ""]
        lines += [" ".join(f"{v:.9f}" for v in row) for row in c[field]]
    table = read_rotor_table(written(tmp_path / "Cp_Ct_Cq.txt", lines))
    for field, values in c.items():
        np.testing.assert_allclose(getattr(table, field), values, atol=1e-8)


@pytest.mark.parametrize(
    ("header", "factor", "delimiter"),
    [
        ("Pitch (deg),TSR,Cp,Ct,Cq", 1.0, ","),
        ("pitch_deg,tsr,CP,CT,CQ", 1.0, ";"),
        ("BldPitch1_[deg],RtTSR_[-],RtAeroCp,RtAeroCt,RtAeroCq", 1.0, "\t"),
        ("pitch_rad,tip_speed_ratio,cp,ct,cq", np.pi / 180, ","),
        ("Pitch [rad],lambda,Cp,Ct,Cq", np.pi / 180, " "),
        ("theta,TSR,Cp [-],Ct [-]", 1.0, ","),
    ],
)
def test_long_tables_are_read_whatever_their_header(tmp_path, header, factor, delimiter):
    if delimiter == " ":
        header = header.replace(" ", "_")
    path = written(tmp_path / "table.csv", long_table(header, factor, delimiter))
    table, expected = read_rotor_table(path), coefficients()
    for field, values in expected.items():
        np.testing.assert_allclose(getattr(table, field), values, rtol=1e-8, atol=1e-9)


def test_rows_may_stand_in_any_order_and_beside_other_columns(tmp_path):
    header, *rows = long_table()
    rng = np.random.default_rng(0)
    mixed = [f"{rows[i]},{rng.random():.3f}" for i in rng.permutation(len(rows))]
    table = read_rotor_table(
        written(
            tmp_path / "t.csv", ["# by hand", f"{header},Re", "(deg),(-),(-),(-),(-),-", *mixed]
        )
    )
    np.testing.assert_allclose(table.ct, coefficients()["ct"], rtol=1e-9)


def test_a_table_cannot_be_changed():
    table = RotorTable(**coefficients())
    with pytest.raises(ValueError, match="read-only"):
        table.cp[0, 0] = 1.0


# -- what is refused ----------------------------------------------------------------------------


def changed(**changes) -> dict[str, Array]:
    return coefficients() | changes


def with_value(field: str, value: float) -> dict[str, Array]:
    c = coefficients()
    c[field] = c[field].copy()
    c[field][1, 1] = value
    return c


def in_radians() -> dict[str, Array]:
    return coefficients(np.array([-2.0, 0.0, 2.0, 5.0, 10.0])) | {
        "pitch": np.deg2rad(PITCH),
        "cp": coefficients()["cp"] - 0.05 * np.maximum(PITCH, 0) / 10 * 6,
        "cq": (coefficients()["cp"] - 0.05 * np.maximum(PITCH, 0) / 10 * 6) / RATIO[:, None],
    }


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            changed(pitch=PITCH[::-1]),
            "the blade pitch goes from 10 to 5, expected values that rise",
        ),
        (
            changed(tip_speed_ratio=np.array([2.0, 4, 6, 6, 10, 12])),
            "the tip speed ratio goes from 6 to 6, expected values that rise",
        ),
        (coefficients(PITCH[:3]), "3 values of the blade pitch, at least 4 are needed"),
        (coefficients(ratio=RATIO[:2]), "2 values of the tip speed ratio, at least 4"),
        (changed(pitch=np.array([np.nan, 0, 1, 2, 3])), "a blade pitch is not finite"),
        (changed(tip_speed_ratio=RATIO - 3), "tip speed ratios begin at -1, expected 0 or more"),
        (changed(ct=coefficients()["ct"].T), "Ct is 5 x 6, expected 6 tip speed ratios x 5 pitch"),
        (with_value("ct", np.nan), "Ct is not finite at 1 of 30 places"),
        (with_value("cp", 0.6), "Cp is 0.6 at pitch 0 deg and tip speed ratio 4, above the Betz"),
        (changed(cp=-np.abs(coefficients()["cp"])), "Cp is nowhere positive"),
        (changed(ct=-coefficients()["ct"]), "expected a positive thrust, downwind: turn its sign"),
        (changed(cq=coefficients()["cp"]), "check which coefficient and which axis is which"),
        (in_radians(), "that looks like rad, convert it to deg"),
    ],
)
def test_tables_that_cannot_be_right_are_refused(table, message):
    with pytest.raises(DfsmError, match=re.escape(message)):
        RotorTable(**table)


def test_a_narrow_table_in_degrees_is_no_table_in_radians():
    RotorTable(**coefficients(np.linspace(-1.5, 1.5, 7)))


def test_torque_far_from_power_is_told_only_where_it_matters():
    # Six digits after the point, as ROSCO writes them.
    c = coefficients()
    RotorTable(**c | {"cq": np.round(c["cq"], 4)})


def rosco(lines: list[str], *, drop: str = "", cut: int = 0) -> list[str]:
    """The bundled table without one of its sections, or without the last rows of one."""
    kept, section, result = 0, "", []
    for line in lines:
        if line.startswith("#"):
            section, kept = line, 0
        elif drop and drop in section:
            kept += bool(line)
            if not cut or kept > 26 - cut:
                continue
        result.append(line)
    return result


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"drop": "TSR"}, "it has no tip speed ratio"),
        ({"drop": "Thrust"}, "it has no thrust coefficient"),
        (
            {"drop": "Power", "cut": 2},
            "the power coefficient has 24 rows of 36 numbers, expected 26 (tip speed ratios) of 36",
        ),
    ],
)
def test_incomplete_rosco_tables_are_refused(tmp_path, change, message):
    lines = rosco(IEA15.read_text().splitlines(), **change)
    with pytest.raises(DfsmError, match=re.escape(message)):
        read_rotor_table(written(tmp_path / "t.txt", lines))


def test_torque_may_be_missing_from_a_rosco_table(tmp_path):
    lines = rosco(IEA15.read_text().splitlines(), drop="Torque")
    table, whole = read_rotor_table(written(tmp_path / "t.txt", lines)), read_rotor_table(IEA15)
    np.testing.assert_allclose(table.cq, whole.cq, atol=1e-3)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["", "  "], "holds blank lines only"),
        (["a,b,c", "1,2,3"], "no column for the blade pitch among 'a, b, c'"),
        (["Pitch,TSR,Cp", "1,2,3"], "no column for the thrust coefficient"),
        (["Pitch (turn),TSR,Cp,Ct", "1,2,3,4"], "blade pitch is in 'turn', expected deg or rad"),
        (["Pitch,TSR,Cp,Ct"], "has a header and no rows"),
        ([*long_table()[:-1]], "no rows have pitch 10 deg and tip speed ratio 12, expected one"),
        ([*long_table(), long_table()[-1]], "2 rows have pitch 10 deg and tip speed ratio 12"),
        ([*long_table()[:-1], "10,12,x,1,1"], "'10 12 x 1 1' is no row of numbers"),
        ([*long_table()[:-1], "10,12,1"], "a row has 3 values, but the header names 5 columns"),
        (
            ["Pitch,TSR,Cp,Ct", *(f"{b},{x},0.1,0.1" for b in range(4) for x in range(4))],
            "tip speed ratios from 0 on and no torque coefficient",
        ),
        (["1 2 3", "# Pitch angle vector"], "stands under no heading that says what it is"),
    ],
)
def test_other_files_are_refused(tmp_path, lines, message):
    path = written(tmp_path / "t.csv", lines)
    with pytest.raises(DfsmError, match=re.escape(message)) as caught:
        read_rotor_table(path)
    assert str(path) in str(caught.value)


def test_missing_empty_and_binary_files_are_refused(tmp_path):
    with pytest.raises(DfsmError, match="no such file"):
        read_rotor_table(tmp_path / "t.txt")
    (tmp_path / "t.txt").touch()
    with pytest.raises(DfsmError, match="is empty"):
        read_rotor_table(tmp_path / "t.txt")
    (tmp_path / "t.txt").write_bytes(b"PAR1\0\0")
    with pytest.raises(DfsmError, match="is a binary file, expected ROSCO's"):
        read_rotor_table(tmp_path / "t.txt")

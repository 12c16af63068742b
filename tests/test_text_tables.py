"""Tables in text as programs leave them: what is a header, a row, an empty cell and a number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from conftest import sentence
from dfsm.data.readers import read
from dfsm.data.readers.text import number
from dfsm.errors import DfsmError

TIME = 0.5 * np.arange(40)
A, B = np.round(np.sin(TIME), 4), np.round(1000 * (1.5 + np.cos(TIME)), 1)
ROWS = [f"{t},{a},{b}" for t, a, b in zip(TIME, A, B, strict=True)]


def put(path: Path, lines: list[str] | str) -> Path:
    text = lines if isinstance(lines, str) else "\n".join(lines) + "\n"
    path.write_text(text, encoding="utf-8")
    return path


def whole(path: Path) -> tuple[str, ...]:
    """Notes of a table that is read as it was written."""
    run = read(path)
    assert run.names == ("A", "B")
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_array_equal(run["A"], A)
    np.testing.assert_array_equal(run["B"], B)
    return run.notes


# -- numbers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("label", ["07-02", "2023-11", "45_6", "3d1", "9.5-04", "1_000.5"])
def test_labels_are_no_numbers(tmp_path, label):
    assert number(label) is None
    rows = [row.replace(",", f",{label},", 1) for row in ROWS]
    notes = whole(put(tmp_path / "a.csv", ["Time,case,A,B", *rows]))
    assert notes == (f"column 'case' left out: it holds words ('{label}')",)
    rows[5] = rows[5].replace(label, "7")
    assert f"{label!r} in column 2 is no number" in sentence(
        put(tmp_path / "a.csv", ["Time,case,A,B", *rows])
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [("1.5-103", 1.5e-103), ("-.25+100", -2.5e99), ("3.D+02", 300.0), ("0.5d-01", 0.05)],
)
def test_numbers_of_fortran_have_a_point(text, value):
    assert number(text) == value


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_commas_between_thousands_before_decimals(tmp_path, separator):
    rows = [f'{t}{separator}{a}{separator}"{b:,.1f}"' for t, a, b in zip(TIME, A, B, strict=True)]
    notes = whole(put(tmp_path / "a.csv", [separator.join(("Time", "A", "B")), *rows]))
    assert notes == ("commas between thousands, as in 1,234.5: read as whole numbers",)


@pytest.mark.parametrize("between", ["\u202f", "\u00a0", "\u2009", " ", "'", "\u2019"])
@pytest.mark.parametrize("decimal", [",", "."])
def test_blanks_and_apostrophes_between_thousands(tmp_path, between, decimal):
    rows = [
        f"{t};{a};{f'{b:,.1f}'.replace(',', between)}".replace(".", decimal)
        for t, a, b in zip(TIME, A, B, strict=True)
    ]
    notes = whole(put(tmp_path / "a.csv", ["Time;A;B", *rows]))
    assert any(f"thousands are set apart, as in 2{between}500" in note for note in notes)


@pytest.mark.parametrize(("head", "sign"), [("A", "%"), ("A [%]", " %")])
@pytest.mark.parametrize("decimal", [",", "."])
def test_percent_signs_are_the_unit(tmp_path, head, sign, decimal):
    rows = [f"{t};{a}{sign};{b}".replace(".", decimal) for t, a, b in zip(TIME, A, B, strict=True)]
    path = put(tmp_path / "a.csv", [f"Time;{head};B", *rows])
    whole(path)
    assert read(path).channel("A").unit == "%"
    # Where some cells have none, it is no unit of the column.
    rows[7] = rows[7].replace(sign, "")
    assert "is no number" in sentence(put(tmp_path / "b.csv", [f"Time;{head};B", *rows]))


# -- rows ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("at", [0, 1, 2, 15, 41])
@pytest.mark.parametrize("blanks", ["", "  ", '""'])
def test_empty_rows_of_spreadsheets_are_nothing(tmp_path, separator, at, blanks):
    lines = [line.replace(",", separator) for line in ("Time,A,B", *ROWS)]
    empty = separator.join([blanks] * 3)
    lines[at:at] = [empty, empty]
    assert whole(put(tmp_path / "a.csv", lines)) == ()


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize(("head", "row"), [(0, 1), (0, 2), (1, 0), (3, 0), (1, 1)])
def test_separators_at_the_ends_of_lines(tmp_path, separator, head, row):
    lines = ["Time,A,B" + "," * head, "s,m,W" + "," * head]
    lines += [line + "," * row for line in ROWS]
    path = put(tmp_path / "a.csv", [line.replace(",", separator) for line in lines])
    told = ("column 4 left out: it has no name and no values",)
    assert whole(path) == (told if head and row else ())
    assert [c.unit for c in read(path).channels] == ["m", "W"]


def test_a_row_that_is_longer_than_others_is_refused(tmp_path):
    for end in (",", ",7"):
        rows = [*ROWS[:9], ROWS[9] + end, *ROWS[10:]]
        assert "line 11: 4 values" in sentence(put(tmp_path / "a.csv", ["Time,A,B", *rows]))
    rows = [f"{row},{i}" for i, row in enumerate(ROWS)]
    path = put(tmp_path / "a.csv", ["Time,A,B", *rows])
    assert "line 2: 4 values, but the header names 3" in sentence(path)


@pytest.mark.parametrize("units", [[], ["s,m,W"]])
@pytest.mark.parametrize("times", [1, 5])
def test_a_header_that_is_repeated_is_passed_over(tmp_path, units, times):
    head = ["Time,A,B", *units]
    lines = [*head, *ROWS[:9]]
    for k in range(times):
        lines += [*head, *ROWS[9 + 5 * k : 14 + 5 * k]]
    lines += ROWS[9 + 5 * times :]
    (note,) = whole(put(tmp_path / "a.csv", lines))
    assert note.endswith("the header: passed over")
    first = len(head) + 10
    plural = len(head) * times > 1
    assert note.startswith(f"line{'s' * plural} {first}")


def test_a_restarted_run_of_openfast_repeats_its_header(tmp_path):
    rows = [row.replace(",", "\t") for row in ROWS]
    head = ["Time\tA\tB", "(s)\t(kN m)\t(W)"]
    path = put(tmp_path / "a.out", ["a title", *head, *rows[:20], *head, *rows[20:]])
    assert whole(path) == ("lines 24, 25 repeat the header: passed over",)
    path = put(tmp_path / "b.out", ["a title", *head, *rows[:20], *head, *rows[18:]])
    assert "time goes back" in sentence(path)


# -- headers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("head", ["time, A, B", "time,A,B", "time;A;B", "time\tA\tB", "time A B"])
@pytest.mark.parametrize("between", [" ", "   ", "\t", ",", ";"])
@pytest.mark.parametrize("comment", ["# ", "", "%"])
def test_names_and_rows_may_be_separated_in_different_ways(tmp_path, head, between, comment):
    rows = [row.replace(",", between) for row in ROWS]
    assert whole(put(tmp_path / "a.txt", [comment + head, *rows])) == ()


def test_names_with_units_above_rows_between_blanks(tmp_path):
    rows = ["  " + row.replace(",", "   ") for row in ROWS]
    for head in ("# Time [s], A [kN m], B (W)", "Time [s]\tA [kN m]\tB (W)"):
        path = put(tmp_path / "a.txt", ["# made by a test", head, *rows])
        whole(path)
        assert [c.unit for c in read(path).channels] == ["kN m", "W"]


@pytest.mark.parametrize("comment", ["# s, t, kW", "# signals: t, A, B", "% t;A;B", "# t A B"])
@pytest.mark.parametrize("separator", [",", ";"])
def test_a_comment_above_the_names_is_no_header(tmp_path, comment, separator):
    lines = [line.replace(",", separator) for line in ("Time,A,B", *ROWS)]
    assert whole(put(tmp_path / "a.csv", [comment, *lines])) == ()


@pytest.mark.parametrize("comment", ["# the time is", "# a t of", "% t, A"])
def test_a_sentence_above_names_without_a_time_is_no_header(tmp_path, comment):
    path = put(tmp_path / "a.csv", [comment, "x,y,z", *ROWS])
    assert read(path, 0.5).names == ("x", "y", "z")


@pytest.mark.parametrize("unit", ["secs", "sec.", "Sec", "s.", "SECONDS"])
@pytest.mark.parametrize("blank", [" ", "\u00a0", "\u202f"])
@pytest.mark.parametrize("quote", ['"', ""])
def test_spellings_of_the_header(tmp_path, unit, blank, quote):
    cells = [f"{quote}{name}{quote}" for name in (f"Time{blank}[{unit}]", f"A{blank}[m]", "B")]
    path = put(tmp_path / "a.csv", [", ".join(cells), *(row.replace(",", ", ") for row in ROWS)])
    assert whole(path) == ()
    assert read(path).channel("A").unit == "m"


def test_openfast_s_text_with_units_beside_the_names(tmp_path):
    rows = [row.replace(",", "\t") for row in ROWS]
    for head in ("Time (s)\tA (kN m)\tB (W)", "Time [s]  A [kN m]  B [W]", "Time_(s) A_(kN) B_(W)"):
        path = put(tmp_path / "a.out", [head, *rows])
        assert whole(path) == ()
        assert read(path).channel("B").unit == "W"
        assert read(path).channel("A").unit.startswith("kN")


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize("above", [[], ["# a comment without names"], ["# fs = 2 Hz"]])
def test_a_table_without_names_is_refused(tmp_path, separator, above):
    rows = [row.replace(",", separator) for row in ROWS]
    path = put(tmp_path / "a.csv", [*above, *rows])
    for step in (0.5, None):
        assert "numbers stand where the names of the columns were" in sentence(path, step)
    rows = [f"north{separator}{row}" for row in rows]
    assert "numbers stand where" in sentence(put(tmp_path / "b.csv", [*above, *rows]), 0.5)


def test_a_table_of_decimal_commas_without_names_is_refused(tmp_path):
    rows = [row.replace(",", ";").replace(".", ",") for row in ROWS]
    assert "numbers stand where" in sentence(put(tmp_path / "a.csv", rows), 0.5)


def test_names_in_a_comment_right_above_numbers(tmp_path):
    rows = [row.split(",", 1)[1] for row in ROWS]
    run = read(put(tmp_path / "a.csv", ["# a test", "# A, B [W]", *rows]), 0.5)
    assert run.names == ("A", "B")
    np.testing.assert_array_equal(run.time, TIME)
    np.testing.assert_array_equal(run["B"], B)


def test_blanks_between_thousands_where_blanks_separate_columns(tmp_path):
    rows = [f"{0.5 * k:.1f}  {1 + k % 2} {37 * k:03d}.5  {k / 8:.3f}" for k in range(20)]
    table = [row.replace(".", ",") for row in rows]
    with pytest.raises(DfsmError) as error:
        read(put(tmp_path / "a.txt", ["Time  P  v", *table]))
    said = str(error.value)
    assert "line 2: 4 values, but the header names 3 columns" in said
    assert "if a blank sets thousands apart in it, as in 1 000.5, save the table without" in said
    # A blank in a name makes as many cells of the header.
    run = read(put(tmp_path / "b.txt", ["Time  Wind Speed  v", *table]))
    assert any("'Wind' and 'Speed' look like one number with a blank" in n for n in run.notes)
    # Three digits behind a whole number are two numbers as often.
    other = [f"{0.5 * k:.1f} {1 + k % 2} {100 + k} {k / 8:.3f}" for k in range(20)]
    assert read(put(tmp_path / "c.txt", ["Time a b v", *other])).notes == ()

"""Tables in text as programs leave them: what is a header, a row, an empty cell and a number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

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


def sentence(path: Path, step: float | None = None) -> str:
    with pytest.raises(DfsmError) as caught:
        read(path, step)
    assert "\n" not in str(caught.value)
    return str(caught.value)


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

"""Text files as loggers and measurement programs write them, made from their descriptions."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from dfsm.data.readers import read
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError

COUNT = 5
HEAD = {
    "Writer_Version": "2",
    "Separator": "Tab",
    "Decimal_Separator": ".",
    "Multi_Headings": "Yes",
    "X_Columns": "One",
    "Time_Pref": "Relative",
}


def lvm(*segments: str, **tags: str | None) -> str:
    lines = [f"{tag}\t{value}" for tag, value in (HEAD | tags).items() if value is not None]
    return "\n".join(["LabVIEW Measurement\t", *lines, "***End_of_Header***\t", "\t", *segments])


def segment(
    kind: str = "One", clock: str | None = "10:00:00.25", first: float = 0.0, **tags: str
) -> str:
    """Header and five rows of a force and a way, 0.1 s apart."""
    told = {"Y_Unit_Label": "N\tmm", "X_Dimension": "Time\tTime"}
    told |= {"X0": "0.0000000000000000E+0\t0.0000000000000000E+0", "Delta_X": "0.1\t0.1"}
    if clock:
        told |= {"Date": "2020/01/02\t2020/01/02", "Time": f"{clock}\t{clock}"}
    # How many samples there are, the program sometimes tells wrongly.
    lines = ["Channels\t2\t", "Samples\t100\t100\t"]
    lines += [f"{tag}\t{value}\t" for tag, value in (told | tags).items()]
    names = "Force\tX_Value\tWay" if kind == "Multi" else "Force\tWay"
    lines += ["***End_of_Header***\t\t\t", f"X_Value\t{names}\tComment"]
    for k in range(COUNT):
        x, force, way = f"{first + 0.1 * k:.6f}", f"{k + 0.5:.6f}", f"{k * k:.6f}"
        cells = {"No": ["", force, way], "One": [x, force, way], "Multi": [x, force, x, way]}
        lines.append("\t".join(cells[kind]))
    return "\n".join([*lines, ""])


def told(tmp_path: Path, text: str, name: str = "run.lvm") -> Trajectory:
    path = tmp_path / name
    path.write_text(text, encoding="latin-1")
    return read(path)


def refused(tmp_path: Path, text: str, name: str = "run.lvm") -> str:
    with pytest.raises(DfsmError) as caught:
        told(tmp_path, text, name)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def commas(text: str) -> str:
    return re.sub(r"(\d)\.(\d)", r"\1,\2", text)


FORCE, WAY = np.arange(COUNT) + 0.5, np.arange(COUNT) ** 2.0


@pytest.mark.parametrize(
    "text",
    [
        *(lvm(segment(kind), X_Columns=kind) for kind in ("No", "One", "Multi")),
        commas(lvm(segment("No"), X_Columns="No")).replace("Separator\t.", "Separator\t,"),
        commas(lvm(segment(), Decimal_Separator=None)),
        lvm(segment(), Separator="Comma").replace("\t", ","),
        lvm("***Start_Special***\n1\t2\n***End_Special***", segment(), "end of the record\n"),
        lvm(segment().replace("4.500000\t16.000000", "4.500000\t16.000000\twell done")),
    ],
    ids=[
        "No",
        "One",
        "Multi",
        "comma",
        "untold comma",
        "separated by commas",
        "special",
        "comment",
    ],
)
def test_labview_measurements(tmp_path, text):
    run = told(tmp_path, text)
    assert [(c.name, c.unit) for c in run.channels] == [("Force", "N"), ("Way", "mm")]
    np.testing.assert_allclose(run.time, 0.1 * np.arange(COUNT), atol=1e-12)
    assert np.array_equal(run.values, np.column_stack([FORCE, WAY]))


def test_segments_of_labview_are_one_record(tmp_path):
    goes_on = told(tmp_path, lvm(segment(), segment(first=0.5, clock=None)))
    by_clock = told(
        tmp_path, lvm(segment("No"), segment("No", clock="10:00:00.7500004"), X_Columns="No")
    )
    for run in (goes_on, by_clock):
        np.testing.assert_allclose(run.time, 0.1 * np.arange(2 * COUNT), atol=1e-12)
        assert np.array_equal(run["Way"], np.tile(WAY, 2))
    assert any("2 segments follow one another" in note for note in by_clock.notes)
    one_header = lvm(segment(), *segment(first=0.5).split("\n")[-COUNT - 1 :])
    assert len(told(tmp_path, one_header)) == 2 * COUNT
    later = told(tmp_path, lvm(segment(), segment(clock="10:01:00.25")))
    assert later.time[COUNT] == pytest.approx(60)
    absolute = segment().replace("0.000000\t0.5", "3660000000.0\t0.5")
    for k in range(1, COUNT):
        absolute = absolute.replace(f"\n0.{k}00000\t", f"\n366000000{k}.0\t")
    run = told(tmp_path, lvm(absolute, Time_Pref="Absolute"))
    assert np.array_equal(run.time, np.arange(COUNT))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (lvm(segment(), segment()), "segments overlap by their dates"),
        (lvm(segment(), segment(clock=None)), "no Date and Time"),
        (lvm(segment(), segment(Y_Unit_Label="N\tm")), "other channels or units"),
        (lvm(segment("No", Delta_X="0.1\t0.2"), X_Columns="No"), r"differ in Delta_X \(0.1, 0.2"),
        (lvm(segment("No", Delta_X="\t"), X_Columns="No"), "neither times .* Delta_X"),
        (lvm(segment("One"), X_Columns="No"), "where X_Columns No leaves nothing"),
        (
            lvm(segment("Multi").replace("0.100000\t1.0", "0.200000\t1.0"), X_Columns="Multi"),
            "'Way' has times of its own",
        ),
        (lvm(segment(X_Dimension="Frequency\tFrequency")), "the X axis .* 'frequency'"),
        (lvm(segment().replace("0.200000\t", "abc\t")), "'abc' in column 1 is no number"),
        (lvm(segment().replace("\t4.000000\n", "\n")), "2 values, but the header names 3"),
        (lvm(), "no samples below its headers"),
        (lvm(segment(), Separator="Blank"), "its Separator is 'Blank'"),
        (lvm(segment(), X_Columns="Two"), "its X_Columns is 'Two'"),
        (
            lvm(segment(), Separator="Comma", Decimal_Separator=",").replace("\t", ","),
            "commas separate its cells and stand before decimals as well",
        ),
    ],
)
def test_labview_files_that_say_too_little_are_refused(tmp_path, text, expected):
    assert re.search(expected, refused(tmp_path, text))


TOA5 = (
    '"TOA5","Mast","CR1000","1031","CR1000.Std.32","CPU:wind.CR1","4062","Fast"\n'
    '"TIMESTAMP","RECORD","Wind","TC_Avg(1)","TC_Avg(2)"\n'
    '"TS","RN","m/s","Deg C","Volts"\n'
    '"","","Smp","Avg","Avg"\n'
)
CATMAN = (
    "Comment:\nDate\t01.02.2010\nTime\t12:10:11\n\n"
    "Time  1 - default sample rate\tKraft\tWeg\n"
    "T0 = 01.02.2010 12:10:11\tSerNo=1A\t\ndt = 20 ms\tdt = 20 ms\tdt = 20 ms\ns\tkN\tmm\n"
)


def test_campbell_s_toa5(tmp_path):
    rows = [
        f'"2004-11-11 15:03:{45 + k / 4:.4g}",{458 + k},{k + 0.5},{25 - k},{"NAN" if k == 3 else k}'
        for k in range(8)
    ]
    run = told(tmp_path, TOA5 + "\n".join(rows) + "\n", "mast.csv")
    named = [("RECORD", ""), ("Wind", "m/s"), ("TC_Avg(1)", "Deg C"), ("TC_Avg(2)", "Volts")]
    assert [(c.name, c.unit) for c in run.channels] == named
    assert run.time_step == pytest.approx(0.25)
    assert np.array_equal(run["Wind"], np.arange(8) + 0.5)
    assert np.isnan(run["TC_Avg(2)"]).tolist() == [k == 3 for k in range(8)]
    assert any("line 4 holds words about the columns" in note for note in run.notes)


def test_catman_imc_and_dewesoft(tmp_path):
    table = commas("".join(f"{k * 0.02:.3f}\t{k * 1.5:.2f}\t{k * k}\n" for k in range(8)))
    run = told(tmp_path, CATMAN + table, "catman.asc")
    assert [(c.name, c.unit) for c in run.channels] == [("Kraft", "kN"), ("Weg", "mm")]
    assert run.time_step == pytest.approx(0.02)
    assert np.array_equal(run["Kraft"], 1.5 * np.arange(8))
    two = CATMAN.replace("\tWeg", "\tTime  2 - slow sample rate")
    assert "so channels were sampled apart" in refused(tmp_path, two + table, "catman.asc")
    imc = "Time;Kraft;Weg\ns;kN;mm\n-;Max;Max\n" + table.replace("\t", ";")
    units = "Kraft;Weg\nkN;mm\n" + re.sub("(?m)^[^\t]*\t", "", table).replace("\t", ";")
    above = "Data export\nStart time: 1/1/2010 12:00:00.000\nSample rate: 50 Hz\n\n"
    dewesoft = above + "Time (s);Kraft (kN);Weg (mm)\n" + table.replace("\t", ";")
    for text in (imc, dewesoft, "Sample rate;50 Hz\n" + units):
        other = told(tmp_path, text, "other.csv")
        assert other.channels == run.channels
        assert other.time_step == pytest.approx(0.02)
        assert np.array_equal(other.values, run.values)
    # Without a unit nobody knows what a row of words is.
    lost = "Time;Kraft\nabc;def\n0,1;2\n0,2;3\n"
    assert "'abc' in column 1 is no number" in refused(tmp_path, lost, "lost.csv")


def test_channels_with_their_own_times(tmp_path):
    rows = [(0.5 * k, k, 0.5 * k, 1.5 * k) for k in range(8)]
    text = "Time,a,Time,b\n" + "".join(f"{t},{a},{u},{b}\n" for t, a, u, b in rows)
    run = told(tmp_path, text, "own.csv")
    assert run.names == ("a", "b")
    assert any("column 3 left out: the time once more" in note for note in run.notes)
    other = "Time,a,Time,b\n" + "".join(f"{t},{a},{2 * u},{b}\n" for t, a, u, b in rows)
    assert "columns 1 and 3 are both called 'Time'" in refused(tmp_path, other, "own.csv")

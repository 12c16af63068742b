"""Files as loggers, spreadsheets, MATLAB and Fortran write them: read, or told in one sentence."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from conftest import Dfsm, sentence
from dfsm.data.readers import read
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError

TIME = 0.1 * np.arange(40)
HEAD = ["made by a test", "", "Time\tPtfmPitch\tGenTq"]


def put(path: Path, content: str | bytes, encoding: str = "utf-8") -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def out_rows(count: int = 40) -> list[str]:
    return [f"{t:10.4f}\t{np.sin(t):11.3E}\t{1 + t / 9:11.3E}" for t in TIME[:count]]


def out(path: Path, units: str = "(s)\t(deg)\t(kN-m)", rows: list[str] | None = None, **put_as):
    lines = [*HEAD, units, *(out_rows() if rows is None else rows)]
    return read(put(path, "\n".join(lines) + put_as.pop("end", "\n"), **put_as))


# -- OpenFAST's text ----------------------------------------------------------------------------


def test_units_with_blanks_without_text_and_in_any_encoding(tmp_path):
    path = tmp_path / "a.out"
    for units, expected in {
        "(s)\t(deg)\t(kN m)": ["deg", "kN m"],
        "(s)\t\t(kN-m)": ["", "kN-m"],
        "(s) (deg) (kN m)": ["deg", "kN m"],
        "(s)\t(deg)\t(kN·m)": ["deg", "kN·m"],
    }.items():
        for encoding in ("utf-8", "latin-1"):
            run = out(path, units, encoding=encoding)
            assert [c.unit for c in run.channels] == expected
            assert len(run) == 40


def test_fortran_numbers_and_stars(tmp_path):
    rows = out_rows()
    rows[3] = f"{TIME[3]:10.4f}\t 1.0D-01\t 1.000-101"
    rows[5] = f"{TIME[5]:10.4f}\t 2.0E-01**********"
    run = out(tmp_path / "a.out", rows=rows)
    assert (run["PtfmPitch"][3], run["GenTq"][3]) == (0.1, 1e-101)
    assert run["PtfmPitch"][5] == 0.2
    assert np.flatnonzero(np.isnan(run["GenTq"])).tolist() == [5]
    assert run.notes == (
        "'GenTq' has 1 value written as stars, too wide for the column (at 0.5 s): missing",
    )


def test_what_follows_the_last_record(tmp_path):
    whole = out(tmp_path / "a.out")
    assert whole.notes == ()
    blank = out(tmp_path / "b.out", rows=[*out_rows(), "", "  "])
    assert (len(blank), blank.notes) == (40, ())
    footer = out(tmp_path / "c.out", rows=[*out_rows(), "Total run time: 12 s", "OpenFAST ended"])
    assert len(footer) == 40
    assert footer.notes == ("lines 45 to 46 hold words below the last record: passed over",)
    for cut in (1, 2, 7, 13):  # in the exponent, behind it, in the mantissa, in the column before
        run = out(tmp_path / "d.out", rows=[*out_rows(39), out_rows()[39][:-cut]], end="")
        assert len(run) == 39, cut
        assert "ends without a line end inside the record of line 44" in run.notes[0]
    assert len(out(tmp_path / "e.out", end="")) == 40  # whole, but for its line end


def test_printed_digits_are_a_quantisation_step(tmp_path):
    run = out(tmp_path / "a.out", rows=[f"{t:10.4f} {9e3 + t:10.3E} {t:8.2f}" for t in TIME])
    assert [c.step for c in run.channels] == [1.0, 0.01]
    exact = "Time,a\n" + "".join(f"{t:.17g},{np.sin(t):.17g}\n" for t in TIME)
    assert read(put(tmp_path / "a.csv", exact)).channels[0].step is None


def test_rounded_times_lie_on_the_mesh_that_was_meant(tmp_path):
    exact = 0.00625 * np.arange(400)
    run = out(tmp_path / "a.out", rows=[f"{t:10.4f} {t:11.3E} 1" for t in exact])
    np.testing.assert_allclose(run.time, exact, rtol=0, atol=1e-12)


def test_the_log_of_rosco_loses_the_row_of_its_start_call(tmp_path):
    rows = ["  0.0 1 2", "  0.0 3 4", "  0.1 5 6"]
    lines = ["Generated on a day using ROSCO", "Time  PtfmPitch  GenTq", "(sec) (rad) (Nm)", *rows]
    run = read(put(tmp_path / "a.RO.dbg", "\n".join(lines) + "\n"))
    assert np.array_equal(run.time, [0.0, 0.1])
    assert np.array_equal(run.values, [[3, 4], [5, 6]])
    assert "the first of two rows at 0 s left out" in run.notes[0]


# -- tables -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "Time,A,B\n(s),(deg),(kN m)\n0,1,2\n0.1,3,4\n",
        "# my comment\nTime,A,B\ns,deg,kN m\n0,1,2\n# in between\n0.1,3,4\n",
        "Logger 7\nof today\n\nTime;A;B\n[s];[deg];[kN m]\n0;1;2\n0.1;3;4\nEnd\n",
        "Time [s]  A [deg]   B (kN m)\n 0  1 2\n0.1   3   4\n",
        "# Time A[deg] B[kN m]\n0 1 2\n0.1 3 4\n",
        'Time [s],A [deg],Case,B [kN m]\n0,1,"DLC, 1.1",2\n0.1,3,"DLC, 1.1",4\n',
    ],
)
def test_units_rows_comments_blanks_titles_and_words(tmp_path, text):
    run = read(put(tmp_path / "a.csv", text))
    assert [(c.name, c.unit) for c in run.channels] == [("A", "deg"), ("B", "kN m")]
    assert np.array_equal(run.time, [0, 0.1])
    assert np.array_equal(run.values, [[1, 2], [3, 4]])
    assert len(run.notes) == ("End" in text or "Case" in text)


@pytest.mark.parametrize(
    "text",
    ["x,y,Ts,\n1,2,0.5,\n3,4,,\n5,6,,\n", "# fs = 2 Hz\nx,y\n1,2\n3,4\n5,6\n"],
)
def test_a_rate_instead_of_a_time(tmp_path, text):
    run = read(put(tmp_path / "a.csv", text))
    assert run.names == ("x", "y")
    assert np.array_equal(run.time, [0, 0.5, 1])
    assert any("no time column: samples every 0.5 s" in n for n in run.notes)


def test_the_interval_is_told_to_commands(tmp_path, dfsm: Dfsm):
    path = put(tmp_path / "a.csv", "x,y\n" + "".join(f"{np.sin(t)},{t}\n" for t in TIME))
    assert "tell the interval of samples at a fixed rate (--step" in sentence(path)
    assert np.array_equal(read(path, 0.1).time, TIME)
    assert "40 samples, 0 to 3.9 s, every 0.1 s" in dfsm("info", path, "--step", 0.1).out
    dfsm("init", path, "--step", 0.1, "-o", tmp_path / "c.yaml")
    assert "\n  step: 0.1 " in (tmp_path / "c.yaml").read_text()


STAMPS = [
    ["2016-01-10T12:24:00Z", "2016-01-10T12:24:10Z", "2016-01-10T12:24:20Z"],
    ["10/01/2016 12:24:00", "10/01/2016 12:24:10", "10/01/2016 12:24:20"],
    ["30.01.2016 23:59:55", "31.01.2016 00:00:05", "31.01.2016 00:00:15"],
    ["23:59:55.0", "00:00:05.0", "00:00:15.0"],
]


@pytest.mark.parametrize("stamps", STAMPS)
def test_time_stamps_are_seconds_since_the_first(tmp_path, stamps):
    rows = "".join(f"{s},{i}\n" for i, s in enumerate(stamps))
    run = read(put(tmp_path / "a.csv", "time,x\n" + rows))
    assert np.array_equal(run.time, [0, 10, 20])
    assert run.notes == (
        f"'time' holds time stamps: times are seconds since the first, {stamps[0]}",
    )


def test_time_stamps_in_parquet_and_stamps_that_are_open(tmp_path):
    frame = pd.DataFrame({"time": pd.to_datetime(STAMPS[0]), "x": [1.0, 2, 3]})
    for saved in (frame, frame.set_index("time")):
        saved.to_parquet(tmp_path / "a.parquet")
        run = read(tmp_path / "a.parquet")
        assert np.array_equal(run.time, [0, 10, 20])
        assert "'time' holds time stamps" in run.notes[0]
    text = "time,x\n01/02/2016 00:00:00,1\n01/03/2016 00:00:00,2\n"
    assert "begins with the day or the month" in sentence(put(tmp_path / "b.csv", text))
    text = "time,x\n2016-01-10T12:24:00Z,1\nlater,2\n3,4\n"
    assert "'later' in 'time' is no time stamp" in sentence(put(tmp_path / "c.csv", text))


# -- HAWC2 --------------------------------------------------------------------------------------


def test_hawc2_in_text_and_binary(tmp_path):
    told = [
        ("Time", "s", "Time"),
        ("Wind", "m/s", "here"),
        ("Wind", "m/s", "there"),
        ("Q", "-", ""),
    ]
    table = np.stack([TIME + 0.1, 8 + np.sin(TIME), 9 + np.cos(TIME), TIME**2], axis=1)
    lines = [f"{i:6d}      {n:<31}{u:<11}{d}" for i, (n, u, d) in enumerate(told, start=1)]
    scales = np.abs(table).max(axis=0) / 32000
    for form in ("ASCII", "BINARY"):
        head = ["_" * 60, f"  {len(TIME):8d} {4:6d} {4.0:14.3f}       {form}", "", "  Channel", ""]
        tail = ["", "Scale factors:", *(f"  {s:.9E}" for s in scales)] if form == "BINARY" else []
        put(tmp_path / "a.sel", "\n".join([*head, *lines, *tail]) + "\n")
        if form == "ASCII":
            np.savetxt(tmp_path / "a.dat", table, fmt="%13.6E")
        else:
            np.rint(table / scales).T.astype("<i2").tofile(tmp_path / "a.dat")
        run = read(tmp_path / "a.dat")
        assert run.names == ("Wind: here", "Wind: there", "Q")
        assert [c.unit for c in run.channels] == ["m/s", "m/s", ""]
        np.testing.assert_allclose(run.time, table[:, 0], atol=0.51 * scales[0])
        assert (np.abs(run.values - table[:, 1:]) <= 0.51 * scales[1:] + 1e-6).all()
        assert read(tmp_path / "a.sel").digest == run.digest
    np.testing.assert_allclose([c.step for c in run.channels], scales[1:], rtol=1e-8)
    put(tmp_path / "a.dat", (tmp_path / "a.dat").read_bytes()[:-2])
    assert "318 bytes, but its .sel announces 4 channels and 40 scans" in sentence(
        tmp_path / "a.sel"
    )


# -- MATLAB -------------------------------------------------------------------------------------


def mat(path: Path, content: dict, **options: object) -> Trajectory:
    savemat(path, content, **options)  # pyright: ignore[reportArgumentType]
    return read(path)


@pytest.mark.parametrize("packed", [False, True])
def test_structs_and_matrices_are_flattened(tmp_path, packed):
    path, wide = tmp_path / "a.mat", np.outer(TIME, [1.0, 2, 3])
    column = TIME[:, None]
    run = mat(path, {"time": TIME, "position": wide}, do_compression=packed)
    assert run.names == ("position_1", "position_2", "position_3")
    assert np.array_equal(run.values, wide)
    body = {"time": column, "position": wide, "name": "float", "ids": np.arange(3)}
    run = mat(path, {"body": body, "wave": {"time": column, "elev": column**2}})
    assert run.names == ("body.position_1", "body.position_2", "body.position_3", "wave.elev")
    assert [n.split(" left out")[0] for n in run.notes] == ["'body.name'", "'body.ids'"]
    run = mat(path, {"wave": {"t": TIME, "elev": TIME}, "late": {"t": TIME + 1, "y": TIME}})
    assert run.names == ("wave.elev",)
    assert "'late.y' left out: 'late.t' is another time" in run.notes
    bodies = np.array([({"x": column},), ({"x": 2 * column},)], dtype=[("response", object)])
    run = mat(path, {"output": {"time": column, "bodies": bodies}})
    assert run.names == ("bodies_1.response.x", "bodies_2.response.x")


def test_simulink_rates_and_version_4(tmp_path):
    path = tmp_path / "a.mat"
    signals = {"values": np.outer(TIME, [1, 2]), "dimensions": 2, "label": "pos"}
    run = mat(path, {"simout": {"time": TIME[:, None], "signals": signals}})
    assert run.names == ("signals.values_1", "signals.values_2")
    for rate in ({"fs": 10.0}, {"Ts": 0.1}, {"dt": 0.1}):
        run = mat(path, {"u": TIME, "y": TIME**2, **rate})
        assert run.names == ("u", "y")
        np.testing.assert_allclose(run.time, TIME)
    run = mat(path, {"t": TIME, "y": TIME**2, "word": "abc"}, format="4")
    assert run.names == ("y",)
    assert np.array_equal(run["y"], TIME**2)
    savemat(path, {"u": TIME, "note": "a word"})
    assert "found: u (1 x 40), note (a text)" in sentence(path)


def test_damaged_tags_are_sentences(tmp_path):
    path, rng = tmp_path / "a.mat", np.random.default_rng(1)
    content = {"s": {"time": TIME, "x": np.ones((40, 2)), "c": ["a", 1.0]}, "k": np.uint8(3)}
    savemat(path, content)
    raw = path.read_bytes()
    told = 0
    for _ in range(120):
        changed = bytearray(raw)
        # Tags of elements stand before the numbers.
        for at in rng.integers(128, 400, 2):
            changed[at] = rng.integers(256)
        path.write_bytes(changed)
        try:
            read(path)
        except DfsmError as error:
            told += "no readable MAT file" in str(error)
    assert told > 20
    bomb = zlib.compress(struct.pack("<II", 14, 2**32 - 1) + bytes(64))
    path.write_bytes(raw[:128] + struct.pack("<II", 15, len(bomb)) + bomb)
    assert "announces 4294967295 bytes, 64 are there" in sentence(path)


def test_hdf5_from_matlab(tmp_path):
    path = tmp_path / "a.mat"
    try:
        import h5py  # pyright: ignore[reportMissingImports]
    except ImportError:
        path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
        assert "needs h5py: pip install 'dfsm[hdf5]'" in sentence(path)
        return
    with h5py.File(path, "w", userblock_size=512) as file:
        body = file.create_group("body")
        for name, values in {"time": TIME[None, :], "x": np.stack([TIME, TIME**2])}.items():
            body.create_dataset(name, data=values).attrs["MATLAB_class"] = np.bytes_("double")
    raw = path.read_bytes()
    run = read(path)
    assert run.names == ("x_1", "x_2")
    assert np.array_equal(run["x_2"], TIME**2)
    path.write_bytes(raw[: len(raw) // 2])
    assert "no readable HDF5 file" in sentence(path)


# -- decimal commas, thousands, rates and times as loggers name them ------------------------------


@pytest.mark.parametrize("separator", [";", "\t", "  "])
@pytest.mark.parametrize("encoding", ["cp1252", "utf-16"])
def test_decimal_commas_are_read(tmp_path, separator, encoding):
    rows = [[f"{t:.2f}", f"{np.sin(t):.3e}", f"{1234.5 * np.cos(t):.4f}"] for t in TIME]
    lines = ["Zeit [s];Kraft [kN];Temp [°C]".replace(";", separator)]
    lines += [separator.join(row).replace(".", ",") for row in rows]
    run = read(put(tmp_path / "a.csv", "\r\n".join(lines) + "\r\n", encoding))
    assert np.array_equal(run.values, np.array(rows, dtype=float)[:, 1:])
    assert run.time_step == pytest.approx(0.1)
    assert [(c.name, c.unit) for c in run.channels] == [("Kraft", "kN"), ("Temp", "°C")]
    assert run.channel("Temp").step == 1e-4
    assert "decimals have commas: read as numbers" in run.notes


def test_thousands_in_both_ways_of_writing(tmp_path):
    lines = ["sep=;", "Time;x;n"]
    lines += [f"{t:.1f}".replace(".", ",") + ";1.234,5;12.000" for t in TIME]
    european = read(put(tmp_path / "a.csv", "\n".join(lines) + "\n"))
    lines = ["Time,x,n", *(f'{t:.1f},"1,234.5","12,000"' for t in TIME)]
    american = read(put(tmp_path / "b.csv", "\n".join(lines) + "\n"))
    for run in (european, american):
        assert np.array_equal(run.values, np.tile([1234.5, 12000.0], (40, 1)))
        assert run.time[-1] == pytest.approx(3.9)
        assert len(run.notes) == 1
        assert "thousands" in run.notes[0]


@pytest.mark.parametrize(
    ("header", "cell", "step"),
    [
        ("x,dt [ms]", ",50", 0.05),
        ("x,fs [kHz]", ",0.02", 0.05),
        ("x,fs", ",20", 0.05),
        ("# logger 3, Ts = 50 ms\nx", "", 0.05),
        ("# fs = 2 kHz, gain 1\nx", "", 0.0005),
        ("% fs: 20 samples/s\nx", "", 0.05),
        ("Sample rate,20 Hz\nx", "", 0.05),
    ],
)
def test_a_rate_has_the_unit_beside_it(tmp_path, header, cell, step):
    lines = [header, *(f"{np.sin(t):.4f}{cell}" for t in TIME)]
    run = read(put(tmp_path / "a.csv", "\n".join(lines) + "\n"))
    assert run.names == ("x",)
    assert run.time_step == pytest.approx(step, rel=1e-12)


def test_an_interval_in_another_unit_is_none(tmp_path):
    path = put(tmp_path / "a.csv", "x,dt [m]\n" + "1,50\n2,50\n" * 5)
    assert "no time column" in sentence(path)


@pytest.mark.parametrize(("count", "per"), [("milliseconds", 1000), ("seconds", 1)])
def test_times_that_count_from_1970(tmp_path, count, per):
    start = 1_452_428_640 * per
    lines = ["timestamp,x", *(f"{start + k * per},{k**2}" for k in range(40))]
    run = read(put(tmp_path / "a.csv", "\n".join(lines) + "\n"))
    assert np.array_equal(run.time, np.arange(40.0))
    assert run.notes == (
        f"'timestamp' counts {count} since 1970: times are seconds since the first",
    )

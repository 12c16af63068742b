"""CSV, Parquet and MAT files."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from benchmarks.outb import smooth_run, write_outb
from dfsm.data.readers import read
from dfsm.data.readers.openfast import read_openfast
from dfsm.data.readers.tables import read_table, write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

EXAMPLES = Path(__file__).parents[1] / "examples" / "iea15"
quick = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def some_run(**changes) -> Trajectory:
    time, values = smooth_run()
    channels = (
        Channel("GenTq", "kN-m", 0.5, "control"),
        Channel("PtfmPitch", "deg", None, "state"),
        Channel("Cp", ""),
    )
    run = Trajectory(
        time, values, channels, name="first", wall_time=12.25, notes=("something was left out",)
    )
    return replace(run, **changes)


def text(path: Path, content: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(content.encode(encoding))
    return path


def fails(path: Path, match: str) -> None:
    with pytest.raises(DfsmError, match=match) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# -- CSV ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("sep", [",", ";", "\t"])
def test_csv_headers_encodings_and_separators(tmp_path, encoding, end, sep):
    rows = [
        ["Time_[s]", "A_[deg]", "B [°C]", "C (kN-m)", "D"],
        ["0", "1", "2.5", "-3e2", "4"],
        ["0.5", "1.5", "", "nan", "5"],
    ]
    path = text(tmp_path / "a.csv", end.join(sep.join(r) for r in rows) + end, encoding)
    run = read(path)
    assert run.names == ("A", "B", "C", "D")
    assert [c.unit for c in run.channels] == ["deg", "°C", "kN-m", ""]
    assert np.array_equal(run.time, [0, 0.5])
    expected = [[1, 2.5, -300, 4], [1.5, np.nan, np.nan, 5]]
    assert np.array_equal(run.values, expected, equal_nan=True)
    assert run.name == "a"


@pytest.mark.parametrize("time", ["Time", "time", "t", "T (sec)", "TIME [s]"])
def test_csv_time_column_anywhere(tmp_path, time):
    run = read(text(tmp_path / "a.csv", f"x,{time},y\n1,0,2\n3,1,4\n"))
    assert run.names == ("x", "y")
    assert np.array_equal(run.time, [0, 1])


@pytest.mark.parametrize(
    ("time", "scale"), [("Time (ms)", 1e-3), ("t (min)", 60.0), ("time [h]", 3600.0)]
)
def test_csv_times_in_other_units_are_converted(tmp_path, time, scale):
    run = read(text(tmp_path / "a.csv", f"{time},x\n1,2\n3,4\n"))
    np.testing.assert_allclose(run.time, [scale, 3 * scale], rtol=1e-12)
    assert any("times are converted to s" in note for note in run.notes)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("x,y\n1,2\n3,4\n", "no time column, expected .* found: x, y"),
        ("Time (mm),y\n1,2\n3,4\n", "time 'Time' is in 'mm', expected s"),
        ("t,y\n1,2\n3\n", "line 3: 1 values, but the header names 2"),
        ("t,y\n1,2\n\n3,4,5\n", "line 4: 3 values"),
        ("t,y\n1,2\n2,*x*\n", r"line 3: '\*x\*' in column 2 is no number"),
        ("t;y\n1;2,5\n2;3.5\n", r"line 2 has a decimal comma \('2,5'\) and line 3 a decimal point"),
        ("t\ty\n1\t2,500\n2\t3,125\n", "between thousands is open, .*: save the table with points"),
        ("t;y\n1;2,5,1\n2;3\n", "'2,5,1' in column 2 is no number: correct it"),
        ("t,y\n0,0\n0,1,2,5\n", "line 3: 4 values, .*: if its decimals have commas, save it with"),
        ("t,y\n0,0\n1,-2,5\n", "line 3: 3 values, .*: if its decimals have commas"),
        ("t,y\n0,0\n1,2.5,3\n", "line 3: 3 values, .* 2 columns: correct or remove the line"),
        ("t,y\n1,2\n1,3\n", "time repeats at sample 1"),
        ("t,y\n", "0 samples"),
        ("t,y\n1,2\n", "1 samples"),
        ("t\n1\n2\n", "no channel besides time"),
        ("\n\n", "blank lines only"),
        ("", "is empty"),
        ("t,y\n1,2\0\n", "binary file"),
        ('t,y\n1,"2\n', "line 2: 1 values|line 3: .*|is no number|1 samples"),
    ],
)
def test_bad_csv_is_a_sentence(tmp_path, content, match):
    fails(text(tmp_path / "a.csv", content), match)


def test_csv_duplicates_and_invalid(tmp_path):
    run = read(text(tmp_path / "a.csv", "t,x,x,x,Invalid\n0,1,1,9,0\n1,2,2,8,0\n"))
    assert run.names == ("x", "x#2")
    assert len(run.notes) == 3


@pytest.mark.parametrize("kind", ["csv", "reread", "sliced", "parquet"])
def test_the_index_of_a_saved_table_is_no_channel(tmp_path, kind):
    path = tmp_path / ("a.parquet" if kind == "parquet" else "a.csv")
    frame = pd.DataFrame({"Time": np.arange(6) / 2, "A": np.arange(6) ** 2, "index": np.arange(6)})
    if kind in ("sliced", "parquet"):
        frame = frame.iloc[[1, 2, 4, 5]]
    if kind == "parquet":
        frame.to_parquet(path)
        assert "__index_level_0__" in pq.read_table(path).column_names
    else:
        frame.to_csv(path)
        assert path.read_text().startswith(",Time")
    if kind == "reread":
        pd.read_csv(path).to_csv(path, index=False)
        assert path.read_text().startswith("Unnamed: 0,Time")
    run = read(path)
    assert run.names == ("A", "index")  # a column that has a name stays
    assert np.array_equal(run["A"], frame["A"])
    number = 4 if kind == "parquet" else 1
    assert run.notes == (f"column {number} left out: it numbers the rows, as a saved index does",)


def test_other_columns_without_a_name(tmp_path):
    path = tmp_path / "a.csv"
    run = read(text(path, "t,x,\n0,1,\n1,2,\n"))
    assert run.names == ("x",)
    assert run.notes == ("column 3 left out: it has no name and no values",)
    for column in (("0.5", "1.5"), ("3", "1"), ("2", ""), ("inf", "inf")):
        rows = "".join(f"{i},{i},{v}\n" for i, v in enumerate(column))
        fails(text(path, "t,x, \n" + rows), "column 3 has no name: give it one in the header")
    assert read(text(path, "t,Unnamed: 3\n0,0.5\n1,0.7\n")).names == ("Unnamed: 3",)
    # An index without a name may well be the time, but that is not for a reader to guess.
    fails(text(path, ",x\n0.0,1\n0.5,2\n"), r"no time column, .* found: \(no name\), x")


def test_csv_round_trip_keeps_every_digit(tmp_path):
    channels = (Channel("A", "m/s^2"), Channel("B [odd]", ""), Channel('C, "D"', "kN-m(x)"))
    rng = np.random.default_rng(1)
    run = Trajectory(np.cumsum(rng.uniform(0.01, 1, 20)), rng.normal(size=(20, 3)) / 3, channels)
    write_table(run, tmp_path / "a.csv")
    back = read(tmp_path / "a.csv")
    assert back.digest == run.digest
    assert back.channels == channels
    assert (tmp_path / "a.csv").read_text().startswith("Time [s],A [m/s^2],B [odd] [],")


# -- Parquet ------------------------------------------------------------------------------------


def test_parquet_round_trip_keeps_everything(tmp_path):
    run = some_run()
    write_table(run, tmp_path / "a.parquet")
    back = read(tmp_path / "a.parquet")
    assert back.digest == run.digest
    assert back.channels == run.channels
    assert (back.name, back.wall_time, back.notes) == (run.name, run.wall_time, run.notes)
    assert back.source == str(tmp_path / "a.parquet")


@pytest.mark.parametrize("format_id", [1, 2, 4])
def test_packed_gives_a_decoded_outb_bit_for_bit(tmp_path, format_id):
    path = tmp_path / "a.outb"
    names, units = ("A", "B.x", "C#2"), ("m", "s", "-")
    time, values = smooth_run(500)
    values = np.column_stack([values, np.full(500, 3.25)])
    run = read(
        write_outb(path, time, values, (*names, "Still"), (*units, "m"), format_id=format_id)
    )
    write_table(run, tmp_path / "a.parquet", packed=True)
    back = read(tmp_path / "a.parquet")
    assert back.channels == run.channels
    assert np.array_equal(back.values, run.values)
    np.testing.assert_allclose(back.time, run.time, rtol=1e-15)
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.column_names[-1] == "Still"
    assert [table.schema.field(n).type for n in names] == [pa.int32()] * 3
    # packed time is rounded to 32 bits, so only the other formats are equidistant to rounding
    assert ("Time" in table.column_names) == (format_id == 1)
    meta = pq.ParquetFile(tmp_path / "a.parquet").metadata.row_group(0)
    for name in names:
        column = meta.column(table.column_names.index(name))
        assert "DELTA_BINARY_PACKED" in column.encodings
        assert column.compression == "ZSTD"


@quick
@given(
    codes=st.lists(st.integers(-32768, 32767), min_size=2, max_size=20),
    step=st.floats(1e-6, 1e6),
    offset=st.floats(-1e6, 1e6),
)
def test_packed_grid_of_any_step_and_offset(tmp_path, codes, step, offset):
    values = (np.array(codes, dtype=float) + offset) * step
    run = Trajectory(np.arange(len(codes)), values[:, None], (Channel("A", "m", step),))
    write_table(run, tmp_path / "a.parquet", packed=True)
    back = read(tmp_path / "a.parquet")
    assert back.channels == run.channels
    scale = np.abs(values).max() + 65536 * step
    np.testing.assert_allclose(back.values, run.values, rtol=0, atol=8 * np.spacing(scale))
    stored = pq.read_table(tmp_path / "a.parquet").column("A").to_numpy()
    assert stored.dtype == np.int32
    assert np.array_equal(stored - stored[0], np.array(codes) - codes[0])


def test_what_is_off_its_grid_is_not_packed(tmp_path):
    time, values = smooth_run()
    wide = np.linspace(0, 70000, len(time)).round()
    gap = np.where(np.arange(len(time)) == 3, np.nan, np.arange(len(time)))
    irregular = time**1.5
    run = Trajectory(
        irregular,
        np.column_stack([values[:, 0], wide, gap]),
        (Channel("off", "m", 0.5), Channel("wide", "m", 1.0), Channel("gap", "m", 1.0)),
    )
    write_table(run, tmp_path / "a.parquet", packed=True)
    assert pq.read_table(tmp_path / "a.parquet").schema.types == [pa.float64()] * 4
    back = read(tmp_path / "a.parquet")
    assert np.array_equal(back.values, run.values, equal_nan=True)
    assert np.array_equal(back.time, irregular)
    assert back.channels == run.channels


def test_a_windowed_run_packs_to_the_same_values(tmp_path):
    run = read(EXAMPLES / "iea15_2dof_06mps_s09.outb").window(100, 160)
    write_table(run, tmp_path / "a.parquet", packed=True)
    back = read(tmp_path / "a.parquet")
    assert back.channels == run.channels
    np.testing.assert_allclose(back.values, run.values, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(back.time, run.time, rtol=0, atol=1e-12)
    assert (tmp_path / "a.parquet").stat().st_size < 100_000


def test_plain_pandas_tables(tmp_path):
    path = tmp_path / "a.parquet"
    frame = pd.DataFrame({"Time": [0.0, 1.0], "A_[deg]": [1, 2], "B": [True, False]})
    frame.to_parquet(path)
    run = read(path)
    assert run.names == ("A", "B")
    assert run.channels[0].unit == "deg"
    assert np.array_equal(run.values, [[1, 1], [2, 0]])
    frame.drop(columns="Time").set_index(pd.Index([0.5, 0.75])).to_parquet(path)
    assert np.array_equal(read(path).time, [0.5, 0.75])
    frame.drop(columns="Time").set_index(pd.Index([0.5, 0.75], name="seconds")).to_parquet(path)
    run = read(path)
    assert np.array_equal(run.time, [0.5, 0.75])
    assert run.names == ("A", "B")
    frame.drop(columns="Time").to_parquet(path)
    fails(path, "no time column")
    frame.drop(columns="Time").set_index(pd.Index([3, 7])).to_parquet(path)
    fails(path, "no time column")
    pd.DataFrame({"Time": [0.0, 1.0], "A": [None, 2]}).to_parquet(path)
    assert np.array_equal(read(path)["A"], [np.nan, 2], equal_nan=True)
    some_run().to_pandas().to_parquet(path)
    back = read(path)
    assert [c.unit for c in back.channels] == ["kN-m", "deg", ""]
    assert np.array_equal(back.values, some_run().values)


def test_bad_parquet_is_a_sentence(tmp_path):
    path = tmp_path / "a.parquet"
    text(path, "not a table")
    fails(path, "no readable Parquet file")
    pd.DataFrame({"Time": [0.0, 1.0], "A": ["x", "y"]}).to_parquet(path)
    fails(path, "column 'A' holds .*string, expected numbers")
    pd.DataFrame({"Time": [0.0, 1.0]}).to_parquet(path)
    fails(path, "no channel besides time")
    for known, match in [
        ({"unit": "m", "step": "wide"}, "give 'step' as 'wide', expected a number"),
        ({"unit": "m", "role": "king"}, "the role 'king', expected one of state"),
        ({"unit": "m", "scale": "0", "offset": "1"}, "a scale of 0"),
        ({"unit": "m", "scale": "2"}, "give 'offset' as 'None'"),
    ]:
        fields = [pa.field("Time", pa.float64()), pa.field("A", pa.int32(), metadata=known)]
        table = pa.table([[0.0, 1.0], [1, 2]], schema=pa.schema(fields))
        pq.write_table(table, path)
        fails(path, match)
    pq.write_table(table.replace_schema_metadata({"pandas": "{"}).drop_columns("Time"), path)
    fails(path, "offset|pandas metadata")


@quick
@given(st.data())
def test_a_cut_parquet_is_a_sentence(tmp_path, data):
    whole = tmp_path / "whole.parquet"
    if not whole.exists():
        write_table(some_run(), whole)
    raw = whole.read_bytes()
    path = tmp_path / "cut.parquet"
    path.write_bytes(raw[: data.draw(st.integers(0, len(raw) - 1))])
    with pytest.raises(DfsmError):
        read(path)


def test_writing_refuses_what_it_cannot_keep(tmp_path):
    run = some_run()
    for name, packed in (("a.xlsx", False), ("a.csv", True), ("a", False)):
        with pytest.raises(DfsmError, match="a table is written to"):
            write_table(run, tmp_path / name, packed=packed)
    clash = replace(run, channels=(Channel("Time"), *run.channels[1:]))
    with pytest.raises(DfsmError, match="a channel called 'Time'"):
        write_table(clash, tmp_path / "a.parquet")
    nameless = replace(run, channels=(Channel(" "), *run.channels[1:]))
    with pytest.raises(DfsmError, match="a channel has no name"):
        write_table(nameless, tmp_path / "a.parquet")
    odd = replace(run, channels=(Channel("A", "[m]"), *run.channels[1:]))
    with pytest.raises(DfsmError, match=r"write \.parquet instead"):
        write_table(odd, tmp_path / "a.csv")
    with pytest.raises(DfsmError, match="could not be written"):
        write_table(run, tmp_path / "nowhere" / "a.parquet")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.parquet"
    write_table(some_run(), path)
    before = path.read_bytes()

    def full(_table, where, **_options):
        Path(where).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(DfsmError, match="No space left on device"):
        write_table(some_run(name="second"), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# -- bundled data -------------------------------------------------------------------------------


def test_the_bundled_runs_are_complete_and_small():
    files = [p for p in EXAMPLES.iterdir() if p.is_file()]
    winds = list((EXAMPLES / "winds").iterdir())
    assert sum(p.stat().st_size for p in (*files, *winds)) <= 14_500_000
    stems = {p.stem for p in files if p.suffix in (".outb", ".parquet")}
    assert len(stems) == 44
    # Every run has the wind of its seed; perturbed runs have that of their namesake.
    assert {p.stem for p in winds} == {f"iea15_{'_'.join(s.split('_')[2:4])}" for s in stems}
    assert sum(p.suffix == ".outb" for p in files) == 3
    wall_times = json.loads((EXAMPLES / "wall_times.json").read_text())
    timed = {s for s in stems if s.split("_")[2] in ("06mps", "12mps", "18mps")}
    assert set(wall_times) == timed
    run = read(EXAMPLES / "iea15_2dof_12mps_s02_ol.parquet")
    assert run.name == "iea15_2dof_12mps_s02_ol"
    assert run.wall_time == wall_times[run.name]
    assert run.time_step == pytest.approx(0.05)
    assert run.values.shape == (14001, 15)
    real = read_openfast(EXAMPLES / "iea15_2dof_12mps_s09.outb")
    assert {(c.name, c.unit) for c in run.channels} < {(c.name, c.unit) for c in real.channels}
    assert all(c.step is not None for c in run.channels)


# -- MAT ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Time", "time", "t", "tout"])
def test_mat_vectors(tmp_path, name):
    path = tmp_path / "a.mat"
    t = np.arange(4) / 2
    content = {name: t[:, None], "x": t**2, "y": -t[None, :], "gain": 3.0, "other": np.ones(7)}
    savemat(path, {**content, "label": "text"}, oned_as="column")
    run = read(path)
    assert run.names == ("x", "y")
    assert np.array_equal(run.time, t)
    assert np.array_equal(run["y"], -t)
    assert len(run.notes) == 3
    savemat(path, {"run": content})
    assert read(path).names == ("x", "y")


def test_mat_from_read_fast_binary(tmp_path):
    path = tmp_path / "a.mat"
    table = np.array([[0, 1, 2], [0.5, 3, 4], [1, 5, 6]])
    names, units = ["Time", "GenTq", "Pitch"], ["(s)", "(kN-m)", "(deg)"]
    content = {
        "Channels": table,
        "ChanName": np.array(names, dtype=object)[:, None],
        "ChanUnit": np.array(units, dtype=object)[:, None],
        "FileID": 4,
    }
    for saved in (content, {"out": content}, {**content, "ChanName": np.array(names)}):
        savemat(path, saved)
        run = read_table(path)
        assert run.names == ("GenTq", "Pitch")
        assert [c.unit for c in run.channels] == ["kN-m", "deg"]
        assert np.array_equal(run.values, table[:, 1:])
        assert np.array_equal(run.time, table[:, 0])
    savemat(path, {**content, "Channels": table[:, :2]})
    fails(path, "Channels is 3 x 2, but there are 3 ChanName")
    savemat(path, {"Channels": table})
    fails(path, "no ChanName")


def test_bad_mat_is_a_sentence(tmp_path):
    path = tmp_path / "a.mat"
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n"
    told = "is no readable HDF5 file" if find_spec("h5py") else "save with -v7"
    path.write_bytes(header)
    fails(path, told)
    path.write_bytes(b"\x89HDF\r\n\x1a\n".ljust(600))
    fails(path, told)
    savemat(path, {"x": np.arange(3)})
    fails(path, "no time column")
    raw = path.read_bytes()
    path.write_bytes(raw[:150])
    fails(path, "no readable MAT file")
    text(path, "nothing of the kind")
    fails(path, "no readable MAT file")
    savemat(path, {"t": np.arange(3)})
    fails(path, "no channel besides time")

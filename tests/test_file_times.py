"""Which column of a file is its time, and what its numbers count, in every format."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from conftest import sentence
from dfsm.data.readers import read
from dfsm.errors import DfsmError

COUNT = 60
TIME = 0.25 * np.arange(COUNT)
WAVE = np.sin(TIME)
WARM = 280 + 0.01 * np.arange(COUNT)  # increases as a time does
KINDS = ["csv", "parquet", "mat"]


def saved(folder: Path, kind: str, columns: dict[str, Any]) -> Path:
    """A table of some columns, written by the tools that people use."""
    path = folder / f"a.{kind}"
    if kind == "csv":
        pd.DataFrame(columns).to_csv(path, index=False)
    elif kind == "parquet":
        pd.DataFrame(columns).to_parquet(path, index=False)
    else:
        savemat(path, columns)
    return path


def put(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


# -- names --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["time", "t", "Zeit", "Elapsed"])
@pytest.mark.parametrize("values", [WARM, WARM[::-1].copy()], ids=["rising", "falling"])
def test_a_capital_t_beside_a_time_is_a_signal(tmp_path, kind, name, values):
    run = read(saved(tmp_path, kind, {"T": values, "wave": WAVE, name: TIME}))
    assert set(run.names) == {"T", "wave"}
    np.testing.assert_array_equal(run["T"], values)
    np.testing.assert_allclose(run.time, TIME)
    assert run.notes == ()


@pytest.mark.parametrize("kind", KINDS)
def test_a_capital_t_alone_is_the_time_where_it_increases(tmp_path, kind):
    run = read(saved(tmp_path, kind, {"wave": WAVE, "T": TIME}))
    np.testing.assert_allclose(run.time, TIME)
    assert run.notes == (
        "'T' is taken for the time, in s: it increases, and nothing else is called a time",
    )
    path = saved(tmp_path, kind, {"wave": WAVE, "T": 80 + np.cos(TIME)})
    assert "no time" in sentence(path)
    assert set(read(path, 0.25).names) == {"wave", "T"}


@pytest.mark.parametrize("kind", KINDS)
def test_a_capital_t_is_no_time_beside_another_rate(tmp_path, kind):
    path = saved(tmp_path, kind, {"wave": WAVE, "T": WARM})
    run = read(path, 0.25)
    assert set(run.names) == {"wave", "T"}
    np.testing.assert_allclose(run.time, TIME)
    run = read(saved(tmp_path, kind, {"wave": WAVE, "T": TIME + 20}), 0.25)
    assert run.names == ("wave",)
    np.testing.assert_allclose(run.time, TIME + 20)


def test_the_same_time_twice_is_one(tmp_path):
    run = read(saved(tmp_path, "csv", {"t": TIME, "x": WAVE, "T": TIME}))
    assert run.names == ("x",)
    assert run.notes == ("column 3 left out: the time once more",)


@pytest.mark.parametrize(("header", "names"), [("T [kN],t", ("T",)), ("T [s],Time (s)", ("T",))])
def test_the_unit_of_a_capital_t_counts(tmp_path, header, names):
    rows = [f"{w},{t}" for w, t in zip(WARM, TIME, strict=True)]
    run = read(put(tmp_path / "a.csv", [header, *rows]))
    assert run.names == names
    np.testing.assert_allclose(run.time, TIME)
    assert "no time column" in sentence(put(tmp_path / "b.csv", ["T [degC],x", *rows]))
    minutes = read(put(tmp_path / "c.csv", ["T [min],x", *rows]))
    np.testing.assert_allclose(minutes.time, 60 * WARM, rtol=1e-12)
    assert "'T' is in min: times are converted to s" in minutes.notes
    assert read(put(tmp_path / "d.csv", ["T [s],x", *rows])).notes == ()


def test_the_time_of_a_mat_file_is_as_long_as_its_signals(tmp_path):
    periods = np.linspace(4.0, 20, 9)
    table = {"T": periods, "rao": np.exp(-periods), "sim": {"time": TIME, "heave": WAVE}}
    run = read(saved(tmp_path, "mat", table))
    assert run.names == ("sim.heave",)
    results = {"results": {"T": periods[:3], "time": TIME, "heave": WAVE}}
    assert read(saved(tmp_path, "mat", results)).names == ("heave",)
    table = {"t": periods, "gain": periods**2, "time": TIME, "x": WAVE, "y": WAVE**2}
    assert read(saved(tmp_path, "mat", table)).names == ("x", "y")


def test_other_names_of_a_time_beside_one_are_signals(tmp_path):
    for elapsed in (TIME, TIME + 3):
        run = read(saved(tmp_path, "mat", {"elapsed": elapsed, "time": TIME, "x": WAVE}))
        assert run.names == ("elapsed", "x")
    table = {"time": 12.5, "t": TIME[:7], "fs": 4.0, "x": WAVE}
    run = read(saved(tmp_path, "mat", table))
    assert run.names == ("x",)
    assert sum("no real vector of 60 values" in note for note in run.notes) == 2


# -- what numbers count -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("count", "per"), [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)]
)
def test_times_since_1970_in_every_format(tmp_path, kind, count, per):
    counted = np.rint((1.66e9 + TIME) * per).astype(np.int64)
    run = read(saved(tmp_path, kind, {"time": counted, "wave": WAVE}))
    np.testing.assert_allclose(run.time, TIME, atol=1e-9)
    assert run.notes == (f"'time' counts {count} since 1970: times are seconds since the first",)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["Timestamp", "unixtime"])
def test_seconds_since_1970_by_the_name(tmp_path, kind, name):
    run = read(saved(tmp_path, kind, {"T": WARM, name: 1.66e9 + TIME, "wave": WAVE}))
    np.testing.assert_allclose(run.time, TIME, atol=1e-9)
    assert set(run.names) == {"T", "wave"}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("step", [0.01, 0.0125, 0.05, 1.0, 10.0, 60.0, 600.0, 3600.0])
@pytest.mark.parametrize(
    ("first", "whose"), [(44927.5, "spreadsheets do"), (739000, "MATLAB does")]
)
def test_numbers_of_days_are_told(tmp_path, kind, step, first, whose):
    days = first + step * np.arange(COUNT) / 86400
    run = read(saved(tmp_path, kind, {"Time": days, "wave": WAVE}))
    np.testing.assert_allclose(run.time, step * np.arange(COUNT), atol=2e-5, rtol=1e-9)
    assert run.time_step is not None
    assert run.notes == (f"'Time' numbers days as {whose}: times are seconds since the first",)


@pytest.mark.parametrize("digits", [5, 6, 9])
def test_numbers_of_days_in_few_digits(tmp_path, digits):
    rows = [f"{45100 + t / 86400:.{digits}f};{i}" for i, t in enumerate(range(0, 600, 2))]
    run = read(put(tmp_path / "a.csv", ["Zeit;x", *(row.replace(".", ",") for row in rows)]))
    np.testing.assert_array_equal(run.time, np.arange(0.0, 600, 2))
    assert "numbers days" in run.notes[0]
    kept = [row for i, row in enumerate(rows) if i not in (70, 71, 200)]
    run = read(put(tmp_path / "b.csv", ["Date;x", *kept]))
    np.testing.assert_allclose(np.diff(run.time)[[0, 69]], [2, 6], atol=0.9 * 10.0 ** (5 - digits))


@pytest.mark.parametrize("step", [0.0125, 0.05, 1 / 30, 0.1, 1.0, 2e-5])
def test_seconds_of_that_size_stay_seconds(tmp_path, step):
    times = 45000 + step * np.arange(COUNT)
    run = read(saved(tmp_path, "mat", {"t": times, "x": WAVE}))
    np.testing.assert_array_equal(run.time[[0, -1]], times[[0, -1]])
    # Whole hours are whole steps as well.
    told = any("read as s; if it numbers days" in note for note in run.notes)
    assert told == (step in (1.0, 1 / 30))


def test_stated_units_are_believed(tmp_path):
    rows = [f"{44927.5 + t / 86400!r},{i}" for i, t in enumerate(TIME.tolist())]
    assert read(put(tmp_path / "a.csv", ["Time [s],x", *rows])).time[0] == 44927.5
    run = read(put(tmp_path / "b.csv", ["Time [days],x", *rows]))
    np.testing.assert_array_equal(run.time, TIME)
    rows = [f"{t / 86400!r},{i}" for i, t in enumerate((TIME + 50).tolist())]
    run = read(put(tmp_path / "c.csv", ["Time [days],x", *rows]))
    np.testing.assert_allclose(run.time, TIME + 50, rtol=1e-12)


@pytest.mark.parametrize("unit", ["UTC", "local", "CET"])
def test_a_zone_behind_the_name_of_dates_is_no_unit(tmp_path, unit):
    rows = [f"{1.7e9 + t!r},{i}" for i, t in enumerate(TIME.tolist())]
    run = read(put(tmp_path / "a.csv", [f"Timestamp [{unit}],x", *rows]))
    np.testing.assert_array_equal(run.time, TIME)
    assert any("counts seconds since 1970" in note for note in run.notes)


@pytest.mark.parametrize(("unit", "per"), [("s", 1.0), ("ms", 1e3), ("us", 1e6)])
def test_stamps_with_a_unit_count_from_1970_as_well(tmp_path, unit, per):
    rows = [f"{round((1.7e9 + t) * per)},{i}" for i, t in enumerate(range(60))]
    run = read(put(tmp_path / "a.csv", [f"Timestamp [{unit}],x", *rows]))
    np.testing.assert_array_equal(run.time, np.arange(60.0))
    assert any(f"counts {unit} since 1970" in note for note in run.notes)


# -- dates, stamps, durations -------------------------------------------------------------------

HOURS = [0, 1, 23, 24, 25, 96, 97]


def dated(day: str, clock: str) -> list[str]:
    start = pd.Timestamp("2023-02-27 00:00:00")
    stamps = [start + pd.Timedelta(hours=h) for h in HOURS]
    return [f"{s.strftime(day)};{s.strftime(clock)};{i}" for i, s in enumerate(stamps)]


@pytest.mark.parametrize("names", ["Date;Time", "Datum;Uhrzeit", "DATE;clock", "Date;of day"])
@pytest.mark.parametrize(
    ("day", "clock"),
    [
        ("%Y-%m-%d", "%H:%M:%S"),
        ("%d.%m.%Y", "%H:%M"),
        ("%d.%m.%y", "%H:%M:%S"),
        ("%Y/%m/%d", "%H:%M:%S.%f"),
        ("%m/%d/%Y", "%I:%M:%S %p"),
        ("%Y%m%d", "%H:%M:%S"),
    ],
)
def test_dates_and_times_of_day_are_joined(tmp_path, names, day, clock):
    run = read(put(tmp_path / "a.csv", [f"{names};x", *dated(day, clock)]))
    np.testing.assert_array_equal(run.time, 3600.0 * np.array(HOURS))
    assert run.names == ("x",)
    first, second = names.split(";")
    assert run.notes[0].startswith(f"'{first}' and '{second}' hold time stamps: times are seconds")


def test_dates_and_times_of_day_as_spreadsheets_number_them(tmp_path):
    days = [44984 + h / 24 for h in HOURS]
    rows = [f"{int(d)},{d % 1!r},{i}" for i, d in enumerate(days)]
    run = read(put(tmp_path / "a.csv", ["Date,Time,x", *rows]))
    np.testing.assert_allclose(run.time, 3600.0 * np.array(HOURS), atol=1e-5)
    assert run.names == ("x",)
    rows = [f"{int(d)},{round(24 * (d % 1)):02}:00:00,{i}" for i, d in enumerate(days)]
    run = read(put(tmp_path / "a.csv", ["Date,Time,x", *rows]))
    np.testing.assert_array_equal(run.time, 3600.0 * np.array(HOURS))


def test_dates_that_tell_nothing_and_dates_of_no_known_form(tmp_path):
    rows = [f"2023-02-27,23:59:{50 + i},{i}" for i in range(10)]
    rows += [f"2023-02-27,00:00:0{i},{i}" for i in range(5)]
    run = read(put(tmp_path / "a.csv", ["Date,Clock,x", *rows]))
    np.testing.assert_array_equal(run.time, np.arange(15.0))
    rows = [row.replace("2023-02-27", str(i)) for i, row in enumerate(dated("%j", "%H:%M:%S"))]
    text = ["Date;Time;x", *(f"day {row}" for row in rows)]
    assert "is no date of a form that is known" in sentence(put(tmp_path / "b.csv", text))
    rows = [f"2023-02-27,{t},{i}" for i, t in enumerate(TIME)]
    run = read(put(tmp_path / "c.csv", ["Date,Time,x", *rows]))
    np.testing.assert_array_equal(run.time, TIME)
    assert run.names == ("x",)


@pytest.mark.parametrize(
    "written",
    [
        lambda t: f"{t} sec",
        lambda t: f"{t / 60:.12f} min",
        lambda t: f"{t}s",
        lambda t: str(pd.Timedelta(seconds=t)),
        lambda t: f"0 days 00:00:{t:05.2f}",
    ],
)
@pytest.mark.parametrize("name", ["Time", "t", ""])
def test_durations_are_times_in_seconds(tmp_path, written, name):
    rows = [f"{written(t + 2)},{x}" for t, x in zip(TIME.tolist(), WAVE, strict=True)]
    run = read(put(tmp_path / "a.csv", [f"{name},x", *rows]))
    np.testing.assert_allclose(run.time, TIME + 2, atol=1e-9)
    assert "durations" in run.notes[0]
    broken = [*rows[:3], "soon,1", *rows[4:]]
    assert "'soon'" in sentence(put(tmp_path / "b.csv", [f"{name},x", *broken]))


def test_durations_in_parquet_keep_their_start(tmp_path):
    times = pd.to_timedelta(TIME + 2, unit="s")
    run = read(saved(tmp_path, "parquet", {"time": times, "x": WAVE}))
    np.testing.assert_allclose(run.time, TIME + 2)


def test_an_index_of_dates_without_a_name(tmp_path):
    index = pd.date_range("2023-02-27", periods=COUNT, freq="250ms")
    path = tmp_path / "a.csv"
    pd.DataFrame({"x": WAVE}, index=index).to_csv(path)
    run = read(path)
    np.testing.assert_allclose(run.time, TIME)
    assert run.notes[0].startswith("a column without a name holds time stamps")


# -- rates and units ----------------------------------------------------------------------------


@pytest.mark.parametrize("comments", [["# Hs = 2, Ts = 9", "# fs = 4"], ["# fs = 4 Hz, Ts = 9 s"]])
def test_a_rate_counts_where_a_period_is_told_as_well(tmp_path, comments):
    rows = [f"{x}" for x in WAVE]
    run = read(put(tmp_path / "a.csv", [*comments, "x", *rows]))
    np.testing.assert_allclose(run.time, TIME)
    assert "'Ts' beside 'fs' tells no interval between samples" in run.notes


def test_intervals_that_contradict_each_other_are_refused(tmp_path):
    text = ["# Ts = 9, dt = 0.25", "x,y", *(f"{x},1" for x in WAVE)]
    path = put(tmp_path / "a.csv", text)
    assert "every 9 s by 'Ts' and every 0.25 s by 'dt'" in sentence(path)
    np.testing.assert_allclose(read(path, 0.25).time, TIME)
    table = {"fs": 4.0, "Ts": 9.0, "x": WAVE}
    run = read(saved(tmp_path, "mat", table))
    np.testing.assert_allclose(run.time, TIME)
    assert "every 9 s" in sentence(saved(tmp_path, "mat", {"Ts": 9.0, "dt": 0.25, "x": WAVE}))
    same = ["# dt = 0.033, fs = 30", "x,y", *(f"{x},1" for x in WAVE)]
    assert read(put(tmp_path / "c.csv", same)).time[1] == pytest.approx(0.033)


@pytest.mark.parametrize(
    ("unit", "size"), [("(min)", 60.0), ("(ms)", 1e-3), ("[h]", 3600.0), ("hr", 3600.0)]
)
def test_openfast_s_text_with_a_time_in_another_unit_is_converted(tmp_path, unit, size):
    rows = [f"{t:9.3f}\t{x:9.4f}" for t, x in zip(TIME, WAVE, strict=True)]
    bare = unit.strip("()[]")
    for header in ([f"Time\tWave1Elev\n{unit}\t(m)"], [f"Time [{bare}]\tWave1Elev [m]"]):
        run = read(put(tmp_path / "a.out", ["a title", *header, *rows]))
        np.testing.assert_allclose(run.time, size * TIME, rtol=1e-9)
        assert any(f"'Time' is in {bare}: times are converted to s" in n for n in run.notes)
    path = put(tmp_path / "b.out", ["a title", "Time\tWave1Elev\n(m)\t(m)", *rows])
    assert "its time 'Time' is in 'm', expected s: convert it" in sentence(path)


@pytest.mark.parametrize("kind", KINDS)
def test_a_time_in_another_unit_is_converted_in_every_format(tmp_path, kind):
    run = read(
        saved(tmp_path, kind, {"Time (ms)" if kind != "mat" else "time": 1e3 * TIME, "x": WAVE})
    )
    size = 1.0 if kind != "mat" else 1e3  # its names hold no units
    np.testing.assert_allclose(run.time, size * TIME, rtol=1e-12)


def test_openfast_s_text_without_units_may_count_days_as_well(tmp_path):
    rows = [f"{44927.5 + t / 86400:.9f} {x:9.4f}" for t, x in zip(TIME, WAVE, strict=True)]
    run = read(put(tmp_path / "a.out", ["Time Wave1Elev", *rows]))
    np.testing.assert_array_equal(run.time, TIME)
    assert "numbers days as spreadsheets do" in run.notes[0]


def test_times_of_day_beside_dates_that_change_are_refused_in_parquet(tmp_path):
    days = [dt.date(2024, 3, 1), dt.date(2024, 3, 1), dt.date(2024, 3, 5), dt.date(2024, 3, 5)]
    columns = {"Date": days, "Time": [dt.time(h) for h in (1, 2, 3, 4)], "A": [1.0, 2.0, 1.0, 3.0]}
    with pytest.raises(DfsmError, match=r"'Time' holds times of day and 'Date' the dates: join"):
        read(saved(tmp_path, "parquet", columns))
    run = read(saved(tmp_path, "parquet", columns | {"Date": days[:1] * 4}))
    np.testing.assert_array_equal(run.time, 3600.0 * np.arange(4))

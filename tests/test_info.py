"""What `describe` tells about a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.outb import outb_bytes
from dfsm.data import readers
from dfsm.data.info import describe
from dfsm.data.readers import describe_all, openfast, parquet, read, write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind import wind_warning
from dfsm.errors import DfsmError

EXAMPLES = Path(__file__).parents[1] / "examples" / "iea15"


def test_a_bundled_run():
    run = read(EXAMPLES / "iea15_2dof_06mps_s09.outb")
    info = describe(run)
    assert info.samples == 14001
    assert (info.start, info.stop) == (0, 700)
    assert info.interval is not None
    assert abs(info.interval - 0.05) < 1e-12
    pitch = next(c for c in info.channels if c.name == "PtfmPitch")
    assert pitch.unit == "deg"
    assert pitch.step == run.channel("PtfmPitch").step
    assert pitch.min == run["PtfmPitch"].min()
    assert pitch.max == run["PtfmPitch"].max()
    np.testing.assert_allclose(pitch.mean, np.sum(run["PtfmPitch"]) / 14001)
    np.testing.assert_allclose(pitch.std, np.sqrt(np.var(run["PtfmPitch"])))
    transient, relative, same, azimuth = info.warnings
    assert transient.startswith("a transient, until 6.1 s in 'PtfmRVyt', is far from all")
    assert relative == wind_warning("RtVAvgxh")
    # with pitch as the only motion the nacelle turns as the platform does
    assert same == "'NcIMURAys' holds the same data as 'PtfmRAyt'"
    assert azimuth.startswith("'LSSTipPxa' wraps at 360 deg, 59 times, first at ")


def test_constant_nan_duplicate_and_invalid_channels_are_told():
    t = np.array([0.0, 1.0, 2.5, 3.0])
    nan = np.array([1, np.nan, 3, np.inf])
    columns = [t**2, np.full(4, 7.0), nan, t**2, np.full(4, 7.0), np.full(4, np.nan), nan]
    run = Trajectory(
        t,
        np.stack(columns, axis=1),
        tuple(Channel(n) for n in ("a", "still", "gap", "twin", "still2", "none", "gap2")),
        notes=("1 channel marked Invalid left out",),
    )
    info = describe(run)
    assert info.warnings == (
        "'still' is constant (7)",
        "'gap' has 2 NaN or infinite samples, the first at 1 s",
        "'twin' holds the same data as 'a'",
        "'still2' is constant (7)",
        "'none' has 4 NaN or infinite samples, the first at 0 s",
        "'gap2' has 2 NaN or infinite samples, the first at 1 s",
        "'gap2' holds the same data as 'gap'",
        "1 channel marked Invalid left out",
    )
    assert info.interval is None
    assert (info.min_interval, info.max_interval) == (0.5, 1.5)
    gap = info.channels[2]
    assert (gap.min, gap.max, gap.mean, gap.std) == (1, 3, 2, 1)


def test_a_gap_is_told():
    t = np.append(np.arange(0, 10, 0.1), np.arange(14, 20, 0.1))
    (text,) = describe(Trajectory(t, np.sin(t)[:, None], (Channel("a"),))).warnings
    assert text.startswith("there is a gap of 4.1 s after 9.9 s, which a fit bridges with a spline")
    adaptive = np.cumsum(np.geomspace(0.01, 0.15, 100))
    run = Trajectory(adaptive, np.sin(adaptive)[:, None], (Channel("a"),))
    assert describe(run).warnings == ()


def test_to_dict_is_strict_json():
    t = np.array([0.0, 1.0, 2.5])
    run = Trajectory(t, np.array([[np.nan, 1]] * 3), (Channel("none"), Channel("one", "m", 0.5)))
    plain = describe(run).to_dict()
    again = json.loads(json.dumps(plain, allow_nan=False))
    assert again == plain
    assert again["interval"] == "irregular"
    assert again["channels"][0]["mean"] is None
    assert again["channels"][1]["step"] == 0.5
    run = Trajectory(np.arange(3.0), np.ones((3, 1)), (Channel("a"),))
    assert describe(run).to_dict()["interval"] == 1


def test_a_long_run_is_described_part_by_part(monkeypatch):
    rng = np.random.default_rng(0)
    values = 1e4 + rng.normal(size=(1000, 4))
    values[:, 1] = np.nan
    values[[3, 500], 2] = np.nan, np.inf
    values[:, 3] = values[:, 0]
    channels = tuple(Channel(n, "m") for n in "abcd")
    run = Trajectory(0.1 * np.arange(1000), values, channels)
    at_once = describe(run)
    monkeypatch.setattr("dfsm.data.info._BLOCK", 64)
    in_parts = describe(run)
    assert in_parts.warnings == at_once.warnings
    assert "'d' holds the same data as 'a'" in at_once.warnings
    for one, other in zip(at_once.channels, in_parts.channels, strict=True):
        figures = [(c.min, c.max, c.mean, c.std) for c in (one, other)]
        np.testing.assert_allclose(*figures, rtol=1e-12, equal_nan=True)


def test_a_sample_far_beyond_all_others_is_told():
    values = np.sin(np.arange(100.0))
    values[70] = 1e160
    run = Trajectory(np.arange(100.0), values[:, None], (Channel("x"),))
    (warning,) = describe(run).warnings
    assert warning.startswith("'x' is 1e+160 at 70 s, far beyond")


def test_long_files_are_described_channel_by_channel_as_whole_ones(tmp_path, monkeypatch):
    rng = np.random.default_rng(1)
    time = np.arange(400) * 0.05
    values = np.cumsum(rng.normal(size=(400, 3)), axis=0) + np.sin(time)[:, None]
    values[0, 1] += 100
    channels = tuple(Channel(*c) for c in zip("abc", ("m", "deg", "kN"), strict=True))
    run = Trajectory(time, values, channels, name="long", wall_time=3.0, notes=("told",))
    write_table(run, tmp_path / "a.parquet")
    run.to_pandas().reset_index().to_parquet(tmp_path / "b.parquet", row_group_size=150)
    with_nan = values.copy()
    with_nan[7, 2] = np.nan
    write_table(replace(run, values=with_nan), tmp_path / "c.parquet")
    for n in (1, 2, 3, 4):
        content = outb_bytes(time, values, ["a", "b", "c"], ["m", "deg", "kN"], format_id=n)
        (tmp_path / f"{n}.outb").write_bytes(content + b"left")
    # The same row again and again at the end was not recorded: that is for the reader of all.
    frozen = np.concatenate([values[:380], np.zeros((20, 3))])
    write_table(replace(run, values=frozen), tmp_path / "frozen.parquet")
    expected = [json.dumps(i.to_dict()) for i in describe_all([tmp_path / "*.*"])]
    monkeypatch.setattr(parquet, "LONG", 0)
    monkeypatch.setattr(openfast, "LONG", 0)
    whole, read_whole = [], readers.read
    monkeypatch.setattr(readers, "read", lambda *a: whole.append(a[0].name) or read_whole(*a))
    found = [json.dumps(i.to_dict()) for i in describe_all([tmp_path / "*.*"])]
    assert found == expected
    assert whole == ["frozen.parquet"]
    packed = EXAMPLES / "iea15_2dof_06mps_s01.parquet"
    assert describe_all([packed]) == [describe(read_whole(packed))]
    assert whole == ["frozen.parquet"]


def test_a_long_file_with_a_damaged_page_costs_a_sentence(tmp_path, monkeypatch):
    values = np.random.default_rng(2).normal(size=(400, 1))
    path = tmp_path / "a.parquet"
    write_table(Trajectory(np.arange(400.0), values, (Channel("x"),)), path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    monkeypatch.setattr(parquet, "LONG", 0)
    with pytest.raises(DfsmError, match="no readable Parquet file"):
        describe_all([path])

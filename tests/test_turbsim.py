"""TurbSim fields against planes that are known, and against the run that a real field drove."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from conftest import Dfsm
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.data.readers.turbsim import read_turbsim
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind_field import disk_wind, field_signals, with_field_wind
from dfsm.errors import DfsmError, DfsmWarning

RADIUS, HUB, DY, NY, NZ, COUNT, DT = 50.0, 90.0, 10.0, 13, 14, 40, 0.5
REAL = Path(__file__).parents[1] / "examples" / "iea15" / "iea15_2dof_12mps_s08"


PLACES = {"dz": 0, "dy": 1, "dt": 2, "mean": 3, "hub": 4, "bottom": 5, "slope": 6, "offset": 7}


def planes() -> np.ndarray:
    """Average and slopes over time, shape (time, 3)."""
    t = DT * np.arange(COUNT)
    return np.stack([10 + np.sin(t), 0.5 * np.cos(2 * t), 0.3 * np.sin(3 * t)], axis=1)


def field_file(path: Path, kind: int = 7, towers: int = 2, **changes) -> Path:
    """Write planes (and other components that must not matter) as a TurbSim field.

    `changes` are of the header alone: its sizes, or numbers by their place among the single ones.
    """
    floats = [DY, DY, DT, 10.0, HUB, 25.0, 3000.0, -30000.0]
    for name, place in PLACES.items():
        floats[place] = changes.pop(name, floats[place])
    y, z = (np.arange(NY) - (NY - 1) / 2) * DY, 25 + DY * np.arange(NZ)
    up, side = np.meshgrid((z - HUB) / RADIUS, y / RADIUS, indexing="ij")
    a, b, c = planes().T[:, :, None, None]
    rng = np.random.default_rng(0)
    wind = rng.normal(size=(COUNT, NZ, NY, 3))
    wind[..., 0] = a + b * up + c * side
    slope, offset = 3000.0, -30000.0
    codes = np.concatenate(
        [wind.reshape(COUNT, -1), rng.normal(size=(COUNT, 3 * towers))], axis=1
    ) * np.tile([slope, 100.0, 100.0], NZ * NY + towers)
    codes += np.tile([offset, 0.0, 0.0], NZ * NY + towers)
    text = b"made by a test"
    header = {"kind": kind, "nz": NZ, "ny": NY, "towers": towers, "count": COUNT} | changes
    head = struct.pack("<h4i", *header.values())
    head += struct.pack("<8f", *floats)
    head += struct.pack("<4fi", 100.0, 0.0, 100.0, 0.0, len(text)) + text
    path.write_bytes(head + codes.round().astype("<i2").tobytes())
    return path


def run_until(stop: float, start: float = 0.0) -> Trajectory:
    time = np.arange(start, stop, 0.25)
    return Trajectory(time, np.sin(time)[:, None], (Channel("q", "m"),), name="run")


def test_planes_are_found(tmp_path):
    field = read_turbsim(field_file(tmp_path / "f.bts"))
    assert (field.step, field.count, field.mean_wind) == (DT, COUNT, 10.0)
    assert (field.hub_height, field.periodic, field.towers) == (HUB, False, 2)
    assert field.delay == pytest.approx(NY // 2 * DY / 10)
    # The codes round u to 1/3000 m/s.
    np.testing.assert_allclose(disk_wind(field, RADIUS), planes(), atol=2e-4)


def test_a_real_field_gives_the_wind_of_the_run_that_it_drove():
    run = read(REAL.with_suffix(".parquet")).window(0.0, 11.0)
    names = ["RotWind", "RotShearV", "RotShearH"]
    bare = run.select(n for n in run.names if n not in names)
    found = with_field_wind(bare, read_turbsim(REAL.with_suffix(".bts")), 120.0)
    for name in names:
        assert np.abs(found[name] - run[name]).max() < 3e-4, name  # steps of about 1e-4 m/s
        assert found.channel(name).unit == run.channel(name).unit
    np.testing.assert_array_equal(found.values[:, :-3], bare.values)


@pytest.mark.parametrize(("kind", "ahead"), [(7, 6.0), (8, 0.0)])
def test_the_field_is_ahead_by_half_its_width_unless_it_repeats_itself(tmp_path, kind, ahead):
    field = read_turbsim(field_file(tmp_path / "f.bts", kind))
    run = with_field_wind(run_until(13.0), field, RADIUS)
    mesh = DT * np.arange(COUNT) - ahead
    np.testing.assert_allclose(
        run["RotShearV"], np.interp(run.time, mesh, planes()[:, 1]), atol=2e-4
    )


def test_a_periodic_field_repeats_itself_and_another_ends(tmp_path):
    run = run_until(45.0)
    found = with_field_wind(run, read_turbsim(field_file(tmp_path / "p.bts", 8)), RADIUS)
    np.testing.assert_allclose(found["RotWind"][:60], found["RotWind"][80:140], atol=1e-9)
    with pytest.raises(DfsmError, match=r"covers 0 to 44\.75 s, but .*f\.bts only -6 to 13\.5 s"):
        with_field_wind(run, read_turbsim(field_file(tmp_path / "f.bts")), RADIUS)


def test_channels_are_not_added_twice(tmp_path):
    field = read_turbsim(field_file(tmp_path / "f.bts"))
    run = with_field_wind(run_until(5.0), field, RADIUS)
    with pytest.raises(DfsmError, match="channel 'RotWind' exists already: nothing was added"):
        with_field_wind(run, field, RADIUS)


@pytest.mark.parametrize(
    ("radius", "said"),
    [
        (-1.0, "the rotor radius is -1"),
        (np.nan, "the rotor radius is nan"),
        (70.0, "a rotor of radius 70 m reaches beyond the field, which covers 60 m"),
        (12.0, "only 6 grid points lie on a rotor of radius 12 m, at least 9"),
    ],
)
def test_a_radius_that_does_not_fit(tmp_path, radius, said):
    # The hub is half a step off the grid's rows: the smallest disks hold few points.
    field = read_turbsim(field_file(tmp_path / "f.bts"))
    with pytest.raises(DfsmError, match=said):
        disk_wind(field, radius)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": 3}, "is no TurbSim full-field file"),
        ({"nz": 0}, "the header of the wind field makes no sense"),
        ({"count": COUNT + 1}, r"its header announces \d+: the file is cut off"),
    ],
)
def test_damaged_fields(tmp_path, change, said):
    with pytest.raises(DfsmError, match=said):
        read_turbsim(field_file(tmp_path / "f.bts", **change))


def test_a_file_too_short_for_a_header(tmp_path):
    (tmp_path / "f.bts").write_bytes(b"\x07\x00")
    with pytest.raises(DfsmError, match="is no TurbSim full-field file"):
        read_turbsim(tmp_path / "f.bts")


def test_the_command_adds_the_wind_to_runs(tmp_path, dfsm: Dfsm):
    field = field_file(tmp_path / "f.bts")
    write_table(run_until(5.0), tmp_path / "run.csv")
    arguments = (field, tmp_path / "run.csv", "--radius", RADIUS, "-o", tmp_path / "new")
    result = dfsm("wind", *arguments, "--harmonics", 0)
    assert result.code == 0
    found = read(tmp_path / "new" / "run.parquet")
    assert found.names == ("q", "RotWind", "RotShearV", "RotShearH")
    expected = with_field_wind(run_until(5.0), read_turbsim(field), RADIUS)
    np.testing.assert_allclose(found.values, expected.values, atol=1e-12)


def test_the_command_does_not_overwrite_what_it_reads(tmp_path, dfsm: Dfsm):
    field = field_file(tmp_path / "f.bts")
    write_table(run_until(5.0), tmp_path / "run.parquet")
    before = (tmp_path / "run.parquet").read_bytes()
    result = dfsm("wind", field, tmp_path / "run.parquet", "--radius", RADIUS, "-o", tmp_path)
    assert result.code == 2
    assert "is one of the files to read" in result.err
    assert (tmp_path / "run.parquet").read_bytes() == before


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mean": np.nan}, r"gives the mean wind \(UHub\) in m/s as nan"),
        ({"mean": 1e9}, r"gives the mean wind \(UHub\) in m/s as 1e\+09"),
        ({"dt": np.inf}, r"gives the time step \(dt\) in s as inf"),
        ({"dt": -0.5}, r"gives the time step \(dt\) in s as -0\.5"),
        ({"dz": 0.0}, r"gives the grid spacing upwards \(dz\) in m as 0"),
        ({"hub": np.nan}, r"gives the hub height \(HubHt\) in m as nan"),
        ({"bottom": -np.inf}, r"gives the height of the lowest points \(ZBot\) in m as -inf"),
        ({"slope": -3000.0}, "gives the slope of u as -3000"),
        ({"slope": np.nan}, "gives the slope of u as nan"),
        ({"offset": np.nan}, "gives the offset of u as nan"),
        (
            {"slope": 1e-38},
            "slope and offset of u in its header, 1e-38 and -30000, make winds from",
        ),
    ],
)
def test_header_fields_that_make_no_sense_are_named(tmp_path, change, said):
    with pytest.raises(DfsmError, match=said):
        read_turbsim(field_file(tmp_path / "f.bts", **change))


def test_the_mean_over_the_disk_is_that_of_the_header(tmp_path):
    with pytest.raises(DfsmError, match=r"10\.0\d m/s on average, the field states 14 m/s"):
        field_signals(read_turbsim(field_file(tmp_path / "a.bts", mean=14.0)), RADIUS)
    with pytest.warns(DfsmWarning, match=r"10\.0\d* m/s on average, the field states 11 m/s"):
        signals = field_signals(read_turbsim(field_file(tmp_path / "b.bts", mean=11.0)), RADIUS)
    np.testing.assert_allclose(signals["RotWind"], planes()[:, 0], atol=2e-4)


def test_the_hub_is_where_it_is_told(tmp_path, dfsm: Dfsm):
    field = field_file(tmp_path / "f.bts")
    write_table(run_until(5.0), tmp_path / "run.csv")
    command = ("wind", field, tmp_path / "run.csv", "--radius", 40, "--harmonics", 0)
    stated = dfsm(*command, "-o", tmp_path / "a")
    assert "hub at 90 m, as the field states" in stated.out
    told = dfsm(*command, "-o", tmp_path / "b", "--hub-height", 80)
    assert "hub at 80 m, as told" in told.out
    a, b = (read(tmp_path / n / "run.parquet") for n in "ab")
    lower = a["RotWind"] - 10 / 40 * a["RotShearV"]
    np.testing.assert_allclose(b["RotWind"], lower, atol=2e-4)
    wrong = dfsm(*command, "-o", tmp_path / "c", "--hub-height", 400)
    assert "a hub at 400 m is not within the field, which covers heights of 25" in wrong.sentence

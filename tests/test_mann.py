"""Mann boxes written in the documented order: where and when each point meets the rotor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import Dfsm
from dfsm.data.readers import read
from dfsm.data.readers.mann import BoxSettings, read_mann
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind_field import field_signals, with_field_wind
from dfsm.errors import DfsmError

NX, NY, NZ, DX, DY, DZ = 40, 13, 15, 4.0, 9.0, 10.0
HUB, MEAN, RADIUS = 90.0, 8.0, 50.0
STEP = DX / MEAN
TOLD: dict[str, Any] = {
    "points": (NX, NY, NZ),
    "spacing": (DX, DY, DZ),
    "mean_wind": MEAN,
    "hub_height": HUB,
}


def turbulence(t: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """At time t at the rotor, y to the left as one looks downwind, z above the hub."""
    return np.sin(2 * np.pi * t / (NX * STEP)) + 0.01 * y - 0.005 * z + 1e-4 * y * z


def box_file(path: Path, *, last_first: bool = False) -> Path:
    """Number by number, as the format goes: planes, then rows from left to right, then upwards."""
    numbers = []
    for plane in range(NX):
        t = STEP * ((NX - 1 - plane) if last_first else plane)
        for row in range(NY):
            for point in range(NZ):
                y = ((NY - 1) / 2 - row) * DY
                numbers.append(turbulence(np.array(t), np.array(y), (point - (NZ - 1) / 2) * DZ))
    np.array(numbers, dtype="<f4").tofile(path)
    return path


def run_until(stop: float) -> Trajectory:
    time = np.arange(0.0, stop, STEP / 2)
    return Trajectory(time, np.sin(time)[:, None], (Channel("q", "m"),), name="run")


@pytest.mark.parametrize("last_first", [False, True])
def test_every_point_is_where_the_format_says(tmp_path, last_first):
    path = box_file(tmp_path / "u.bin", last_first=last_first)
    field = read_mann(path, BoxSettings(**TOLD, last_first=last_first))
    assert (field.step, field.count, field.delay, field.periodic) == (STEP, NX, 0.0, True)
    np.testing.assert_allclose(field.y[[0, -1]], [-54, 54])
    np.testing.assert_allclose(field.z[[0, -1]], [20, 160])
    u = np.concatenate(list(field.blocks()))
    t, z, y = np.meshgrid(STEP * np.arange(NX), field.z - HUB, field.y, indexing="ij")
    np.testing.assert_allclose(u, MEAN + turbulence(t, y, z), atol=1e-6)


def test_the_mean_wind_follows_a_power_law(tmp_path):
    path = box_file(tmp_path / "u.bin")
    flat = np.concatenate(list(read_mann(path, BoxSettings(**TOLD)).blocks()))
    field = read_mann(path, BoxSettings(**TOLD, shear=0.2))
    sheared = np.concatenate(list(field.blocks()))
    expected = MEAN * ((field.z / HUB) ** 0.2 - 1)
    np.testing.assert_allclose(sheared - flat, expected[None, :, None] + 0 * flat, atol=1e-12)


def test_below_the_ground_there_is_no_mean_wind(tmp_path):
    settings = BoxSettings(**TOLD | {"hub_height": 65.0}, shear=0.2)
    (u,) = read_mann(box_file(tmp_path / "u.bin"), settings).blocks()
    t, y = np.meshgrid(STEP * np.arange(NX), 9.0 * np.arange(-6, 7), indexing="ij")
    np.testing.assert_allclose(u[:, 0], turbulence(t, y, np.array(-70.0)), atol=1e-6)


def test_a_scaled_box_loses_its_own_mean(tmp_path):
    path = box_file(tmp_path / "u.bin")
    (u,) = read_mann(path, BoxSettings(**TOLD, scale=1.5)).blocks()
    t = STEP * np.arange(NX)
    expected = MEAN + 1.5 * np.sin(2 * np.pi * t / (NX * STEP))
    np.testing.assert_allclose(u, expected[:, None, None] + 0 * u, atol=1e-6)


def test_harmonics_and_time_of_a_box(tmp_path):
    field = read_mann(box_file(tmp_path / "u.bin"), BoxSettings(**TOLD))
    run = with_field_wind(run_until(2.5 * NX * STEP), field, RADIUS, 4, (20.0,))
    mean = np.sin(2 * np.pi * STEP * np.arange(NX + 1) / (NX * STEP))
    expected = MEAN + np.interp(run.time % (NX * STEP), STEP * np.arange(NX + 1), mean)
    for name in ("RotWind", "U_r020", "U_disk"):
        np.testing.assert_allclose(run[name], expected, atol=1e-6)
    for name, value in {"S1_r020": 0.2, "C1_r020": -0.1, "S2_r020": 0.02, "C2_r020": 0.0}.items():
        np.testing.assert_allclose(run[name], value, atol=1e-6)
    np.testing.assert_allclose(run["RotShearH"], 0.01 * RADIUS, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"points": (NX, NY, 1)}, r"box\.points is \(40, 13, 1\), expected at least two each way"),
        ({"spacing": (DX, 0.0, DZ)}, r"box\.spacing is .* expected positive numbers"),
        ({"spacing": (DX, DY, np.nan)}, r"box\.spacing is .* expected positive numbers"),
        ({"mean_wind": -1.0}, r"box\.mean_wind is -1\.0, expected positive"),
        ({"mean_wind": np.nan}, r"box\.mean_wind is nan"),
        ({"hub_height": 0.0}, r"box\.hub_height is 0\.0"),
        ({"scale": -2.0}, r"box\.scale is -2\.0"),
        ({"scale": 0.0}, r"box\.scale is 0\.0"),
        ({"shear": np.inf}, r"box\.shear is inf, expected an exponent"),
    ],
)
def test_settings_that_make_no_sense(change, said):
    with pytest.raises(DfsmError, match=said):
        BoxSettings(**TOLD | change)


def test_sizes_that_are_not_the_files(tmp_path):
    settings = BoxSettings(**TOLD | {"points": (NX, NY, NZ + 1)})
    said = r"31200 bytes, but a box of 40 x 13 x 16 points has 33280: give the numbers of points"
    with pytest.raises(DfsmError, match=said):
        read_mann(box_file(tmp_path / "u.bin"), settings)


@pytest.mark.parametrize("scale", [None, 1.0])
@pytest.mark.parametrize("wrong", [">f4", "nan"])
def test_numbers_that_are_no_turbulence(tmp_path, wrong, scale):
    numbers = np.fromfile(box_file(tmp_path / "u.bin"), "<f4")
    if wrong == "nan":
        numbers[7] = np.nan
    numbers.astype("<f4" if wrong == "nan" else wrong).tofile(tmp_path / "u.bin")
    field = read_mann(tmp_path / "u.bin", BoxSettings(**TOLD, scale=scale))
    with pytest.raises(DfsmError, match="which is no turbulence: expected little-endian numbers"):
        field_signals(field, RADIUS)


def test_a_rotor_beyond_the_box(tmp_path):
    field = read_mann(box_file(tmp_path / "u.bin"), BoxSettings(**TOLD))
    with pytest.raises(DfsmError, match="radius 60 m reaches beyond the field, which covers 54 m"):
        field_signals(field, 60.0)


def test_the_command_reads_a_box(tmp_path, dfsm: Dfsm):
    path = box_file(tmp_path / "u.bin", last_first=True)
    write_table(run_until(30.0), tmp_path / "run.csv")
    command = ("wind", path, tmp_path / "run.csv", "--radius", RADIUS, "-o", tmp_path / "new")
    box = ("--box", NX, NY, NZ, DX, DY, DZ)
    more = ("--mean-wind", MEAN, "--shear", 0.1, "--scale", 2, "--last-first")
    result = dfsm(*command, *box, *more, "--hub-height", HUB)
    assert result.code == 0, result
    settings = BoxSettings(**TOLD, shear=0.1, scale=2.0, last_first=True)
    expected = with_field_wind(run_until(30.0), read_mann(path, settings), RADIUS, 4)
    written = read(tmp_path / "new" / "run.parquet")
    assert written.names == expected.names
    np.testing.assert_allclose(written.values, expected.values, atol=1e-9)

    said = "a Mann box does not tell its hub-height: give it with --hub-height"
    assert said in dfsm(*command, *box, *more).sentence
    said = "a Mann box does not tell its mean-wind: give it with --mean-wind"
    assert said in dfsm(*command, *box, "--hub-height", HUB).sentence
    assert "with its sizes (--box) if it is a Mann box" in dfsm(*command).sentence

"""Harmonics of wind fields: against fields whose harmonics are known, and against a real run's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.interpolate import RegularGridInterpolator

from conftest import Dfsm
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.data.readers.turbsim import TurbSimField, read_turbsim
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.data.wind_field import (
    disk_wind,
    field_signals,
    harmonic_names,
    ring_radii,
    with_field_wind,
    with_harmonics,
)
from dfsm.errors import DfsmError
from test_turbsim import COUNT, DT, HUB, RADIUS, REAL, field_file, run_until

T = DT * np.arange(COUNT)
RINGS = (10.0, 22.5, 50.0)
Wind = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Formula(TurbSimField):
    """A field whose wind is a formula of time, height above the hub and y."""

    wind: Wind

    def blocks(self):
        t, z, y = np.meshgrid(T, self.z - HUB, self.y, indexing="ij")
        u = self.wind(t, z, y)
        yield from (u[:15], u[15:])


def formula(tmp_path: Path, wind: Wind) -> Formula:
    field = read_turbsim(field_file(tmp_path / "f.bts"))
    made = Formula(**vars(field))
    object.__setattr__(made, "wind", wind)
    return made


def test_harmonics_that_are_known(tmp_path):
    # Between grid points all four terms are exact, so their harmonics are too: a mean that moves,
    # slopes as the first harmonic, and y z = r² sin 2α / 2 as the second.
    def wind(t, z, y):
        return 10 + np.sin(t) + 0.02 * np.cos(t) * z + 0.01 * t * y + 1e-3 * np.cos(3 * t) * y * z

    signals = field_signals(formula(tmp_path, wind), RADIUS, 4, RINGS)
    for r in RINGS:
        known = {
            "U": 10 + np.sin(T),
            "C1": 0.02 * r * np.cos(T),
            "S1": 0.01 * r * T,
            "S2": 1e-3 * np.cos(3 * T) * r**2 / 2,
        }
        for part in ("U", *(f"{p}{n}" for n in range(1, 5) for p in "CS")):
            expected = known.get(part, np.zeros(COUNT))
            np.testing.assert_allclose(signals[f"{part}_r{r:03g}"], expected, atol=1e-11)
    np.testing.assert_allclose(signals["hub"], 10 + np.sin(T), atol=1e-11)


def test_harmonics_are_those_of_a_fourier_transform_over_a_ring(tmp_path):
    noise = np.random.default_rng(1).normal(10, 2, (COUNT, 14, 13))
    field = formula(tmp_path, lambda t, z, y: noise)
    signals = field_signals(field, RADIUS, 6, RINGS)
    angle = 2 * np.pi * np.arange(48) / 48
    for r in RINGS:
        grid = RegularGridInterpolator((field.z, field.y), noise.transpose(1, 2, 0))
        around = grid(np.stack([HUB + r * np.cos(angle), r * np.sin(angle)], axis=1))
        spectrum = np.fft.rfft(around, axis=0) / 48
        np.testing.assert_allclose(signals[f"U_r{r:03g}"], spectrum[0].real, rtol=1e-12)
        for n in range(1, 7):
            C, S = (signals[f"{p}{n}_r{r:03g}"] for p in "CS")
            np.testing.assert_allclose(C - 1j * S, 2 * spectrum[n], atol=1e-12)
    z, y = np.meshgrid(field.z - HUB, field.y, indexing="ij")
    disk = noise[:, np.hypot(y, z) <= RADIUS]
    np.testing.assert_allclose(signals["U_disk"], disk.mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(signals["U_cubic"] ** 3, (disk**3).mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(signals.values[:, :3], disk_wind(field, RADIUS), rtol=1e-12)


def test_harmonics_of_a_real_field():
    # Of the same field in full, computed by others: 48 points a ring, bilinear, in steps of 1 mm/s.
    known = {
        2.0: (12.333, 0.094, -1.375, 0.104, 0.799, 0.196, 0.025, 12.209, 12.560),
        5.0: (12.652, 0.483, -0.979, 0.055, 0.836, -0.145, -0.406, 12.245, 12.592),
        9.0: (12.930, 1.584, 0.245, 0.078, 0.660, -0.403, -0.101, 12.419, 12.720),
    }
    names = ["U_r015", "C1_r036", "S1_r036", "C2_r078", "S3_r099", "S4_r116", "C4_r116"]
    run = read(REAL.with_suffix(".parquet")).window(0.0, 11.0).select(["GenSpeed"])
    signals = with_field_wind(run, read_turbsim(REAL.with_suffix(".bts")), 120.0, 4)
    for time, expected in known.items():
        row = signals.select([*names, "U_disk", "U_cubic"]).resample([time, time + 0.1]).values[0]
        np.testing.assert_allclose(row, expected, atol=1.5e-3)
    assert signals.channel("C4_r116") == Channel("C4_r116", "m/s", role="disturbance")


def test_names_and_default_rings():
    assert ring_radii(120.0) == (15, 36, 57, 78, 99, 116)
    assert ring_radii(1.2) == (0.15, 0.36, 0.57, 0.78, 0.99, 1.16)
    first = ["U_r7.5", "C1_r7.5", "S1_r7.5", "C2_r7.5", "S2_r7.5"]
    second = ["U_r036", "C1_r036", "S1_r036", "C2_r036", "S2_r036"]
    assert harmonic_names([7.5, 36.0], 2) == [*first, *second, "U_disk", "U_cubic"]


@pytest.mark.parametrize(
    ("harmonics", "rings", "said"),
    [
        (-1, None, "-1 harmonics were asked for, expected 0 to 23"),
        (24, None, "24 harmonics were asked for"),
        (4, (10.0, 61.0), "a ring of radius 61 m reaches beyond the field, which covers 60 m"),
        (4, (), "the rings have radii of nothing m"),
        (4, (10.0, 10.0), "the rings have radii of 10, 10 m, expected different positive numbers"),
        (4, (10.0, -1.0), "expected different positive numbers"),
        (4, (np.nan,), "expected different positive numbers"),
    ],
)
def test_rings_that_do_not_fit(tmp_path, harmonics, rings, said):
    field = read_turbsim(field_file(tmp_path / "f.bts"))
    with pytest.raises(DfsmError, match=said):
        field_signals(field, RADIUS, harmonics, rings)


def gusts(seed: int, stop: float, step: float = 0.25) -> np.ndarray:
    rng = np.random.default_rng(seed)
    time = np.arange(0, stop, step)
    phases = rng.uniform(0, 2 * np.pi, 12)
    return 10 + sum(
        np.sin(w * time + p) for w, p in zip(np.linspace(0.5, 3, 12), phases, strict=True)
    )


def test_a_run_with_another_wind_at_the_hub_is_refused(tmp_path):
    field = read_turbsim(field_file(tmp_path / "f.bts"))
    run = run_until(5.0)
    hub = with_field_wind(run, field, RADIUS)["RotWind"]  # planes: the hub has the average
    wind = Channel("Wind1VelX", "m/s")
    with_field_wind(run.with_channels([wind], hub), field, RADIUS)
    with pytest.raises(DfsmError, match=r"of Wind1VelX with the wind at the hub in .* is "):
        with_field_wind(run.with_channels([wind], gusts(1, 5.0)), field, RADIUS)
    with pytest.raises(DfsmError, match=r"is 0\.00, at least 0\.9 was expected"):
        with_field_wind(run.with_channels([wind], np.full(len(run), 10.0)), field, RADIUS)


def test_a_steady_wind_is_told_from_nothing(tmp_path):
    field = formula(tmp_path, lambda t, z, y: 10.0 + 0 * t)
    run = run_until(5.0)
    run = run.with_channels([Channel("Wind1VelX", "m/s")], np.full(len(run), 10.0))
    np.testing.assert_allclose(with_field_wind(run, field, RADIUS)["RotWind"], 10.0)


def separate(stop: float = 20.0, seed: int = 0) -> Trajectory:
    """Harmonics as a file of their own would hold them: another mesh, no roles."""
    time = np.arange(0, stop + 0.1, 0.2)
    wind = gusts(seed, 40.0, 0.2)[: len(time)]
    values = np.stack([wind, wind, time, wind, wind], axis=1)
    names = ("U_r036", "U_r015", "C1_r036", "U_disk", "U_cubic")
    return Trajectory(time, values, tuple(Channel(n, "m/s") for n in names), name="harmonics")


def windy(stop: float = 19.0, name: str = "RotWind", seed: int = 0) -> Trajectory:
    run = run_until(stop)
    wind = np.interp(run.time, separate(30.0).time, separate(30.0, seed)["U_disk"])
    return run.with_channels([Channel(name, "m/s")], wind)


@pytest.mark.parametrize("name", ["RotWind", "Wind1VelX"])
def test_harmonics_of_another_file_join_a_run(name):
    run, harmonics = windy(name=name), separate()
    joined = with_harmonics(run, harmonics)
    assert joined.names == ("q", name, *harmonics.names)
    np.testing.assert_allclose(joined["C1_r036"], run.time, atol=1e-12)
    np.testing.assert_array_equal(joined.values[:, :2], run.values)
    assert {c.role for c in joined.channels[2:]} == {"disturbance"}


def test_times_in_single_precision_cover_a_run():
    harmonics = separate(18.8)
    short = replace(harmonics, time=harmonics.time * (1 - 1e-8))
    assert with_harmonics(windy(19.0), short).time[-1] == 18.75
    run = replace(windy(19.0), time=windy(19.0).time * 18.8 / 18.75)
    assert len(with_harmonics(run, short)) == len(run)


@pytest.mark.parametrize(
    ("run", "harmonics", "said"),
    [
        (windy(25.0), separate(), r"run covers 0 to 24\.75 s, but harmonics only 0 to 20 s"),
        (
            windy(seed=1),
            separate(),
            r"correlation of RotWind with U_disk in harmonics is -?0\.\d\d",
        ),
        (
            windy(name="Wind1VelX", seed=1),
            separate(),
            r"of Wind1VelX with U_r015 in harmonics is -?0",
        ),
        (run_until(19.0), separate(), "neither RotWind nor Wind1VelX is there"),
        (windy(name="U_disk"), separate(), "channel 'U_disk' exists already: nothing was added"),
        (run_until(19.0), windy().select(["RotWind"]), r"harmonics over rings \(U_disk, U_r036"),
        (windy(), separate().select(["U_r015"]), "harmonics holds U_r015"),
    ],
)
def test_harmonics_that_do_not_belong_to_a_run(run, harmonics, said):
    with pytest.raises(DfsmError, match=said):
        with_harmonics(run, harmonics)


def test_a_file_of_codes_with_one_scale_is_read_in_its_unit(tmp_path):
    codes = np.array([13278, -13, 20], dtype=np.int16)
    time = pa.array([0.0, 0.2, 0.4], type=pa.float32())
    metadata = {"scale": "0.001", "unit": "m/s", "rings_m": "[15]"}
    table = pa.table({"Time": time, "U_r015": codes, "own": np.ones(3)}, metadata=metadata)
    pq.write_table(table, tmp_path / "h.parquet")
    run = read(tmp_path / "h.parquet")
    assert run.channels == (Channel("U_r015", "m/s", step=0.001), Channel("own"))
    np.testing.assert_allclose(run["U_r015"], [13.278, -0.013, 0.02], rtol=1e-15)
    pq.write_table(table.replace_schema_metadata(metadata | {"scale": "0"}), tmp_path / "h.parquet")
    with pytest.raises(DfsmError, match="its metadata give a scale of 0"):
        read(tmp_path / "h.parquet")


def test_the_command_adds_harmonics(tmp_path, dfsm: Dfsm):
    field = field_file(tmp_path / "f.bts")
    write_table(run_until(5.0), tmp_path / "run.csv")
    command = ("wind", field, tmp_path / "run.csv", "--radius", RADIUS, "-o", tmp_path / "new")
    result = dfsm(*command)
    assert result.code == 0
    assert "with RotWind, RotShearV and RotShearH, and harmonics 1 to 4 over rings" in result.out
    expected = with_field_wind(run_until(5.0), read_turbsim(field), RADIUS, 4)
    written = read(tmp_path / "new" / "run.parquet")
    assert written.names == expected.names
    np.testing.assert_allclose(written.values, expected.values, atol=1e-12)
    assert dfsm(*command, "--harmonics", 2, "--rings", "12.5,40").code == 0
    expected = with_field_wind(run_until(5.0), read_turbsim(field), RADIUS, 2, (12.5, 40.0))
    written = read(tmp_path / "new" / "run.parquet")
    assert written.names == expected.names
    np.testing.assert_allclose(written.values, expected.values, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--rings", "a,b"), "--rings is 'a,b', expected radii in m as in 36,78,116"),
        (("--rings", "70"), "a ring of radius 70 m reaches beyond the field"),
        (("--shear", "0.1"), "--shear is for a Mann box: give its sizes with --box"),
        (("--last-first",), "--last-first is for a Mann box"),
    ],
)
def test_the_command_refuses(tmp_path, dfsm: Dfsm, options, said):
    field = field_file(tmp_path / "f.bts")
    write_table(run_until(5.0), tmp_path / "run.csv")
    command = ("wind", field, tmp_path / "run.csv", "--radius", RADIUS, "-o", tmp_path / "new")
    assert said in dfsm(*command, *options).sentence

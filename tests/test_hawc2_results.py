"""Results of HAWC2 as it writes them: times rounded to codes, integers with missing values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from conftest import sentence
from dfsm.data.readers import read

# -- .sel and .dat ------------------------------------------------------------------------------


def binary(path: Path, time: np.ndarray, announced: float) -> Path:
    """A result with two channels beside the time, each with a scale factor of six digits."""
    told = [("Time", "s", "Time"), ("Mx", "kNm", "blade root"), ("RPM", "rpm", "rotor")]
    table = np.stack([time, 900 * np.sin(0.4 * time), 8 + np.cos(0.1 * time)])
    lines = [f"{i:6d}      {n:<31}{u:<11}{d}" for i, (n, u, d) in enumerate(told, start=1)]
    scales = [float(f"{np.abs(row).max() / 32000:.5E}") for row in table]
    head = ["_" * 60, f"  {len(time):8d} {3:6d} {announced:14.3f}       BINARY", "", "Channel", ""]
    tail = ["", "Scale factors:", *(f"  {s:.5E}" for s in scales)]
    path.write_text("\n".join([*head, *lines, *tail]) + "\n")
    codes = np.rint(table / np.array(scales)[:, None]).astype("<i2")
    codes.tofile(path.with_suffix(".dat"))
    return path


@pytest.mark.parametrize(
    ("first", "step", "count"),
    [
        (0.02, 0.02, 5000),  # steps of 0.003 s
        (0.01, 0.01, 70000),  # 0.022 s: times repeat
        (400.04, 0.04, 20000),  # a late start, 0.0375 s
        (19231 * 0.013, 0.013, 9000),
        (0.0, 0.05, 400),  # the first scan at 0
    ],
)
def test_binary_scans_are_equidistant_whatever_the_code_of_the_time(tmp_path, first, step, count):
    time = first + step * np.arange(count)
    length = time[-1] - first + step
    for announced in (length, time[-1] - first, 0.0):  # some writers leave the first scan out
        run = read(binary(tmp_path / "a.sel", time, announced))
        assert run.time_step == pytest.approx(step, rel=1e-9)
        np.testing.assert_allclose(run.time, time, atol=1e-9)
        assert run.notes == ()


def test_binary_scans_at_no_equal_steps(tmp_path):
    time = np.cumsum(np.linspace(0.05, 0.2, 300))
    run = read(binary(tmp_path / "a.sel", time, time[-1]))
    np.testing.assert_allclose(run.time, time, atol=0.001)
    assert "times are no equal steps and rounded to 0.00117 s" in run.notes[0]
    time = np.concatenate([0.002 * np.arange(1, 300), 900 + 0.01 * np.arange(300)])
    told = sentence(binary(tmp_path / "a.sel", time, time[-1]))
    assert "its time channel comes in steps of 0.0282 s, in which scans fall together" in told


# -- gtsdf --------------------------------------------------------------------------------------

STEP = 0.1


def gtsdf(
    path: Path, parts: Sequence[np.ndarray], kind: str = "uint16", *, arrays: bool = False
) -> Path:
    """Blocks of one signal each; NaN is the largest integer, the others fill the rest."""
    h5py = pytest.importorskip("h5py")
    most, start = np.iinfo(kind).max, 3.0
    with h5py.File(path, "w") as file:
        text = np.bytes_("General time series data format")
        file.attrs["type"] = np.array([text]) if arrays else text
        file.attrs["no_blocks"] = len(parts)
        for name, value in {"names": b"Fx", "units": b"N", "descriptions": b"thrust"}.items():
            file[f"attribute_{name}"] = [value]
        for number, values in enumerate(parts):
            low, high = np.nanmin(values), np.nanmax(values)
            gain = (high - low) / (most - 1)
            codes = np.where(np.isnan(values), most, np.rint((values - low) / gain))
            block = file.create_group(f"block{number:04d}")
            block["data"], block["gains"] = codes.astype(kind)[:, None], [gain]
            block["offsets"] = [low]
            for key, value in {"time_start": start, "time_step": STEP}.items():
                block.attrs[key] = np.array([value]) if arrays else value
            start += STEP * len(values)
    return path


@pytest.mark.parametrize("kind", ["uint8", "int16", "uint16", "int32"])
@pytest.mark.parametrize("arrays", [False, True])
def test_the_largest_integer_of_gtsdf_is_missing_and_the_smallest_is_not(tmp_path, kind, arrays):
    values = 40 + 5 * np.sin(0.3 * np.arange(250))
    values[[17, 18, 200]] = np.nan
    run = read(gtsdf(tmp_path / "a.hdf5", [values[:100], values[100:]], kind, arrays=arrays))
    assert run.names == ("Fx",)
    np.testing.assert_array_equal(np.isnan(run["Fx"]), np.isnan(values))
    resolution = np.nanmax(values) / (np.iinfo(kind).max - 1)
    np.testing.assert_allclose(run["Fx"], values, atol=resolution)
    np.testing.assert_allclose(run.time, 3 + STEP * np.arange(250), rtol=1e-12)


def test_blocks_of_gtsdf_that_make_no_sense(tmp_path):
    h5py = pytest.importorskip("h5py")
    values = np.sin(np.arange(30.0))
    path = gtsdf(tmp_path / "a.hdf5", [values])
    with h5py.File(path, "a") as file:
        file["block0000"].attrs["time_step"] = np.array([0.1, 0.2])
    assert "time_step of block0000 is '0.1, 0.2', one number in s was expected" in sentence(path)
    path = gtsdf(tmp_path / "a.hdf5", [values])
    with h5py.File(path, "a") as file:
        del file["block0000"]["gains"]
        file["block0000"]["gains"] = [1.0, 2.0]
    assert "block0000 has 2 gains and 1 offsets for 1 signals" in sentence(path)

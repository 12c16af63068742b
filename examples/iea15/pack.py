"""Make the data in this folder from a folder of OpenFAST runs: ``python pack.py SOURCE_DIR``.

Three test runs are copied byte for byte, so that the `.outb` reader meets real files. All others
become packed Parquet: 15 channels, the 16-bit codes of the `.outb` unchanged. Every packed run is
read back and compared with its source; the folder's size is held to 14.5 MB. Of one turbulence
field (in ``original/`` of the source) the first seconds are kept, of all others the averages over
rings of the rotor (from ``harmonics/``).
"""

from __future__ import annotations

import argparse
import json
import shutil
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from dfsm.data.readers.openfast import read_openfast
from dfsm.data.readers.tables import read_table, write_table
from dfsm.data.trajectory import Trajectory

HERE = Path(__file__).parent
UNMODIFIED = ("iea15_2dof_06mps_s09", "iea15_2dof_12mps_s09", "iea15_2dof_18mps_s09")
CHANNELS = (
    "GenTq",
    "BldPitch1",
    "RotWind",
    "RotShearV",
    "RotShearH",
    "RtVAvgxh",
    "Wave1Elev",
    "PtfmPitch",
    "PtfmRVyt",
    "PtfmRAyt",
    "GenSpeed",
    "GenPwr",
    "TwrBsFxt",
    "TwrBsMyt",
    "LSSTipPxa",
)
FIELD = "iea15_2dof_12mps_s08.bts"
FIELD_STEPS = 240  # of 0.1 s
# Runs of the source that are not bundled.
LEFT_OUT = ("iea15_2dof_06mps_s03_ol", "iea15_2dof_12mps_s05_ol", "iea15_2dof_18mps_s03_ol")
LIMIT = 14_500_000


def main() -> int:
    """Pack all runs of the source folder into this one and check the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("source", type=Path, help="folder with *.outb and wall_times.json")
    source: Path = parser.parse_args().source
    recorded = json.loads((source / "wall_times.json").read_text())
    wall_times = {Path(name).stem: seconds for name, seconds in recorded.items()}
    identical = 0
    runs = sorted(p for p in source.glob("*.outb") if p.stem not in LEFT_OUT)
    for path in runs:
        if path.stem in UNMODIFIED:
            shutil.copyfile(path, HERE / path.name)
            continue
        run = replace(read_openfast(path).select(CHANNELS), wall_time=wall_times.get(path.stem))
        packed = HERE / f"{path.stem}.parquet"
        write_table(run, packed, packed=True)
        check(path, run, packed)
        identical += run.digest == read_table(packed).digest
    (HERE / "winds").mkdir(exist_ok=True)
    for path in sorted((source / "harmonics").glob("*.parquet")):
        rings = read_table(path)
        rings = rings.select(n for n in rings.names if n.startswith("U_"))
        rings = replace(rings, time=rings.time[::2], values=rings.values[::2])
        write_table(rings, HERE / "winds" / path.name, packed=True)
    (HERE / FIELD).write_bytes(beginning(source / "original" / FIELD, FIELD_STEPS))
    (HERE / "wall_times.json").write_text(json.dumps(wall_times, indent=1, sort_keys=True) + "\n")
    total = sum(p.stat().st_size for p in HERE.rglob("*") if p.is_file())
    count = len(runs) - len(UNMODIFIED)
    print(f"{len(UNMODIFIED)} runs copied; {count} packed, all codes, steps and times identical,")
    print(f"{identical} of them with all values identical bit for bit; {total} bytes in all")
    if total > LIMIT:
        print(f"that is more than {LIMIT} bytes", file=sys.stderr)
        return 1
    return 0


def beginning(path: Path, steps: int) -> bytes:
    """Return the first time steps of a TurbSim field as a field: only its length is changed."""
    raw = path.read_bytes()
    _, nz, ny, towers, _ = struct.unpack_from("<h4i", raw)
    start = 70 + struct.unpack_from("<i", raw, 66)[0]
    length = steps * 3 * 2 * (nz * ny + towers)
    return raw[:14] + struct.pack("<i", steps) + raw[18 : start + length]


def check(path: Path, run: Trajectory, packed: Path) -> None:
    """Compare a packed run with the `.outb` it came from.

    The codes of the `.outb` are decoded here with NumPy alone, so that neither reader is trusted.

    Raises
    ------
    SystemExit
        A code, a time, a step, a unit or (beyond rounding) a value differs.
    """
    codes = raw_codes(path)
    table = pq.read_table(packed)
    back = read_table(packed)
    same = np.array_equal(back.time, run.time) and back.channels == run.channels
    same = same and np.allclose(back.values, run.values, rtol=1e-14, atol=0)
    for name in CHANNELS:
        # A constant channel (the torque above rated) has no step and is kept as it is.
        expected = codes[name] if run.channel(name).step else run[name]
        same = same and np.array_equal(table.column(name).to_numpy(), expected)
    if not same:
        raise SystemExit(f"{packed} differs from {path}")


def raw_codes(path: Path) -> dict[str, np.ndarray]:
    """Return the 16-bit codes of a format-4 `.outb` by channel name, shape ``(time,)`` each."""
    raw = path.read_bytes()
    width = int(np.frombuffer(raw, "<i2", 1, 2)[0])
    count, samples = (int(n) for n in np.frombuffer(raw, "<i4", 2, 4))
    at = 28 + 8 * count
    at += 4 + int(np.frombuffer(raw, "<i4", 1, at)[0])
    names = [raw[at + i * width : at + (i + 1) * width].decode().strip() for i in range(count + 1)]
    codes = np.frombuffer(raw, "<i2", samples * count, at + 2 * (count + 1) * width)
    return dict(zip(names[1:], codes.reshape(samples, count).T, strict=True))


if __name__ == "__main__":
    sys.exit(main())

"""Make the data in this folder from a folder of OpenFAST runs: ``python pack.py SOURCE_DIR``.

``thrust.parquet`` holds RotThrust of the bundled runs, a channel per run, as 16-bit codes of the
`.outb`. ``field.parquet`` holds what the turbulence field of one run has beside its average and
slopes over the rotor disk, which are bundled with the run.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dfsm.core.types import Array
from dfsm.data.readers.openfast import read_openfast
from dfsm.data.readers.tables import write_table
from dfsm.data.readers.turbsim import read_turbsim
from dfsm.data.trajectory import Channel, Trajectory

HERE = Path(__file__).parent
FIELD = "iea15_2dof_12mps_s08"
RADIUS = 120.0  # m
RINGS = (0.0, 40.0, 80.0, 120.0)  # m


def main() -> None:
    """Write both files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("source", type=Path, help="folder with *.outb, and original/ with a .bts")
    source: Path = parser.parse_args().source
    runs = [read_openfast(path) for path in sorted(source.glob("*.outb"))]
    channels = tuple(replace(r.channel("RotThrust"), name=r.name) for r in runs)
    thrust = np.stack([r["RotThrust"] for r in runs], axis=1)
    write_table(Trajectory(runs[0].time, thrust, channels), HERE / "thrust.parquet", packed=True)
    field = field_beside_plane(source / "original" / f"{FIELD}.bts", runs[0].time[::2])
    write_table(field, HERE / "field.parquet")


def field_beside_plane(path: Path, time: Array) -> Trajectory:
    """Averages over three rings, variance about the plane, and what turns twice as one goes round.

    Parameters
    ----------
    path
        TurbSim field.
    time
        Of the run that it drove, in s.
    """
    field = read_turbsim(path)
    u = np.concatenate([part.reshape(len(part), -1) for part in field.blocks()])
    z, y = (a.ravel() for a in np.meshgrid(field.z - field.hub_height, field.y, indexing="ij"))
    radius, angle = np.hypot(y, z), np.arctan2(y, z)
    disk = radius <= RADIUS
    plane = np.stack([np.ones(disk.sum()), z[disk], y[disk]], axis=1)
    left = u[:, disk] - (u[:, disk] @ np.linalg.pinv(plane).T) @ plane.T
    signals = {
        f"ring to {b:g} m": u[:, (radius >= a) & (radius <= b)].mean(axis=1)
        for a, b in pairwise(RINGS)
    }
    twice = (radius[disk] / RADIUS) ** 2
    signals["cos 2"] = (u[:, disk] * np.cos(2 * angle[disk]) * twice).mean(axis=1)
    signals["sin 2"] = (u[:, disk] * np.sin(2 * angle[disk]) * twice).mean(axis=1)
    signals["variance"] = left.var(axis=1)
    own = field.step * np.arange(field.count) - field.delay
    values = [np.interp(time, own, v).astype(np.float32) for v in signals.values()]
    units = [*["m/s"] * (len(signals) - 1), "m^2/s^2"]
    channels = tuple(Channel(n, unit) for n, unit in zip(signals, units, strict=True))
    return Trajectory(time, np.stack(values, axis=1), channels, name=path.stem)


if __name__ == "__main__":
    main()

"""TurbSim full-field wind files (`.bts`) to the three signals that a rotor feels.

A turbulent field is far more than its average: the vertical and horizontal slopes over the rotor
disk pitch and yaw the turbine. Fitting a plane to the field over the disk gives all three,

    u(y, z, t) ≈ RotWind + RotShearV (z - hub height) / R + RotShearH y / R .
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.files import existing_file
from dfsm.core.progress import track
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

CHANNELS = (
    Channel("RotWind", "m/s", role="disturbance"),
    Channel("RotShearV", "m/s", role="disturbance"),
    Channel("RotShearH", "m/s", role="disturbance"),
)
# Format number, grid sizes, spacings and scales; then the length of a description.
_HEADER = struct.Struct("<h4i6f6fi")
_FORMATS = {7: False, 8: True}  # whether the field repeats itself
# Time steps read at once.
_BLOCK = 1000
# A plane has three unknowns; with fewer points than this the disk is not resolved.
_FEWEST_POINTS = 9


@dataclass(frozen=True, eq=False)
class WindField:
    """A TurbSim field on disk.

    Attributes
    ----------
    path
        The file.
    step
        Time step in s.
    count
        Number of time steps.
    y, z
        Grid points in m, shapes ``(y,)`` and ``(z,)``: sideways from the middle, and upwards.
    hub_height
        In m.
    mean_wind
        Mean longitudinal wind at hub height in m/s.
    periodic
        Whether the field repeats itself.
    slope, offset
        Scaling of the longitudinal component: ``u = (integer - offset) / slope``.
    towers
        Number of extra points below the grid.
    start
        Where the samples begin in the file, in bytes.
    """

    path: Path
    step: float
    count: int
    y: Array
    z: Array
    hub_height: float
    mean_wind: float
    periodic: bool
    slope: float
    offset: float
    towers: int
    start: int

    @property
    def delay(self) -> float:
        """Time in s by which the field is ahead of the rotor: half its width over the mean wind."""
        return float(self.y[-1] - self.y[0]) / 2 / self.mean_wind

    def blocks(self) -> Iterator[Array]:
        """Longitudinal wind in m/s in parts of shape ``(time, z, y)``."""
        points = len(self.y) * len(self.z)
        shape = (self.count, 3 * (points + self.towers))
        raw = np.memmap(self.path, "<i2", "r", self.start, shape)
        for first in range(0, self.count, _BLOCK):
            part = raw[first : first + _BLOCK, : 3 * points : 3]
            u = (part.astype(np.float64) - self.offset) / self.slope
            yield u.reshape(-1, len(self.z), len(self.y))


def read_turbsim(path: str | Path) -> WindField:
    """Open a TurbSim full-field file; the samples stay on disk until they are needed.

    Parameters
    ----------
    path
        File as TurbSim writes it with ``WrADFF`` (TurbSim User's Guide 2.0, Appendix D).

    Returns
    -------
    WindField

    Raises
    ------
    DfsmError
        The file is missing, is no TurbSim field, or is cut off.
    """
    path = existing_file(path)
    with path.open("rb") as stream:
        head = stream.read(_HEADER.size)
    if len(head) < _HEADER.size or struct.unpack_from("<h", head)[0] not in _FORMATS:
        raise DfsmError(f"{path} is no TurbSim full-field file (.bts): give the file of the field")
    kind, nz, ny, towers, count, dz, dy, dt, mean, hub, bottom, *scales, text = _HEADER.unpack(head)
    sizes = min(nz, ny) >= 2 and towers >= 0 and count >= 2 and text >= 0
    if not (sizes and min(dz, dy, dt, mean) > 0 and scales[0] != 0):
        raise DfsmError(f"{path}: the header of the wind field makes no sense: write it again")
    start = _HEADER.size + text
    expected = start + 2 * count * 3 * (ny * nz + towers)
    if path.stat().st_size != expected:
        raise DfsmError(
            f"{path}: {path.stat().st_size} bytes, but its header announces {expected}: the file "
            "is cut off or damaged, copy it again"
        )
    return WindField(
        path=path,
        # Stored in single precision: 0.1 s would come back as 0.100000001 s.
        step=float(f"{dt:.7g}"),
        count=count,
        y=(np.arange(ny) - (ny - 1) / 2) * dy,
        z=bottom + np.arange(nz) * dz,
        hub_height=float(hub),
        mean_wind=float(mean),
        periodic=_FORMATS[kind],
        slope=scales[0],
        offset=scales[1],
        towers=towers,
        start=start,
    )


def disk_wind(field: WindField, radius: float) -> Array:
    """Fit a plane to the longitudinal wind over the rotor disk at every time step.

    Parameters
    ----------
    field
        From `read_turbsim`.
    radius
        Rotor radius in m.

    Returns
    -------
    ndarray
        Average and slopes per radius upwards and sideways in m/s, shape ``(time, 3)``, at the
        field's own time steps.

    Raises
    ------
    DfsmError
        The disk reaches beyond the field, or holds too few of its points.
    """
    if not (np.isfinite(radius) and radius > 0):
        raise DfsmError(f"the rotor radius is {radius} m, expected a positive number")
    reach = min(field.y[-1], field.z[-1] - field.hub_height, field.hub_height - field.z[0])
    if radius > reach * (1 + 1e-6):
        raise DfsmError(
            f"{field.path}: a rotor of radius {radius:g} m reaches beyond the field, which covers "
            f"{reach:.4g} m around the hub: give the radius in m, or another field"
        )
    height, side = np.meshgrid(
        (field.z - field.hub_height) / radius, field.y / radius, indexing="ij"
    )
    disk = np.hypot(height, side) <= 1 + 1e-9
    if disk.sum() < _FEWEST_POINTS:
        raise DfsmError(
            f"{field.path}: only {disk.sum()} grid points lie on a rotor of radius {radius:g} m, "
            f"at least {_FEWEST_POINTS} are needed: use a finer field"
        )
    plane = np.linalg.pinv(np.column_stack([np.ones(disk.sum()), height[disk], side[disk]]))
    total = -(-field.count // _BLOCK)
    return np.concatenate(
        [u[:, disk] @ plane.T for u in track(field.blocks(), "Reading the wind field", total)]
    )


def with_field_wind(run: Trajectory, field: WindField, radius: float) -> Trajectory:
    """Add the disk's wind and its slopes to a run that the field drove.

    The field meets the rotor plane later than it starts: time t of the run is field time
    t + `WindField.delay`.

    Parameters
    ----------
    run
        Any run; its times are those of the simulation.
    field
        The field that drove it.
    radius
        Rotor radius in m.

    Returns
    -------
    Trajectory
        The run with the channels ``RotWind``, ``RotShearV`` and ``RotShearH`` in m/s appended.

    Raises
    ------
    DfsmError
        The run has one of the channels already, or lasts longer than the field; see `disk_wind`.
    """
    there = [c.name for c in CHANNELS if c.name in run]
    if there:
        raise DfsmError(f"{run.where}: channel '{there[0]}' exists already: nothing was added")
    time = run.time + field.delay
    wind = disk_wind(field, radius)
    if field.periodic:
        wind = np.concatenate([wind, wind[:1]])
        time = time % (field.count * field.step)
    mesh = field.step * np.arange(len(wind))
    if time.max() > mesh[-1] * (1 + 1e-9) or time.min() < 0:
        raise DfsmError(
            f"{run.where} covers {run.time[0]:g} to {run.time[-1]:g} s, but {field.path} only "
            f"{-field.delay:.4g} to {mesh[-1] - field.delay:.4g} s of it: cut the run, or give the "
            "field that drove it"
        )
    return run.with_channels(CHANNELS, np.stack([np.interp(time, mesh, w) for w in wind.T], axis=1))

"""TurbSim full-field wind files (`.bts`).

In OpenFAST, a field is half its width ahead of the rotor at the start, so that a turbine that yaws
stays in it; one that repeats itself begins at the rotor (InflowWind, ``IfW_TurbSim_Init``).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dfsm.core.files import existing_file
from dfsm.core.types import Array
from dfsm.data.wind_field import BLOCK, WindField
from dfsm.errors import DfsmError

# Format number, grid sizes, spacings and scales; then the length of a description.
_HEADER = struct.Struct("<h4i6f6fi")
_FORMATS = {7: False, 8: True}  # whether the field repeats itself
# Of wind in m/s, and of heights in m: no turbine meets more.
_MOST_WIND = 1000.0


@dataclass(frozen=True, eq=False)
class TurbSimField(WindField):
    """A TurbSim field on disk.

    Attributes
    ----------
    path, step, count, y, z, hub_height, mean_wind, periodic, delay
        See `WindField`.
    slope, offset
        Scaling of the longitudinal component: ``u = (integer - offset) / slope``.
    towers
        Number of extra points below the grid.
    start
        Where the samples begin in the file, in bytes.
    """

    slope: float
    offset: float
    towers: int
    start: int

    def blocks(self) -> Iterator[Array]:
        """Longitudinal wind in m/s in parts of shape ``(time, z, y)``."""
        points = len(self.y) * len(self.z)
        shape = (self.count, 3 * (points + self.towers))
        raw = np.memmap(self.path, "<i2", "r", self.start, shape)
        for first in range(0, self.count, BLOCK):
            part = raw[first : first + BLOCK, : 3 * points : 3]
            u = (part.astype(np.float64) - self.offset) / self.slope
            yield u.reshape(-1, len(self.z), len(self.y))


def read_turbsim(path: str | Path) -> TurbSimField:
    """Open a TurbSim full-field file; the samples stay on disk until they are needed.

    Parameters
    ----------
    path
        File as TurbSim writes it with ``WrADFF`` (TurbSim User's Guide 2.0, Appendix D).

    Returns
    -------
    TurbSimField

    Raises
    ------
    DfsmError
        The file is missing, is no TurbSim field, or is cut off.
    """
    path = existing_file(path)
    with path.open("rb") as stream:
        head = stream.read(_HEADER.size)
    if len(head) < _HEADER.size or struct.unpack_from("<h", head)[0] not in _FORMATS:
        raise DfsmError(
            f"{path} is no TurbSim full-field file (.bts): give the file of the field, with its "
            "sizes (--box) if it is a Mann box"
        )
    kind, nz, ny, towers, count, dz, dy, dt, mean, hub, bottom, *scales, text = _HEADER.unpack(head)
    sizes = min(nz, ny) >= 2 and towers >= 0 and count >= 2 and text >= 0
    if not sizes:
        raise DfsmError(
            f"{path}: the header of the wind field makes no sense ({nz} x {ny} points, {towers} on "
            f"the tower, {count} steps): write it again"
        )
    _check_numbers(
        path,
        {
            "grid spacing upwards (dz) in m": (dz, dz > 0),
            "grid spacing sideways (dy) in m": (dy, dy > 0),
            "time step (dt) in s": (dt, dt > 0),
            "mean wind (UHub) in m/s": (mean, 0 < mean < _MOST_WIND),
            "hub height (HubHt) in m": (hub, hub > 0),
            "height of the lowest points (ZBot) in m": (bottom, bottom > -_MOST_WIND),
            "slope of u": (scales[0], scales[0] > 0),
            "offset of u": (scales[1], True),
        },
    )
    low, high = ((code - scales[1]) / scales[0] for code in (-32768, 32767))
    if max(abs(low), abs(high)) > _MOST_WIND:
        raise DfsmError(
            f"{path}: the slope and offset of u in its header, {scales[0]:g} and {scales[1]:g}, "
            f"make winds from {low:.3g} to {high:.3g} m/s of its integers: write the field again"
        )
    start = _HEADER.size + text
    expected = start + 2 * count * 3 * (ny * nz + towers)
    if path.stat().st_size != expected:
        raise DfsmError(
            f"{path}: {path.stat().st_size} bytes, but its header announces {expected}: the file "
            "is cut off or damaged, copy it again"
        )
    y = (np.arange(ny) - (ny - 1) / 2) * dy
    return TurbSimField(
        path=path,
        # Stored in single precision: 0.1 s would come back as 0.100000001 s.
        step=float(f"{dt:.7g}"),
        count=count,
        y=y,
        z=bottom + np.arange(nz) * dz,
        hub_height=float(hub),
        mean_wind=float(mean),
        periodic=_FORMATS[kind],
        delay=0.0 if _FORMATS[kind] else float(y[-1] - y[0]) / 2 / mean,
        slope=scales[0],
        offset=scales[1],
        towers=towers,
        start=start,
    )


def _check_numbers(path: Path, numbers: Mapping[str, tuple[float, bool]]) -> None:
    """Refuse a header with a number that makes no sense; the field of the header is named."""
    for name, (value, good) in numbers.items():
        if not (math.isfinite(value) and good):
            raise DfsmError(
                f"{path}: its header gives the {name} as {value:g}, which makes no sense: write "
                "the field again"
            )

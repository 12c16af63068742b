"""Mann boxes: turbulence as HAWC2 reads it, single-precision numbers without a header.

One file per component, of which the longitudinal one is read. Points along z follow each other
upwards, then those along y from left to right as one looks downwind (y in OpenFAST points left, so
it decreases), then planes along x. The first plane meets the rotor at time 0 and the others follow,
as in HAWC2 and in InflowWind (``WindType`` 5, ``XOffset`` 0); the box repeats itself. Mann's own x
points downwind, so that in nature the last plane comes first: `BoxSettings.last_first`.

Sources: InflowWind of OpenFAST, ``IfW_HAWC_Init``; OpenFAST issue 256 on the order of planes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dfsm.core.files import existing_file
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.data.wind_field import BLOCK, WindField
from dfsm.errors import DfsmError

# Turbulence in m/s stays far below; other numbers read as these do not.
_MOST = 1000.0


@settings_class
class BoxSettings:
    """What a Mann box does not say of itself.

    Attributes
    ----------
    points
        Numbers of points along x (downwind), y (sideways) and z (upwards).
    spacing
        Distances between them in m.
    mean_wind
        Mean wind at hub height in m/s (``URef``): added to the box, and what moves it.
    hub_height
        In m (``RefHt``): the middle of the box.
    shear
        Exponent of the mean wind's power law over height (``PLExp``); 0 is the same everywhere.
    scale
        Factor of the turbulence (``SFx`` where ``ScaleMethod`` is 1); the box's own mean at every
        point is taken out then, as InflowWind does. None leaves the box as it is.
    last_first
        Whether the last plane of the file meets the rotor first.

    Raises
    ------
    DfsmError
        A number makes no sense.
    """

    points: tuple[int, int, int]
    spacing: tuple[float, float, float]
    mean_wind: float
    hub_height: float
    shear: float = 0.0
    scale: float | None = None
    last_first: bool = False

    def __post_init__(self) -> None:
        require(min(self.points) >= 2, "box.points", self.points, "at least two each way")
        for name in ("spacing", "mean_wind", "hub_height", "scale"):
            value = getattr(self, name)
            positive = value is None or bool(np.all(np.greater(value, 0) & np.isfinite(value)))
            require(positive, f"box.{name}", value, "positive numbers")
        require(bool(np.isfinite(self.shear)), "box.shear", self.shear, "an exponent such as 0.14")


@dataclass(frozen=True, eq=False)
class MannBox(WindField):
    """A Mann box on disk.

    Attributes
    ----------
    path, step, count, y, z, hub_height, mean_wind, periodic, delay
        See `WindField`.
    settings
        What was told of the box.
    """

    settings: BoxSettings

    def blocks(self) -> Iterator[Array]:
        """Longitudinal wind in m/s in parts of shape ``(time, z, y)``."""
        scale = self.settings.scale
        profile = (np.maximum(self.z, 0.0) / self.hub_height) ** self.settings.shear
        mean = self.mean_wind * profile[:, None]
        own = 0.0 if scale is None else sum(part.sum(axis=0) for part in self._parts()) / self.count
        for part in self._parts():
            turbulence = part if scale is None else scale * (part - own)
            yield mean + turbulence[:, ::-1].transpose(0, 2, 1)

    def _parts(self) -> Iterator[NDArray[np.float64]]:
        """Turbulence as the file holds it, shape ``(time, -y, z)``, in the order of time."""
        raw = np.memmap(self.path, "<f4", "r", shape=self.settings.points)
        planes = raw[::-1] if self.settings.last_first else raw
        for first in range(0, self.count, BLOCK):
            with np.errstate(invalid="ignore"):  # told below
                part = planes[first : first + BLOCK].astype(np.float64)
                most = np.abs(part).max()
            if not most < _MOST:
                raise DfsmError(
                    f"{self.path} holds values of up to {most:.3g} m/s, which is no turbulence: "
                    "expected little-endian numbers in single precision and no header"
                )
            yield part


def read_mann(path: str | Path, settings: BoxSettings) -> MannBox:
    """Open the longitudinal component of a Mann box; the samples stay on disk until needed.

    Parameters
    ----------
    path
        File of the component u.
    settings
        Sizes of the box and the mean wind that carries it.

    Returns
    -------
    MannBox

    Raises
    ------
    DfsmError
        The file is missing, or its size is not that of the box.
    """
    path = existing_file(path)
    nx, ny, nz = settings.points
    dx, dy, dz = settings.spacing
    size, expected = path.stat().st_size, 4 * nx * ny * nz
    if size != expected:
        raise DfsmError(
            f"{path}: {size} bytes, but a box of {nx} x {ny} x {nz} points has {expected}: "
            "give the numbers of points along x, y and z of this file"
        )
    return MannBox(
        path=path,
        step=dx / settings.mean_wind,
        count=nx,
        y=(np.arange(ny) - (ny - 1) / 2) * dy,
        z=settings.hub_height + (np.arange(nz) - (nz - 1) / 2) * dz,
        hub_height=settings.hub_height,
        mean_wind=settings.mean_wind,
        periodic=True,
        delay=0.0,
        settings=settings,
    )

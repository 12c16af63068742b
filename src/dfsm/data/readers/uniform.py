"""Uniform winds (``WindType`` 2 of InflowWind, once hub-height files): wind and shears over time.

Text of 8 columns, or 9: time in s, horizontal speed in m/s, direction in deg, vertical speed in
m/s, horizontal linear shear, exponent of the power law, vertical linear shear, gust speed in m/s,
upflow in deg. ``!``, ``#`` and ``%`` begin comments. Columns are linear between the times, and stay
as they are before the first and behind the last. With V₁ the speed in the wind's own direction,

    V₁ = V ((z / z_ref)ᵃ + (H y cos δ + L (z - z_ref)) / ℓ_ref) + gust,
    u  = (V₁ cos(upflow) - V_z sin(upflow)) cos δ.

Source: OpenFAST, InflowWind, ``IfW_UniformWind`` (``GetWindSpeed``, at x = 0).
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from dfsm.core.files import existing_file
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.data.readers.text import Layout, Row, blank_cells, decode, number, read_rows
from dfsm.data.wind_field import BLOCK, WindField
from dfsm.errors import DfsmError, DfsmWarning

_COLUMNS = (
    *("time", "speed", "direction", "vertical speed", "horizontal shear", "power-law shear"),
    *("vertical shear", "gust", "upflow"),
)
_COMMENT = re.compile(r"[!#%].*")
# Points across the rotor: a power law is straight enough between them.
_ACROSS = 41
_MOST_WIND = 1000.0
# Share of the wind across the rotor's axis from which on it is told.
_ACROSS_AXIS = 0.03


@settings_class
class UniformSettings:
    """What a uniform wind does not say of itself.

    Attributes
    ----------
    hub_height
        Of the turbine, in m.
    reference_height
        Height in m where the wind has its speed (``RefHt_Uni``); default that of the hub.
    reference_length
        Length in m over which linear shears go (``RefLength``); default the rotor's diameter.

    Raises
    ------
    DfsmError
        A number makes no sense.
    """

    hub_height: float
    reference_height: float | None = None
    reference_length: float | None = None

    def __post_init__(self) -> None:
        for name in ("hub_height", "reference_height", "reference_length"):
            value = getattr(self, name)
            positive = value is None or bool(np.isfinite(value) and value > 0)
            require(positive, name, value, "a positive number in m")


@dataclass(frozen=True, eq=False)
class UniformWind:
    """A uniform wind over time.

    Attributes
    ----------
    path
        The file.
    time
        In s, shape ``(row,)``; may stand twice where the wind jumps.
    columns
        The other eight in the file's units, shape ``(row, 8)``; the direction does not wrap.
    settings
        What was told of it.
    """

    path: Path
    time: Array
    columns: Array
    settings: UniformSettings

    @property
    def hub_height(self) -> float:
        """Of the turbine, in m."""
        return self.settings.hub_height

    def over(self, times: Array, radius: float) -> UniformField:
        """The wind over a rotor at the times of a run.

        Parameters
        ----------
        times
            In s, shape ``(time,)``.
        radius
            Rotor radius in m.

        Raises
        ------
        DfsmError
            The rotor reaches into the ground, or `radius` is not positive.
        """
        hub = self.hub_height
        if not 0 < radius < hub:
            raise DfsmError(
                f"{self.path}: a rotor of radius {radius} m around a hub at {hub:g} m is not above "
                "the ground: give both in m"
            )
        y = np.linspace(-radius, radius, _ACROSS)
        rows = np.stack([np.interp(times, self.time, c) for c in self.columns.T], axis=1)
        return UniformField(
            path=self.path,
            step=float(np.ptp(times)) / max(len(times) - 1, 1),
            count=len(times),
            y=y,
            z=hub + y,
            hub_height=hub,
            mean_wind=float(rows[:, 0].mean()),
            periodic=False,
            delay=0.0,
            moments=np.asarray(times, dtype=np.float64),
            rows=rows,
            reference=(
                self.settings.reference_height or hub,
                self.settings.reference_length or 2 * radius,
            ),
        )


@dataclass(frozen=True, eq=False)
class UniformField(WindField):
    """A uniform wind on a grid over the rotor.

    Attributes
    ----------
    path, step, count, y, z, hub_height, mean_wind, periodic, delay
        See `WindField`.
    moments
        Times in s, shape ``(time,)``.
    rows
        Columns of the wind at these times, shape ``(time, 8)``.
    reference
        Height and length in m.
    """

    moments: Array
    rows: Array
    reference: tuple[float, float]
    moves_with_mean: ClassVar[bool] = False

    @property
    def times(self) -> Array:
        """Times in s, shape ``(time,)``."""
        return self.moments

    def blocks(self) -> Iterator[Array]:
        """Longitudinal wind in m/s in parts of shape ``(time, z, y)``."""
        height, length = self.reference
        y, z = self.y[None, None, :], self.z[None, :, None]
        for first in range(0, self.count, BLOCK):
            columns = self.rows[first : first + BLOCK].T[:, :, None, None]
            speed, direction, up, sideways, power, upwards, gust, upflow = columns
            turn, tilt = np.deg2rad(direction), np.deg2rad(upflow)
            shear = (sideways * y * np.cos(turn) + upwards * (z - height)) / length
            along = speed * ((z / height) ** power + shear) + gust
            yield (along * np.cos(tilt) - up * np.sin(tilt)) * np.cos(turn)


def is_uniform(path: Path) -> bool:
    """Whether a file is text that begins with a row of numbers, comments apart."""
    with path.open("rb") as stream:
        start = stream.read(1 << 16)
    if b"\0" in start:
        return False
    lines = (_COMMENT.sub("", line) for line in start.decode("latin-1").splitlines())
    cells = next((c for line in lines if (c := line.replace(",", " ").split())), [])
    return len(cells) > 1 and all(number(cell) is not None for cell in cells)


def read_uniform(path: str | Path, settings: UniformSettings) -> UniformWind:
    """Read a uniform wind.

    Parameters
    ----------
    path
        File of InflowWind's ``WindType`` 2.
    settings
        Heights and the length that it does not hold.

    Returns
    -------
    UniformWind

    Raises
    ------
    DfsmError
        The file is missing or holds something else.

    Warns
    -----
    DfsmWarning
        A part of the wind is not along the rotor's axis, or a record was left out.
    """
    path = existing_file(path)
    text = decode(path, "a uniform wind in text")
    lines = ((i, _COMMENT.sub("", line)) for i, line in enumerate(text.split("\n"), start=1))
    rows = [Row(i, blank_cells(line.replace(",", " "))) for i, line in lines if line.strip()]
    width = len(rows[0].cells) if rows else 0
    if width not in (8, 9):
        raise DfsmError(
            f"{path}: {width} columns, a uniform wind has 8 or 9 ({', '.join(_COLUMNS)}): check "
            "the file"
        )
    layout = Layout(
        path=path,
        names=_COLUMNS[:width],
        time=0,
        ended=text.endswith("\n"),
        columns="columns",
        ragged=lambda _: "correct or remove the line",
        wrong=lambda _: "correct it",
    )
    table = read_rows(rows, layout)
    if not len(table.values):
        raise DfsmError(
            f"{path}: its only row is incomplete, a row of {width} was expected: redo it"
        )
    columns = np.zeros((len(table.values), len(_COLUMNS)))
    columns[:, :width] = table.values
    _check(path, rows, columns)
    columns[:, 2] = np.unwrap(columns[:, 2], period=360.0)
    for note in table.notes:
        warnings.warn(f"{path}: {note}", DfsmWarning, stacklevel=2)
    _tell_across(path, columns)
    return UniformWind(path, columns[:, 0], columns[:, 1:], settings)


def _check(path: Path, rows: list[Row], columns: Array) -> None:
    """Refuse rows that are no wind; the line is named."""
    bad = ~np.isfinite(columns).all(axis=1)
    bad |= (np.abs(columns[:, [1, 3, 7]]) > _MOST_WIND).any(axis=1)
    for i in np.flatnonzero(bad)[:1]:
        raise DfsmError(
            f"{path}, line {rows[i].line}: a value is missing or no wind, expected numbers, and "
            f"speeds below {_MOST_WIND:g} m/s: correct it"
        )
    for i in np.flatnonzero(np.diff(columns[:, 0]) < 0)[:1]:
        raise DfsmError(
            f"{path}, line {rows[i + 1].line}: its time {columns[i + 1, 0]:g} s comes after "
            f"{columns[i, 0]:g} s: sort the lines"
        )


def _tell_across(path: Path, columns: Array) -> None:
    """Warn of wind that no signal along the rotor's axis holds."""
    # 370 deg is 10 deg: the direction was made to go on where it wraps.
    turn = np.abs((columns[:, 2] + 180) % 360 - 180)
    tilt = np.abs(columns[:, 8])
    sideways = np.abs(np.sin(np.deg2rad(turn))).max()
    speed = np.maximum(np.abs(columns[:, 1]), 1e-9)
    upwards = (np.sin(np.deg2rad(tilt)) + np.abs(columns[:, 3]) / speed).max()
    parts = [f"up to {turn.max():g} deg sideways"] if sideways > _ACROSS_AXIS else []
    parts += ["upwards"] if upwards > _ACROSS_AXIS else []
    if parts:
        warnings.warn(
            f"{path}: a part of the wind blows {' and '.join(parts)}: the signals hold what is "
            "along x alone",
            DfsmWarning,
            stacklevel=3,
        )

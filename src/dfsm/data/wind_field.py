"""Turbulent wind fields to the signals that a rotor feels, aligned in time with a run.

A field is far more than its average. Over the rotor disk a plane tells how it pitches and yaws,

    u(y, z, t) ≈ RotWind + RotShearV (z - hub height) / R + RotShearH y / R,

and harmonics over rings of radius r tell what blades meet that go round in it,

    u(r, α, t) ≈ U_r + Σₙ (Cn_r cos nα + Sn_r sin nα),    α from straight up towards positive y.

The azimuth of OpenFAST turns the other way: at azimuth ψ, blade 1 is at α = -ψ.
"""

from __future__ import annotations

import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from dfsm.core.progress import track
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory, labels
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.numerics.bilinear import bilinear_weights

PLANE = ("RotWind", "RotShearV", "RotShearH")
DISK = ("U_disk", "U_cubic")
# Radii of the rings over the rotor's: as far apart as blade elements that matter are.
RINGS = (15 / 120, 36 / 120, 57 / 120, 78 / 120, 99 / 120, 116 / 120)
_RING = re.compile(r"U_r(\d+(?:\.\d+)?)")
# Points on a ring: more than a grid of some thirty points across resolves.
_AROUND = 48
# Time steps read at once.
BLOCK = 1000
# A plane has three unknowns; with fewer points than this the disk is not resolved.
_FEWEST_POINTS = 9
# Correlations over 600 s between the winds of 34 runs and fields, rotor of 120 m. One signal of a
# run and its own field: 1.00, another field: 0.77 at most. Hub and average around 15 m: 0.71 at
# least, another field 0.60 at most. The hub and the average over the disk do not tell: 0.41, 0.63.
_SAME = 0.9
# Shares of the stated mean wind by which shear and chance move the mean over the disk, and from
# which on it is another wind.
_SAME_MEAN, _OTHER_MEAN = 0.03, 0.25
_POINT_AND_RING = 0.65


@dataclass(frozen=True, eq=False)
class WindField(ABC):
    """A turbulent wind field on disk, whatever its format.

    Attributes
    ----------
    path
        The file.
    step
        Time step in s.
    count
        Number of time steps.
    y, z
        Grid points in m, both increasing, shapes ``(y,)`` and ``(z,)``: sideways from the middle,
        to the left as one looks downwind, and upwards from the ground.
    hub_height
        In m.
    mean_wind
        Mean longitudinal wind at hub height in m/s, with which the field moves.
    periodic
        Whether the field repeats itself.
    delay
        Time in s by which the field is ahead of the rotor: what the rotor meets at time t of a run
        stands at t + `delay` in the field.
    """

    path: Path
    step: float
    count: int
    y: Array
    z: Array
    hub_height: float
    mean_wind: float
    periodic: bool
    delay: float
    # Whether it was made with a mean and moves with it, so that the two must agree.
    moves_with_mean: ClassVar[bool] = True

    @property
    def times(self) -> Array:
        """Times in s of a run when the rotor meets the field's time steps, shape ``(time,)``."""
        return self.step * np.arange(self.count) - self.delay

    @abstractmethod
    def blocks(self) -> Iterator[Array]:
        """Longitudinal wind in m/s in parts of shape ``(time, z, y)``, `BLOCK` steps each."""

    def at_hub(self, height: float) -> Self:
        """The same field seen from a hub at another height in m than the field states.

        Raises
        ------
        DfsmError
            It is not within the field.
        """
        low, high = float(self.z[0]), float(self.z[-1])
        if not low < height < high:
            raise DfsmError(
                f"{self.path}: a hub at {height:g} m is not within the field, which covers heights "
                f"of {low:g} to {high:g} m: give the hub's height in m, or another field"
            )
        return replace(self, hub_height=float(height))

    @property
    def reach(self) -> float:
        """Radius in m of the largest disk around the hub that the field covers."""
        hub = self.hub_height
        return float(min(self.y[-1], -self.y[0], self.z[-1] - hub, hub - self.z[0]))


# -- signals of a field -------------------------------------------------------------------------


def disk_wind(field: WindField, radius: float) -> Array:
    """Fit a plane to the longitudinal wind over the rotor disk at every time step.

    Parameters
    ----------
    field
        From `read_turbsim` or `read_mann`.
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
    disk, plane = _plane(field, radius)
    return np.concatenate([u[:, disk] @ plane for u in _blocks(field)])


def field_signals(
    field: WindField, radius: float, harmonics: int = 0, rings: Sequence[float] | None = None
) -> Trajectory:
    """Everything that `with_field_wind` adds, in one pass over the field.

    Parameters
    ----------
    field, radius, harmonics, rings
        See `with_field_wind`.

    Returns
    -------
    Trajectory
        At the field's own time steps, in the time of the run that it drove; the last channel,
        ``hub``, is the wind at the hub.

    Raises
    ------
    DfsmError
        The disk or a ring reaches beyond the field, a number makes no sense, or the mean over the
        disk is more than a quarter from what the field states.

    Warns
    -----
    DfsmWarning
        They differ by more than shear and chance make.
    """
    if not 0 <= harmonics < _AROUND // 2:
        raise DfsmError(f"{harmonics} harmonics were asked for, expected 0 to {_AROUND // 2 - 1}")
    disk, plane = _plane(field, radius)
    hub = bilinear_weights(field.y, field.z, np.zeros(1), np.full(1, field.hub_height)).T
    names = [*PLANE]
    fourier = np.empty((len(hub), 0))
    if harmonics:
        radii = ring_radii(radius) if rings is None else rings
        names += harmonic_names(radii, harmonics)
        fourier = _ring_weights(field, radii, harmonics)
    parts = []
    for u in _blocks(field):
        over = u[:, disk]
        columns = [over @ plane, u @ fourier]
        if harmonics:
            columns += [over.mean(axis=1, keepdims=True), np.cbrt((over**3).mean(axis=1))[:, None]]
        parts.append(np.concatenate([*columns, u @ hub], axis=1))
    channels = tuple(Channel(n, "m/s", role="disturbance") for n in (*names, "hub"))
    values = np.concatenate(parts)
    if field.moves_with_mean:
        _check_mean(field, float(values[:, 0].mean()))
    return Trajectory(field.times, values, channels, field.path.stem, str(field.path))


def _check_mean(field: WindField, mean: float) -> None:
    stated = field.mean_wind
    if not abs(mean - stated) <= _OTHER_MEAN * stated:
        raise DfsmError(
            f"{field.path}: the wind over the disk is {mean:.4g} m/s on average, the field states "
            f"{stated:.4g} m/s and moves with it: give the field with its mean in it"
        )
    if abs(mean - stated) > _SAME_MEAN * stated:
        warnings.warn(
            f"{field.path}: the wind over the disk is {mean:.5g} m/s on average, the field states "
            f"{stated:.5g} m/s: the wind is taken as it is, and moves as stated",
            DfsmWarning,
            stacklevel=3,
        )


def ring_radii(radius: float) -> tuple[float, ...]:
    """Radii in m of the rings over a rotor, whole metres unless it is a small one."""
    return tuple(round(r * radius, 0 if radius >= 20 else 2) for r in RINGS)


def harmonic_names(rings: Sequence[float], harmonics: int) -> list[str]:
    """Names of the harmonics, as ``C2_r036`` for cos 2α on 36 m, with those of the disk.

    Parameters
    ----------
    rings
        Radii in m.
    harmonics
        How often the highest one goes up and down around a ring.
    """
    around = [f"{part}{n}" for n in range(1, harmonics + 1) for part in "CS"]
    return [ring_channel(part, r) for r in rings for part in ("U", *around)] + [*DISK]


def ring_channel(part: str, ring: float) -> str:
    """Name of the average ``U``, or of ``C2``, ``S2``, … over a ring of some radius in m."""
    return f"{part}_r{ring:03g}"


def _blocks(field: WindField) -> Iterator[Array]:
    """The field's blocks as ``(time, point)``, with a bar where progress is shown."""
    total = -(-field.count // BLOCK)
    for u in track(field.blocks(), "Reading the wind field", total):
        yield u.reshape(len(u), -1)


def _plane(field: WindField, radius: float) -> tuple[NDArray[np.bool_], Array]:
    """Which points lie on the disk, and the weights ``(point, 3)`` that fit a plane to them."""
    if not (np.isfinite(radius) and radius > 0):
        raise DfsmError(f"the rotor radius is {radius} m, expected a positive number")
    if radius > field.reach * (1 + 1e-6):
        raise DfsmError(
            f"{field.path}: a rotor of radius {radius:g} m reaches beyond the field, which covers "
            f"{field.reach:.4g} m around the hub: give the radius in m, or another field"
        )
    height, side = np.meshgrid(
        (field.z - field.hub_height) / radius, field.y / radius, indexing="ij"
    )
    disk = np.hypot(height, side).ravel() <= 1 + 1e-9
    if disk.sum() < _FEWEST_POINTS:
        raise DfsmError(
            f"{field.path}: only {disk.sum()} grid points lie on a rotor of radius {radius:g} m, "
            f"at least {_FEWEST_POINTS} are needed: use a finer field"
        )
    terms = np.column_stack([np.ones(disk.sum()), height.ravel()[disk], side.ravel()[disk]])
    return disk, np.linalg.pinv(terms).T


def _ring_weights(field: WindField, rings: Sequence[float], harmonics: int) -> Array:
    """Weights ``(point, coefficient)``: samples around each ring, then their Fourier sums."""
    names = [f"{r:03g}" for r in rings]
    if not rings or not all(np.isfinite(r) and r > 0 for r in rings) or len({*names}) < len(names):
        raise DfsmError(
            f"the rings have radii of {', '.join(f'{r:g}' for r in rings) or 'nothing'} m, "
            "expected different positive numbers"
        )
    if max(rings) > field.reach * (1 + 1e-6):
        raise DfsmError(
            f"{field.path}: a ring of radius {max(rings):g} m reaches beyond the field, which "
            f"covers {field.reach:.4g} m around the hub: give smaller radii in m, or another field"
        )
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    terms = [np.full(_AROUND, 1 / _AROUND)]
    for n in range(1, harmonics + 1):
        terms += [np.cos(n * angle) * 2 / _AROUND, np.sin(n * angle) * 2 / _AROUND]
    weights = []
    for r in rings:
        y, z = r * np.sin(angle), field.hub_height + r * np.cos(angle)
        weights.append(np.stack(terms) @ bilinear_weights(field.y, field.z, y, z))
    return np.concatenate(weights).T


# -- signals of a run ---------------------------------------------------------------------------


def with_field_wind(
    run: Trajectory,
    field: WindField,
    radius: float,
    harmonics: int = 0,
    rings: Sequence[float] | None = None,
) -> Trajectory:
    """Add what a rotor feels of a wind field to a run that the field drove.

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
    harmonics
        Highest azimuthal harmonic over rings; 0 leaves harmonics out.
    rings
        Radii of the rings in m; default six from an eighth of the rotor radius to 29/30.

    Returns
    -------
    Trajectory
        The run with the channels ``RotWind``, ``RotShearV`` and ``RotShearH`` in m/s appended.
        With harmonics also ``U_r036``, ``C1_r036``, ``S1_r036``, … for every ring (here of 36 m),
        the mean over the disk ``U_disk``, and ``U_cubic``, the cube root of the mean cube.

    Raises
    ------
    DfsmError
        The run has one of the channels already, lasts longer than the field, or holds another
        wind at the hub (``Wind1VelX``); see `field_signals`.
    """
    return with_signals(run, field, field_signals(field, radius, harmonics, rings))


def with_signals(run: Trajectory, field: WindField, signals: Trajectory) -> Trajectory:
    """Add what `field_signals` made of the field that drove a run, see `with_field_wind`."""
    channels = signals.channels[:-1]
    _check_new(run, [c.name for c in channels])
    mesh, values, time = signals.time, signals.values, run.time
    if field.periodic:
        period = field.count * field.step
        mesh, values = np.append(mesh, mesh[0] + period), np.concatenate([values, values[:1]])
        time = mesh[0] + (time - mesh[0]) % period
    slack = 1e-9 * (mesh[-1] - mesh[0])
    if time.max() > mesh[-1] + slack or time.min() < mesh[0] - slack:
        raise DfsmError(
            f"{run.where} covers {run.time[0]:g} to {run.time[-1]:g} s, but {field.path} only "
            f"{mesh[0]:.4g} to {mesh[-1]:.4g} s of it: cut the run, or give the field that drove it"
        )
    *new, hub = (np.interp(time, mesh, v) for v in values.T)
    if "Wind1VelX" in run:
        _check_same(run, "Wind1VelX", hub, f"the wind at the hub in {field.path}", _SAME)
    return run.with_channels(channels, np.stack(new, axis=1))


def with_harmonics(run: Trajectory, harmonics: Trajectory) -> Trajectory:
    """Join harmonics that lie in a file of their own to the run that their field drove.

    Parameters
    ----------
    run
        Any run with ``RotWind`` or ``Wind1VelX``, which tell whether the two belong together.
    harmonics
        Channels as `with_field_wind` names them, ``U_disk`` and a ring among them, on any mesh in
        the time of the run; linear between its samples.

    Returns
    -------
    Trajectory
        The run with the channels of `harmonics` appended.

    Raises
    ------
    DfsmError
        The run lasts longer, has one of the channels already, or had another wind: its ``RotWind``
        has a correlation below 0.9 with ``U_disk``, or, without that, its ``Wind1VelX`` one below
        0.65 with the innermost ring.
    """
    _check_new(run, harmonics.names)
    ring = _innermost(harmonics)
    mesh = harmonics.time
    slack = 1e-6 * harmonics.duration  # times in single precision
    if run.time[0] < mesh[0] - slack or run.time[-1] > mesh[-1] + slack:
        raise DfsmError(
            f"{run.where} covers {run.time[0]:g} to {run.time[-1]:g} s, but {harmonics.where} only "
            f"{mesh[0]:g} to {mesh[-1]:g} s: cut the run, or give the "
            "harmonics of its field"
        )
    values = np.stack([np.interp(run.time, mesh, v) for v in harmonics.values.T], axis=1)
    pairs = (("RotWind", "U_disk", _SAME), ("Wind1VelX", ring, _POINT_AND_RING))
    pair = next((p for p in pairs if p[0] in run), None)
    if pair is None:
        raise DfsmError(
            f"{run.where}: neither RotWind nor Wind1VelX is there, so that nothing tells whether "
            f"{harmonics.where} is of its field: read the run with one of them"
        )
    known, name, least = pair
    _check_same(
        run, known, values[:, harmonics.column(name)], f"{name} in {harmonics.where}", least
    )
    channels = [replace(c, role="disturbance") for c in harmonics.channels]
    return run.with_channels(channels, values)


def _innermost(harmonics: Trajectory) -> str:
    """Name of the average over the innermost ring."""
    rings = {float(m[1]): m[0] for m in map(_RING.fullmatch, harmonics.names) if m is not None}
    if not rings or "U_disk" not in harmonics:
        raise DfsmError(
            f"{harmonics.where} holds {labels(harmonics.channels)}, expected harmonics over rings "
            "(U_disk, U_r036, C1_r036, …): give the file that dfsm wind made of a field"
        )
    return rings[min(rings)]


def _check_new(run: Trajectory, names: Sequence[str]) -> None:
    there = [name for name in names if name in run]
    if there:
        raise DfsmError(f"{run.where}: channel '{there[0]}' exists already: nothing was added")


def _check_same(run: Trajectory, name: str, wind: Array, what: str, least: float) -> None:
    """Refuse a wind that has nothing to do with a run's; one that stays constant tells nothing."""
    a, b = run[name] - run[name].mean(), wind - wind.mean()
    steady = 1e-6 * max(1.0, float(np.abs(run[name]).max()))
    if max(np.abs(a).max(), np.abs(b).max()) <= steady:
        return
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    alike = float(a @ b) / size if size > 0 else 0.0
    if not alike >= least:
        raise DfsmError(
            f"{run.where}: the correlation of {name} with {what} is {alike:.2f}, at least "
            f"{least:g} was expected: give what belongs to the field that drove the run"
        )

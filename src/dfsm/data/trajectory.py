"""Trajectory: named channels with units on one time mesh.

Everything that enters the package becomes a `Trajectory` and everything that leaves it is one.
Arrays are ``(time, channel)``; stacked over runs they are ``(sample, channel)``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dfsm.core.drawing import Drawn
from dfsm.core.types import Array
from dfsm.data.channel import Channel, Role, labels
from dfsm.errors import DfsmError, missing, printable
from dfsm.numerics.time_mesh import instants_apart, own_interval, time_step

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr  # pyright: ignore[reportMissingImports]

__all__ = ["Channel", "Role", "Trajectory", "labels"]


@dataclass(frozen=True, eq=False)
class Trajectory(Drawn):
    """One simulation: channels sampled on one strictly increasing time mesh.

    Attributes
    ----------
    time
        Time mesh in s, shape ``(time,)``; it need not be equidistant.
    values
        Samples, shape ``(time, channel)``, in the channels' units.
    channels
        One `Channel` per column.
    name
        Short name of the run, for tables and reports.
    source
        The file it was read from, if any.
    wall_time
        Seconds the simulator took to produce the span held here, if known.
    notes
        What a reader had to leave out or change, one sentence each.

    Raises
    ------
    DfsmError
        Shapes that disagree, duplicated channel names, or a time mesh that does not increase.
    """

    time: Array
    values: Array
    channels: tuple[Channel, ...]
    name: str = "run"
    source: str | None = None
    wall_time: float | None = None
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        time = np.array(self.time, dtype=np.float64)
        values = np.array(self.values, dtype=np.float64)
        if time.ndim != 1 or values.shape != (len(time), len(self.channels)):
            raise DfsmError(
                f"{self.where}: time {time.shape} and values {values.shape} do not fit "
                f"{len(self.channels)} channels; expected (time,) and (time, channel)"
            )
        if len(time) < 2:
            raise DfsmError(f"{self.where}: {len(time)} samples, at least 2 are needed")
        time = instants_apart(time, values)
        _check_time(time, self.where)
        counts: dict[str, int] = {}
        for c in self.channels:
            counts[c.name] = counts.get(c.name, 0) + 1
        twice = [name for name, n in counts.items() if n > 1]
        if twice:
            raise DfsmError(f"{self.where}: channel '{twice[0]}' stands there twice: rename one")
        time.flags.writeable = False
        values.flags.writeable = False
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "channels", tuple(self.channels))

    # -- access ---------------------------------------------------------------------------------

    @property
    def where(self) -> str:
        """The file, or else the name: how messages refer to this run."""
        return self.source or self.name

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names in column order."""
        return tuple(c.name for c in self.channels)

    @property
    def duration(self) -> float:
        """Last time minus first time, in s."""
        return float(self.time[-1] - self.time[0])

    @cached_property
    def time_step(self) -> float | None:
        """Sampling interval in s if the mesh is equidistant to rounding, else None."""
        return time_step(self.time)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        every = "irregular" if self.time_step is None else f"every {self.time_step:g} s"
        return (
            f"<Trajectory {printable(self.name)}: {len(self)} samples, {self.time[0]:g} to "
            f"{self.time[-1]:g} s, {every}; {len(self.channels)} channels: {labels(self.channels)}>"
        )

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def __getitem__(self, name: str) -> Array:
        """Return the samples of one channel, shape ``(time,)``."""
        return self.values[:, self.column(name)]

    def column(self, name: str) -> int:
        """Column of a channel.

        Raises
        ------
        DfsmError
            No such channel; the message names the file and suggests near names.
        """
        return self.columns([name])[0]

    def columns(self, names: Iterable[str]) -> list[int]:
        """Columns of several channels.

        Raises
        ------
        DfsmError
            Names all channels that are missing, as `column` does one.
        """
        names = list(names)
        if lost := [n for n in dict.fromkeys(names) if n not in self._columns]:
            raise DfsmError(f"{self.where}: {missing(lost, self.names)}")
        return [self._columns[n] for n in names]

    def channel(self, name: str) -> Channel:
        """Return the description of one channel."""
        return self.channels[self.column(name)]

    @cached_property
    def _columns(self) -> Mapping[str, int]:
        return {c.name: i for i, c in enumerate(self.channels)}

    @cached_property
    def digest(self) -> str:
        """SHA-256 of time, values, names and units: what the run holds, not where it lay.

        Of what was recorded, if anything was: computed channels differ in the last digits from one
        processor to the next, and runs must have the same order on all.
        """
        recorded = [i for i, c in enumerate(self.channels) if not c.computed]
        columns = recorded or list(range(len(self.channels)))
        h = hashlib.sha256()
        h.update(np.ascontiguousarray(self.time).tobytes())
        h.update(np.ascontiguousarray(self.values[:, columns]).tobytes())
        names = (f"{self.channels[i].name}\0{self.channels[i].unit}" for i in columns)
        h.update("\0".join(names).encode())
        return h.hexdigest()

    # -- new trajectories from old --------------------------------------------------------------

    def select(self, names: Iterable[str]) -> Trajectory:
        """Keep the named channels, in this order."""
        columns = self.columns(names)
        channels = tuple(self.channels[i] for i in columns)
        if columns == list(range(len(self.channels))):
            return self._part(channels=channels)  # all of them: they need no second place
        # The constructor tells a name that is twice among them.
        make = self._part if len(set(columns)) == len(columns) else partial(replace, self)
        return make(values=self.values[:, columns], channels=channels)

    def window(self, start: float | None = None, stop: float | None = None) -> Trajectory:
        """Keep ``start <= time <= stop``; the recorded wall time shrinks in proportion.

        Parameters
        ----------
        start, stop
            Times in s; None leaves that end open.

        Raises
        ------
        DfsmError
            Fewer than two samples remain.
        """
        slack = 1e-9 * self.duration
        lo = -np.inf if start is None else start - slack
        hi = np.inf if stop is None else stop + slack
        if start is not None and stop is not None and start >= stop:
            raise DfsmError(f"the time window goes from {start:g} s to {stop:g} s: swap the two")
        first, end = np.searchsorted(self.time, lo), np.searchsorted(self.time, hi, "right")
        if end - first < 2:
            raise DfsmError(
                f"{self.where}: runs from {self.time[0]:g} s to {self.time[-1]:g} s, shorter than "
                f"the time window asked for ({start if start is not None else '…'} to "
                f"{stop if stop is not None else '…'} s): change the window or leave the run out"
            )
        time, values = self.time[first:end], self.values[first:end]
        if 2 * len(time) < len(self):  # a small part must not keep all of a run in memory
            time, values = time.copy(), values.copy(order="K")
        wall = self.wall_time and self.wall_time * (float(time[-1] - time[0]) / self.duration)
        return self._part(time=time, values=values, wall_time=wall)

    def on_time_of(self, other: Trajectory) -> Trajectory:
        """Share the other's array of times where both are equal: many runs then hold one."""
        return self._part(time=other.time) if np.array_equal(self.time, other.time) else self

    def _part(self, **changes: Any) -> Trajectory:
        """Replace fields by parts of what is here, neither copied nor checked once more."""
        part: Trajectory = object.__new__(type(self))
        for f in dataclasses.fields(self):
            value = changes.get(f.name, getattr(self, f.name))
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(part, f.name, value)
        return part

    def with_channels(
        self,
        channels: Sequence[Channel | str] | Channel | str,
        values: ArrayLike,
        *,
        replace: bool = False,
    ) -> Trajectory:
        """Append channels, or put others in the place of those that the run has.

        Parameters
        ----------
        channels
            Channels, or names: a channel of the run then keeps its unit and role.
        values
            Samples, shape ``(time, len(channels))``, or one number for all times.
        replace
            Whether channels that the run has are replaced; they are refused otherwise.

        Raises
        ------
        DfsmError
            Another shape, what is no channel or number, or a name that is taken.
        """
        added = _described(self, channels)
        taken = [c.name for c in added if c.name in self]
        if taken and not replace:
            raise DfsmError(
                f"{self.where}: channel '{taken[0]}' stands there twice: rename one, or replace "
                "it with replace=True"
            )
        values = np.concatenate([self.values, _samples(self, values, added)], axis=1)
        every = (*self.channels, *added)
        columns = list(range(len(every)))
        if taken:  # a name keeps its first place and takes its last column
            columns = list({c.name: i for i, c in enumerate(every)}.values())
            values = values[:, columns]
        return dataclasses.replace(self, values=values, channels=tuple(every[i] for i in columns))

    def with_roles(self, roles: Mapping[str, Role]) -> Trajectory:
        """Set the roles of the named channels; the others keep theirs."""
        self.columns(roles)
        channels = tuple(replace(c, role=roles.get(c.name, c.role)) for c in self.channels)
        return self._part(channels=channels)

    def require_finite(self) -> Trajectory:
        """Return self, or fail on the first NaN or Inf.

        Raises
        ------
        DfsmError
            Names the channel, the count and the first time.
        """
        bad = ~np.isfinite(self.values)
        if bad.any():
            column = int(np.flatnonzero(bad.any(axis=0))[0])
            rows = np.flatnonzero(bad[:, column])
            interval = own_interval(self.time, ~bad[:, column])
            if interval is not None:
                name = self.names[column]
                raise DfsmError(
                    f"{self.where}: channel '{name}' has one sample every {interval:g} s, fewer "
                    "than its table has rows: say what it does in between with data.slower: "
                    f"{{{name}: hold}} or linear (in Python: FitSettings.slower, fill_slower)"
                )
            raise DfsmError(
                f"{self.where}: channel '{self.names[column]}' has {len(rows)} NaN or infinite "
                f"samples, the first at {self.time[rows[0]]:g} s: leave the channel or that part "
                "of the run out"
            )
        return self

    def resample(self, time: ArrayLike) -> Trajectory:
        """Interpolate linearly onto another mesh inside this one's span.

        Raises
        ------
        DfsmError
            The mesh reaches outside this run's span, or does not increase.
        """
        time = np.asarray(time, dtype=np.float64)
        slack = 1e-9 * self.duration
        if time.size and not (
            time.min() >= self.time[0] - slack and time.max() <= self.time[-1] + slack
        ):
            raise DfsmError(
                f"{self.where}: runs from {self.time[0]:g} s to {self.time[-1]:g} s, but samples "
                f"from {time.min():g} s to {time.max():g} s were asked for: stay inside the run"
            )
        values = np.stack([np.interp(time, self.time, v) for v in self.values.T], axis=1)
        return replace(self, time=time, values=values)

    # -- pandas and xarray ----------------------------------------------------------------------

    def to_pandas(self) -> pd.DataFrame:
        """Return a table indexed by time; units are in ``frame.attrs['units']``."""
        import pandas as pd

        frame = pd.DataFrame(
            self.values, index=pd.Index(self.time, name="Time"), columns=list(self.names)
        )
        frame.attrs["units"] = {c.name: c.unit for c in self.channels}
        return frame

    @classmethod
    def from_pandas(
        cls,
        frame: pd.DataFrame,
        units: Mapping[str, str] | None = None,
        *,
        name: str = "run",
        source: str | None = None,
    ) -> Trajectory:
        """Build a trajectory from a table indexed by time in s.

        Parameters
        ----------
        frame
            One column per channel; the index is time.
        units
            Unit per column; default ``frame.attrs['units']``, and no unit where neither says.
        name, source
            See `Trajectory`.

        Raises
        ------
        DfsmError
            There is no column, or a column or the index is not numeric.
        """
        from dfsm.data.frames import from_pandas

        return from_pandas(frame, units, name, source)

    def to_xarray(self) -> xr.Dataset:
        """Return a dataset of one variable per channel over ``time``, with units and roles.

        Raises
        ------
        DfsmError
            xarray is not installed, or a channel is called "time".
        """
        from dfsm.data.frames import to_xarray

        return to_xarray(self)

    @classmethod
    def from_xarray(
        cls,
        data: xr.Dataset | xr.DataArray,
        *,
        time: str | None = None,
        name: str | None = None,
        source: str | None = None,
    ) -> Trajectory:
        """Build a trajectory from variables over time, or an array over time and channels.

        Parameters
        ----------
        data
            Attribute ``units`` gives the unit of each variable; a variable without dimension is
            constant. The time is in s, or of dates, which count from the first.
        time
            Dimension that is the time; None takes the only one, or "time" where there are more.
        name, source
            See `Trajectory`; None takes those of the dataset's attributes.

        Raises
        ------
        DfsmError
            xarray is not installed, a variable has other dimensions or is not numeric, or the
            times are not known.
        """
        from dfsm.data.frames import from_xarray

        return from_xarray(data, time, name, source)


def _described(run: Trajectory, channels: Sequence[Channel | str] | Channel | str) -> list[Channel]:
    listed = [channels] if isinstance(channels, Channel | str) else list(channels)
    for c in listed:
        if not isinstance(c, Channel | str):
            raise DfsmError(f"{run.where}: {c!r} is no channel: give a Channel, or its name")
    names = [c if isinstance(c, str) else c.name for c in listed]
    # New samples do not lie on the grid of those that a file held.
    known = {n: replace(run.channel(n), step=None) for n in names if n in run}
    return [known.get(c, Channel(c)) if isinstance(c, str) else c for c in listed]


def _samples(run: Trajectory, values: ArrayLike, channels: Sequence[Channel]) -> Array:
    """Samples of some channels, ``(time, channel)``."""
    shape, told = (len(run), len(channels)), ", ".join(c.name for c in channels)
    try:
        samples = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise DfsmError(
            f"{run.where}: the samples of {told} are no numbers: give numbers"
        ) from None
    if samples.ndim and samples.size != shape[0] * shape[1]:
        raise DfsmError(
            f"{run.where}: the samples of {told} have shape {samples.shape}, expected {shape}, or "
            "one number"
        )
    return samples.reshape(shape) if samples.ndim else np.full(shape, samples)


def _check_time(time: Array, where: str) -> None:
    if not np.isfinite(time).all():
        row = int(np.flatnonzero(~np.isfinite(time))[0])
        raise DfsmError(f"{where}: time is not a finite number in sample {row}")
    steps = np.diff(time)
    if (steps <= 0).any():
        row = int(np.flatnonzero(steps <= 0)[0]) + 1
        what = "repeats" if math.isclose(time[row], time[row - 1]) else "goes back"
        raise DfsmError(
            f"{where}: time {what} at sample {row} ({time[row - 1]:g} s, then {time[row]:g} s); "
            "a strictly increasing time is needed: sort the file or drop the repeated samples"
        )

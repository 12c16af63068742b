"""Runs as the tables of pandas and the datasets of xarray, and back; `Trajectory` calls these."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from dfsm.core.types import Array
from dfsm.data.channel import Channel, Role
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_TIME = "time"
_SECONDS = ("", "s", "sec", "second", "seconds")
# Attributes of a variable that say what a `Channel` says; "units" is the name that others use.
_UNITS, _STEP, _ROLE, _COMPUTED = "units", "quantization_step", "role", "computed"


def from_pandas(
    frame: pd.DataFrame, units: Mapping[str, str] | None, name: str, source: str | None
) -> Trajectory:
    """Build a trajectory; see `Trajectory.from_pandas`."""
    known: Mapping[str, str] = frame.attrs.get("units", {}) if units is None else units
    where = source or name
    columns = []
    if not len(frame.columns):
        raise DfsmError(f"{where}: the table has no column besides its index, expected channels")
    # By position: a name that stands twice is told by the constructor below.
    for i, column in enumerate(frame.columns):
        try:
            columns.append(frame.iloc[:, i].to_numpy(dtype=np.float64))
        except (TypeError, ValueError) as error:
            raise DfsmError(f"{where}: column '{column}' is not numeric ({error})") from None
    try:
        time = frame.index.to_numpy(dtype=np.float64)
    except (TypeError, ValueError):
        raise DfsmError(f"{where}: the index is not time in s; set it to the time") from None
    channels = tuple(Channel(str(c), known.get(str(c), "")) for c in frame.columns)
    return Trajectory(time, np.stack(columns, axis=1), channels, name=name, source=source)


# -- xarray ---------------------------------------------------------------------------------------


def to_xarray(run: Trajectory) -> xr.Dataset:
    """Return a dataset; see `Trajectory.to_xarray`."""
    xr = _xarray()
    taken = [c.name for c in run.channels if c.name == _TIME]
    if taken:
        raise DfsmError(
            f"{run.where}: channel '{_TIME}' has the name that xarray needs for the time: rename it"
        )
    data = {c.name: (_TIME, v, _attributes(c)) for c, v in zip(run.channels, run.values.T)}  # noqa: B905
    time = (_TIME, run.time, {_UNITS: "s"})
    about = {"source": run.source, "wall_time": run.wall_time, "notes": list(run.notes) or None}
    known = {k: v for k, v in about.items() if v is not None}
    return xr.Dataset(data, {_TIME: time}, {"name": run.name, **known})


def _attributes(channel: Channel) -> dict[str, Any]:
    """What is known of a channel; a file format of xarray's has no None."""
    told = {_UNITS: channel.unit, _STEP: channel.step, _ROLE: channel.role}
    told[_COMPUTED] = int(channel.computed) or None
    return {key: value for key, value in told.items() if value is not None}


def from_xarray(
    data: xr.Dataset | xr.DataArray, time: str | None, name: str | None, source: str | None
) -> Trajectory:
    """Build a trajectory; see `Trajectory.from_xarray`."""
    xr = _xarray()
    if not isinstance(data, xr.Dataset | xr.DataArray):
        raise DfsmError(f"a {type(data).__name__} came, expected a dataset or an array of xarray")
    name = str(data.attrs.get("name", "run")) if name is None else name
    source = data.attrs.get("source") if source is None else source
    where = source or name
    about, variables = data.attrs, _variables(data, where)
    dimension = _dimension(variables, time, where)
    columns, channels = [], []
    for key, variable in variables.items():
        if variable.dims not in ((dimension,), ()):
            raise DfsmError(
                f"{where}: '{key}' is an array over {', '.join(map(str, variable.dims))}, expected "
                f"one over '{dimension}' alone: choose with .sel() or .isel(), or leave it out"
            )
        try:
            values = np.asarray(variable.values, dtype=np.float64)
        except (TypeError, ValueError):
            raise DfsmError(f"{where}: '{key}' is not numeric: leave it out") from None
        columns.append(np.broadcast_to(values, (data.sizes[dimension],)))
        channels.append(_channel(str(key), variable.attrs))
    wall_time, notes = about.get("wall_time"), about.get("notes", ())
    return Trajectory(
        _seconds(data, dimension, where),
        np.stack(columns, axis=1),
        tuple(channels),
        name=name,
        source=source,
        wall_time=None if wall_time is None else float(wall_time),
        notes=(notes,) if isinstance(notes, str) else tuple(map(str, notes)),
    )


def _variables(data: Any, where: str) -> dict[Any, Any]:
    """Arrays by name: those of a dataset, or the columns of one array over time and channels."""
    if hasattr(data, "data_vars"):
        variables = dict(data.data_vars)
    elif data.ndim == 2 and any(data[d].dtype.kind in "OUT" for d in data.dims if d in data.coords):
        along = next(d for d in data.dims if d in data.coords and data[d].dtype.kind in "OUT")
        variables = {str(k): data.sel({along: k}) for k in data[along].values}
    elif data.ndim == 1:
        variables = {data.name or "value": data}
    else:
        raise DfsmError(
            f"{where}: an array over {', '.join(map(str, data.dims))} came, expected one over time "
            "and named channels, or a dataset"
        )
    if not variables:
        raise DfsmError(f"{where}: the dataset has no variable, expected channels")
    return variables


def _dimension(variables: Mapping[Any, Any], time: str | None, where: str) -> Any:
    """The dimension that is the time."""
    dimensions = dict.fromkeys(d for v in variables.values() for d in v.dims)
    if time is not None:
        if time not in dimensions:
            known = ", ".join(map(str, dimensions))
            raise DfsmError(f"{where}: no dimension '{time}'; known are: {known}")
        return time
    if len(dimensions) == 1:
        return next(iter(dimensions))
    if _TIME in dimensions:
        return _TIME
    raise DfsmError(
        f"{where}: the dimensions are {', '.join(map(str, dimensions)) or 'none'}, so it is not "
        "clear which is the time: name it with time="
    )


def _seconds(data: Any, dimension: Any, where: str) -> Array:
    """The time in s; dates count from the first of them."""
    if dimension not in data.coords:
        raise DfsmError(
            f"{where}: dimension '{dimension}' has no coordinate, so the times are not known: "
            "assign it times in s"
        )
    time = data.coords[dimension]
    values = time.values
    if values.dtype.kind in "mM":
        start = values[0] if values.dtype.kind == "M" else np.timedelta64(0, "ns")
        return (values - start) / np.timedelta64(1, "ns") * 1e-9
    unit = str(time.attrs.get(_UNITS, "s"))
    if values.dtype.kind not in "iuf" or unit not in _SECONDS:
        raise DfsmError(
            f"{where}: coordinate '{dimension}' is in '{unit}', expected times in s, or dates"
        )
    return values.astype(np.float64)


def _channel(name: str, attributes: Mapping[Any, Any]) -> Channel:
    unit = attributes.get(_UNITS, attributes.get("unit", ""))
    step, role = attributes.get(_STEP), attributes.get(_ROLE)
    number = isinstance(step, int | float | np.number) and math.isfinite(step) and step > 0
    return Channel(
        name,
        str(unit),
        step=float(step) if number else None,  # pyright: ignore[reportArgumentType]
        role=role if role in get_args(Role) else None,
        computed=bool(attributes.get(_COMPUTED, False)),
    )


def _xarray() -> Any:
    try:
        import xarray
    except ImportError:
        raise DfsmError("this needs xarray: pip install 'dfsm[xarray]'") from None
    return xarray

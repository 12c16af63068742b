"""Runs to xarray and back."""

from __future__ import annotations

import numpy as np
import pytest

from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

xr = pytest.importorskip("xarray")
TIME = np.array([0.0, 0.5, 1.5])
CHANNELS = (
    Channel("GenSpeed", "rpm", step=0.01, role="state"),
    Channel("power", "kW", computed=True),
)
RUN = Trajectory(
    TIME, np.arange(6.0).reshape(3, 2), CHANNELS, name="r", source="a.outb", wall_time=3.5,
    notes=("one", "two"),
)  # fmt: skip


def test_a_run_comes_back_as_it_went():
    data = RUN.to_xarray()
    assert data["GenSpeed"].dims == ("time",)
    assert data["GenSpeed"].attrs["units"] == "rpm"
    np.testing.assert_array_equal(data["power"].sel(time=0.5), 3.0)
    back = Trajectory.from_xarray(data)
    assert back.digest == RUN.digest
    assert back.channels == CHANNELS
    same = ("name", "source", "wall_time", "notes")
    assert [getattr(back, k) for k in same] == [getattr(RUN, k) for k in same]


def test_other_peoples_datasets_are_read():
    table = xr.DataArray(
        np.arange(6.0).reshape(3, 2),
        {"t": np.array([0, 500, 1500], "timedelta64[ms]"), "signal": ["a", "b"]},
        ("t", "signal"),
    )
    run = Trajectory.from_xarray(table, name="mine")
    assert run.names == ("a", "b")
    np.testing.assert_allclose(run.time, TIME)
    np.testing.assert_array_equal(run["b"], [1, 3, 5])
    dates = np.datetime64("2024-01-01T12:00:00") + np.array([0, 1, 2], "timedelta64[s]")
    mixed = xr.Dataset({"u": ("when", [1, 2, 3]), "mass": ((), 5.0)}, {"when": dates})
    run = Trajectory.from_xarray(mixed)
    np.testing.assert_allclose(run.time, [0, 1, 2])
    np.testing.assert_array_equal(run["mass"], [5, 5, 5])


def test_what_is_no_run_is_refused_in_a_sentence():
    def refused(data, told, **how):
        with pytest.raises(DfsmError, match=told):
            Trajectory.from_xarray(data, **how)

    field = xr.Dataset({"w": (("time", "x"), np.ones((3, 2)))}, {"time": TIME})
    refused(field, "'w' is an array over time, x, expected one over 'time' alone: choose with")
    refused(field.rename(time="t"), "the dimensions are t, x, so it is not clear which is the time")
    refused(field, "no dimension 'y'; known are: time, x", time="y")
    refused(xr.Dataset({"u": ("time", [1.0, 2])}), "'time' has no coordinate")
    refused(xr.Dataset({"u": ("time", ["a", "b"])}, {"time": [0, 1]}), "'u' is not numeric")
    minutes = xr.Dataset({"u": ("time", [1.0, 2])}, {"time": ("time", [0, 1], {"units": "min"})})
    refused(minutes, "is in 'min', expected times in s, or dates")
    refused(xr.Dataset(), "no variable")
    refused({"u": 1}, "a dict came, expected a dataset or an array of xarray")
    with pytest.raises(DfsmError, match="'time' has the name that xarray needs"):
        Trajectory(TIME, TIME[:, None], (Channel("time"),)).to_xarray()

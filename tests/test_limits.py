"""What docs/results/floating-turbine.md says of limits: its data, against their runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

import dfsm
from benchmarks import limits, matched, scheduled, turbine_tables
from benchmarks.accuracy import bundled, demo

ROOT = Path(__file__).parents[1]


def test_the_thrust_is_that_of_the_run():
    run = dfsm.read(bundled().DATA / "iea15_2dof_12mps_s09.outb")
    others = [n for n in run.names if n != limits.THRUST.name]
    (given,) = limits.with_thrust([run.select(others)])
    thrust = run.channel(limits.THRUST.name)
    assert given.channel(limits.THRUST.name).unit == thrust.unit
    np.testing.assert_allclose(given[limits.THRUST.name], run[limits.THRUST.name], rtol=1e-12)
    # A run that has the channel is left alone.
    assert limits.with_thrust([run])[0] is run


def test_the_field_averages_to_the_wind_of_its_run():
    field = dfsm.read(limits.DATA / "field.parquet")
    run = bundled().runs(["12"], range(8, 9))[0].window(50.0, 650.0)
    field = field.resample(run.time)
    # Rings weighted with their areas make up the disk.
    disk = (field["ring to 40 m"] + 3 * field["ring to 80 m"] + 5 * field["ring to 120 m"]) / 9
    assert np.corrcoef(disk, run["RotWind"])[0, 1] > 0.999
    assert np.std(disk - run["RotWind"]) < 0.05
    # A shift of a second would show.
    late = np.interp(run.time - 1.0, run.time, disk)
    assert np.std(late - run["RotWind"]) > 2 * np.std(disk - run["RotWind"])


def test_shares_are_those_of_a_regression():
    rng = np.random.default_rng(0)
    low = butter(4, 0.1, output="sos")
    X = sosfiltfilt(low, rng.normal(size=(4000, 3)), axis=0)
    noise = sosfiltfilt(low, rng.normal(size=4000))
    y = X @ [1.0, -2.0, 0.5] + noise
    expected = 1 - np.var(noise) / np.var(y)
    assert limits._explained(y, X) == pytest.approx(expected, abs=0.05)
    assert limits._explained(X[:, 0], X) == pytest.approx(1.0)


def test_tables_have_a_line_for_everything():
    errors = {"filtered": {"PtfmPitch": 0.12, "PtfmPitch_dot": 0.2, "GenSpeed": 0.19}}
    found = {"runs": 29, "training": 0.04, "validation": 0.09}
    found |= {"closed loop": errors, "perturbed": errors}
    (line,) = turbine_tables.limits_table({"variants": {"8 seeds": found}})[2:]
    assert line == "| 8 seeds | 29 | 0.200, 0.300 | 0.12 | 0.20 | 0.19 | 0.12, 0.19 |"
    shares = {"three signals": 0.05, "whole field": 0.49, "shifted": [0.13, 0.25]}
    (line,) = turbine_tables.field_table({"field": {"speed": shares}})[2:]
    assert line == "| speed | 5 % | 49 % | 13 % (95th percentile: 25 %) |"
    (line,) = turbine_tables.braking_table({"braking": {"LTI": [-5.1e-6, -3.85e-4]}})[2:]
    assert line == "| LTI | −0.5 | −38.5 |"


def test_perturbed_runs_repeat_the_wind_and_waves_of_controlled_ones():
    turbine = bundled()
    runs = [*turbine.runs(["06", "12"], range(1, 5)), *turbine.perturbed(testing=True)[:2]]
    data = dfsm.Dataset(runs)
    groups = data.matched([*demo().settings(5).disturbances])
    pairs = {tuple(sorted(data[k].name for k in group)) for group in groups if len(group) > 1}
    names = ("iea15_2dof_06mps_s02", "iea15_2dof_12mps_s04")
    assert pairs == {(name, f"{name}_ol") for name in names}


def test_differences_of_records_tell_the_inertia():
    turbine = bundled()
    known = scheduled.BRAKING["GenSpeed"]["GenTq"]
    (controlled,) = turbine.runs(["12"], range(4, 5))
    perturbed = turbine.perturbed(testing=True)[1]
    slopes = matched.speed_slopes(turbine, (controlled, perturbed))
    assert slopes["GenTq"] == pytest.approx(known, rel=0.2)
    # Blade pitch brakes, and so does the platform on its way back.
    assert slopes["BldPitch1"] < 0
    assert slopes["PtfmPitch_dot"] < 0
    assert slopes["GenSpeed"] < 0

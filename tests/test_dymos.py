"""Phases of dymos: what is declared, what is refused, and a rollout along a record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dfsm import model_inputs
from dfsm.data.features import Feature
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.models.dfsm import DFSM
from dfsm.simulation.simulate import simulate
from exported import whole
from systems import linear_model

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*:UserWarning:openmdao"),
]
om = pytest.importorskip("openmdao.api")
dm = pytest.importorskip("dymos")
TIME = np.arange(0, 20.05, 0.05)


def hull(kind: str = "rate", source: str = "wave") -> DFSM:
    """A force is chosen, a wave and what is computed of it or of the force are given."""
    A, B = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0] * 3, [1.0, 0.5, 0.8]])
    made = linear_model(A, B, names=["time", "v"], units=["-", "1/s"])
    feature = Feature(source=source, kind=kind, seconds=None if kind == "rate" else 0.5)  # pyright: ignore[reportArgumentType]
    names = ("force", "wave", feature.name)
    units = ("N", "m", "m/s" if kind == "rate" else "N" if source == "force" else "m")
    channels = tuple(Channel(name, unit) for name, unit in zip(names, units, strict=True))
    signals = replace(
        made.signals, controls=channels[:1], disturbances=channels[1:], features=(feature,)
    )
    middle = replace(made.region, mean=made.region.mean + np.arange(1.0, 6.0))
    return replace(made, signals=signals, region=middle)


def problem(phase):
    """The phase alone, a minimum of nothing in 4 s from 10 s on."""
    phase.set_time_options(fix_initial=True, fix_duration=True, units="s")
    phase.add_objective("time", loc="final")
    made, trajectory = om.Problem(reports=False), dm.Trajectory()
    trajectory.add_phase("phase", phase)
    made.model.add_subsystem("all", trajectory)
    made.setup(check=False)
    phase.set_time_val(initial=10.0, duration=4.0)
    return made


def test_what_is_not_given_is_in_the_middle_of_the_training_data(tmp_path, monkeypatch):
    from dfsm.exports.openmdao_component import dymos_phase, variables_of

    monkeypatch.chdir(tmp_path)
    model = hull()
    # dymos keeps some names for its clock.
    assert variables_of(model)["time"] == "time_"
    phase = dymos_phase(model, dm.Radau(num_segments=3))
    made = problem(phase)
    made.run_model()
    middle = dict(zip(("force", "wave", "wave_dot", "time_", "v"), model.region.mean, strict=True))
    for name, value in middle.items():
        found = made.get_val(f"all.phase.timeseries.{name}")
        np.testing.assert_allclose(found, value, err_msg=name)
    told = phase.control_options["wave_dot"]["desc"]
    assert told == "wave_dot (m/s) is the time derivative of wave: supply it"
    rest = whole()
    turning = dymos_phase(rest, dm.Radau(num_segments=2))
    assert turning.parameter_options["mass"]["val"] == pytest.approx(1.5)
    assert not turning.control_options["RotWind"]["opt"]


def test_a_phase_along_a_record_is_the_rollout(tmp_path, monkeypatch):
    from dfsm.exports.openmdao_component import dymos_phase

    monkeypatch.chdir(tmp_path)
    model = hull()
    wave = np.sin(0.6 * TIME)
    values = np.stack([np.cos(0.3 * TIME), wave], axis=1)
    run = Trajectory(TIME, values, (Channel("force", "N"), Channel("wave", "m")))
    phase = dymos_phase(model, dm.Radau(num_segments=8, order=5))
    phase.set_control_options("force", opt=False)
    for name in ("time_", "v"):
        phase.set_state_options(name, fix_initial=True, solve_segments="forward")
    phase.nonlinear_solver = om.NewtonSolver(solve_subsystems=True, iprint=-1)
    phase.linear_solver = om.DirectSolver()
    made = problem(phase)
    taken = model_inputs(model, run, start=10.0, stop=14.0)
    for name in taken.names:
        phase.set_control_val(name, taken[name], time_vals=taken.time)
    phase.set_state_val("time_", [0.5, 0.5])
    phase.set_state_val("v", [0.0, 0.0])
    made.run_model()
    time = made.get_val("all.phase.timeseries.time").ravel()
    with hushed():
        own = simulate(model, run, initial=[0.5, 0.0], start=10.0, stop=14.0).trajectory
    for ours, theirs in (("time", "time_"), ("v", "v")):
        found = made.get_val(f"all.phase.timeseries.{theirs}").ravel()
        np.testing.assert_allclose(found, np.interp(time, own.time, own[ours]), atol=2e-3)


def test_what_a_control_did_before_is_refused():
    from dfsm.exports.openmdao_component import dymos_phase

    told = "'force_delay0.5' is what the control 'force' did some time ago"
    with pytest.raises(DfsmError, match=told):
        dymos_phase(hull("delay", "force"), dm.Radau(num_segments=3))
    assert dymos_phase(hull("delay"), dm.Radau(num_segments=3)) is not None

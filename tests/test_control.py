"""Optimal control: what a problem can hold, what a solution tells, and how it is stored."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from cart import QUICK, TIME, problem, solved, wind
from dfsm.control import (
    DirectTranscription,
    MultipleShooting,
    OptimalControlProblem,
    SingleShooting,
    load_solution,
    save_solution,
)
from dfsm.control.nlp.terms import functions_of
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from systems import linear_model

# -- what a problem can hold --------------------------------------------------------------------


def test_the_controls_do_in_an_integrator_what_the_solution_says():
    found = solved(problem(), DirectTranscription(refine=1e-8), simulate=True)
    (replay,) = found.replays
    assert replay.relative < 1e-6
    assert set(replay.deviation) == {"place", "speed"}
    assert found.linear_quadratic
    assert found.trajectory.channel("force").unit == "N"
    assert [c.role for c in found.trajectory.channels] == [
        "state",
        "state",
        "control",
        "disturbance",
        "parameter",
        "output",
    ]
    power = found.trajectory["force"] * found.trajectory["speed"]
    np.testing.assert_allclose(found.trajectory["power"], power, atol=1e-12)
    for text in ("solved", "objective", "intervals", "mass 2", "the states differ by at most"):
        assert text in found.summary()


def test_problems_on_one_system_have_the_same_functions():
    """Compilations are shared by what is equal."""
    one, other = problem().plant, problem(horizon=(0.0, 4.0)).plant
    assert one is not other
    assert (one.derivative, one.output) == (other.derivative, other.output)
    assert hash(one.derivative) == hash(other.derivative)
    changed = replace(problem().model, f=lambda x, u, w, p: x)
    assert problem(model=changed).plant.derivative != one.derivative


def test_a_coarse_mesh_deviates_in_an_integrator():
    found = solved(problem(), DirectTranscription(scheme="trapezoidal", mesh=5, refine=None))
    again = solved(
        problem(), DirectTranscription(scheme="trapezoidal", mesh=5, refine=None), simulate=True
    )
    assert found.objective == again.objective
    assert again.replays[0].deviation["place"] > 1e-3


@pytest.mark.parametrize("method", [QUICK, DirectTranscription(scheme="radau", refine=None)])
def test_bounds_rates_outputs_and_path_constraints_hold(method):
    free = solved(problem(), method)
    assert free.trajectory["force"].max() > 1.5
    limits = problem(
        bounds={
            "force": (-1.45, 1.45),
            "power": (None, 1.2),
            "speed": (None, lambda t: 1.3 + 0 * t),
        },
        rates={"force": (-2.0, 1.5)},
        constraints={"sum": (lambda s: s.x.speed + 0.1 * s.u.force, None, 1.25)},
    )
    found = solved(limits, method)
    t = found.trajectory
    assert np.abs(t["force"]).max() <= 1.45
    assert t["power"].max() <= 1.2 + 1e-6
    assert (t["speed"] + 0.1 * t["force"]).max() == pytest.approx(1.25, abs=1e-6)
    inner = t.window(t.time[1], None)  # Radau's first control is an extrapolation
    rates = np.diff(inner["force"]) / np.diff(inner.time)
    assert rates.min() >= -2.0 - 1e-6
    assert rates.max() <= 1.5 + 1e-6
    assert found.objective > free.objective
    assert set(found.multipliers) >= {"sum", "power", "rate of force", "force", "speed"}
    assert np.abs(found.multipliers["sum"]).max() > 1e-3


def test_limits_may_vary_in_time():
    ramp = Trajectory([0.0, 5.0], [[0.5], [2.0]], (Channel("force", "N"),))
    for high in (lambda t: 0.5 + 0.3 * t, ramp):
        found = solved(problem(bounds={"force": (None, high)}))
        t = found.trajectory
        assert (t["force"] <= 0.5 + 0.3 * t.time + 1e-9).all()
        assert t["force"][0] == pytest.approx(0.5)


def test_free_final_time_with_rates_and_disturbances():
    fast = problem(
        horizon=(0.0, (1.0, 9.0)),
        cost=None,
        final_cost=lambda start, end: end.t,
        bounds={"force": (-2.0, 2.0)},
        rates={"force": (-1.5, 1.5)},
    )
    found = solved(fast, DirectTranscription(mesh=40, refine=None), simulate=True)
    t = found.trajectory
    assert found.objective == t.time[-1]
    np.testing.assert_allclose(t["wind"], np.interp(t.time, TIME, wind()["wind"]), atol=1e-9)
    rates = np.diff(t["force"]) / np.diff(t.time)
    assert np.abs(rates).max() == pytest.approx(1.5, abs=1e-6)
    assert found.replays[0].relative < 1e-3


def test_plant_parameters_are_optimized():
    # Light carts need little force, but the mass must carry a load.
    free = problem(
        parameters={"mass": (0.5, 5.0)},
        final_cost=lambda start, end: (end.p.mass - 3.0) ** 2,
    )
    found = solved(free)
    assert 1.0 < found.parameters["mass"] < 3.0
    assert (found.trajectory["mass"] == found.parameters["mass"]).all()
    for mass in (found.parameters["mass"] - 0.05, found.parameters["mass"] + 0.05):
        fixed = solved(replace(free, parameters={"mass": mass}))
        assert fixed.objective > found.objective


def test_scenarios_share_parameters():
    runs = [wind(0.2, name="calm"), wind(1.5, name="storm")]
    given = problem(
        parameters={"mass": (0.5, 5.0)},
        disturbances=runs,
        weights=(1.0, 3.0),
        final_cost=lambda start, end: (end.p.mass - 3.0) ** 2,
    )
    found = solved(given)
    calm, storm = found.trajectories
    assert calm["mass"][0] == storm["mass"][0]
    assert np.abs(calm["force"] - storm["force"]).max() > 0.1
    mass = {"mass": found.parameters["mass"]}
    apart = [solved(replace(given, disturbances=r, weights=None, parameters=mass)) for r in runs]
    total = 0.25 * apart[0].objective + 0.75 * apart[1].objective
    assert found.objective == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize("method", [MultipleShooting(segments=5, pieces=4), SingleShooting()])
def test_shooting_keeps_bounds_inside_segments(method):
    given = problem(
        bounds={"speed": (None, 1.1), "force": (-3.0, 3.0)},
        constraints={"sum": (lambda s: s.x.speed + 0.1 * s.u.force, None, 1.15)},
    )
    found = solved(given, method, simulate=True)
    t = found.trajectory
    assert t["speed"].max() == pytest.approx(1.1, abs=1e-6)
    assert (t["speed"] + 0.1 * t["force"]).max() <= 1.15 + 1e-6
    assert found.replays[0].relative < 1e-4
    exact = solved(given, DirectTranscription(mesh=40, refine=None))
    assert found.objective == pytest.approx(exact.objective, rel=0.02)
    assert found.objective > exact.objective - 1e-3


def test_periodic_motion_by_a_boundary_constraint():
    given = problem(
        initial={},
        final={},
        horizon=(0.0, 2 * np.pi),
        bounds={"place": (-5.0, 5.0)},
        cost=lambda s: s.u.force**2 + (s.x.place - jnp.sin(s.t)) ** 2,
        boundary={
            "closed": (
                lambda start, end: [end.x.place - start.x.place, end.x.speed - start.x.speed],
                0.0,
                0.0,
            )
        },
    )
    t = solved(given).trajectory
    for name in ("place", "speed"):
        assert t[name][0] == pytest.approx(t[name][-1], abs=1e-8)
    assert np.ptp(t["place"]) > 0.1


def test_problems_that_differ_in_numbers_share_compiled_code():
    other = problem(disturbances=wind(0.7), final={"place": 3.0}, bounds={"force": (-9, 9)})
    first = solved(problem())
    node = functions_of(problem()).node
    compiled = [f._cache_size() for f in (node._values, node._jacobian, node._hessian)]
    second = solved(other)
    assert functions_of(other).node is node
    assert [f._cache_size() for f in (node._values, node._jacobian, node._hessian)] == compiled
    assert min(compiled) > 0
    assert second.objective != first.objective


# -- surrogates ---------------------------------------------------------------------------------

A, B = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.0], [1.0]])


def surrogate(span: float = 10.0, **changes) -> OptimalControlProblem:
    model = linear_model(A, B, np.array([[1.0, 0.5]]), span=span)
    given = {
        "model": model,
        "horizon": (0.0, 2.0),
        "initial": {"x0": 0.0, "x1": 0.0},
        "final": {"x0": 2.0, "x1": 0.0},
        "cost": lambda s: s.u.u0**2 + 0.1 * s.y.y0**2,
        "name": "surrogate",
    }
    return OptimalControlProblem(**(given | changes))


def test_a_surrogate_is_controlled_and_the_region_reported():
    found = solved(surrogate(), simulate=True)
    assert found.outside == 0.0
    assert found.linear_quadratic
    assert found.replays[0].relative < 1e-4
    narrow = surrogate(span=2.3)
    told = r"surrogate: .* outside the training data for .*: u0 goes to .*stay_inside keeps it near"
    with pytest.warns(DfsmWarning, match=told):
        out = solved(narrow)
    assert 0.0 < out.outside < 1.0
    assert out.objective == pytest.approx(found.objective, rel=1e-6)
    inside = solved(narrow, replace(QUICK, stay_inside=True))
    assert inside.outside == 0.0
    assert np.abs(inside.trajectory["u0"]).max() <= 2.3
    assert inside.objective > out.objective


def test_bounds_outside_the_training_range():
    with pytest.raises(DfsmError, match=r"bounds of 'u0' are \[11, 12\] at 0 s, outside the model"):
        surrogate(bounds={"u0": (11.0, 12.0)})


# -- storage ------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [QUICK, MultipleShooting(segments=5, pieces=4)])
def test_a_solution_is_saved_and_loaded(tmp_path, method):
    given = problem(bounds={"force": (-1.45, 1.45)})
    found = solved(given, method, simulate=True)
    save_solution(found, tmp_path / "s")
    loaded = load_solution(tmp_path / "s")
    assert loaded.summary() == found.summary()
    assert repr(loaded) == repr(found)
    for name in ("trajectories", "costates"):
        for a, b in zip(getattr(loaded, name), getattr(found, name), strict=True):
            assert a.channels == b.channels
            np.testing.assert_array_equal(a.values, b.values)
    np.testing.assert_array_equal(
        loaded.replays[0].trajectory.values, found.replays[0].trajectory.values
    )
    np.testing.assert_array_equal(loaded.multipliers["force"], found.multipliers["force"])
    np.testing.assert_array_equal(loaded.bounds["force"], found.bounds["force"])
    assert set(loaded.bounds["force"][1]) == {1.45}
    again = solved(given, method, guess=loaded)
    assert again.objective == pytest.approx(found.objective, rel=1e-7)
    save_solution(found, tmp_path / "s")  # replaces it


def test_a_folder_that_is_no_solution(tmp_path):
    with pytest.raises(DfsmError, match="is no folder of a solution"):
        load_solution(tmp_path / "nothing")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    found = solved(problem())
    with pytest.raises(DfsmError, match="not a folder that dfsm wrote"):
        save_solution(found, tmp_path / "other")
    save_solution(found, tmp_path / "s")
    (tmp_path / "s" / "solution.safetensors").write_bytes(b"x")
    with pytest.raises(DfsmError, match=r"is damaged: solution\.safetensors is not the file"):
        load_solution(tmp_path / "s")

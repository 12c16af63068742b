"""Optimal control: what a problem can hold, what a solution tells, and what bad input earns."""

from __future__ import annotations

import signal
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.control import (
    DirectTranscription,
    Ending,
    MultipleShooting,
    OptimalControlProblem,
    SingleShooting,
    load_solution,
    save_solution,
    solve,
)
from dfsm.control.nlp import program
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.simulators import ODESystem
from systems import linear_model

# A cart with drag, pushed by a force and by wind, with its mass as a parameter.
CART = ODESystem(
    f=lambda x, u, w, p: jnp.stack([x[1], (u[0] + w[0] - 0.3 * x[1]) / p[0]]),
    states=(Channel("place", "m"), Channel("speed", "m/s")),
    controls=(Channel("force", "N"),),
    disturbances=(Channel("wind", "N"),),
    parameters=(Channel("mass", "kg"),),
    outputs=(Channel("power", "W"),),
    g=lambda x, u, w, p: jnp.stack([u[0] * x[1]]),
    name="cart",
)
TIME = np.linspace(0, 10, 101)


def wind(size: float = 0.2, stop: float = 10.0, name: str = "wind") -> Trajectory:
    time = np.linspace(0, stop, 101)
    return Trajectory(time, size * np.sin(time)[:, None], (Channel("wind", "N"),), name=name)


def effort(s):
    return s.u.force**2


def problem(**changes) -> OptimalControlProblem:
    """Move the cart by 4 m in 5 s with little force."""
    given = {
        "model": CART,
        "horizon": (0.0, 5.0),
        "initial": {"place": 0.0, "speed": 0.0},
        "final": {"place": 4.0, "speed": 0.0},
        "cost": effort,
        "parameters": {"mass": 2.0},
        "disturbances": wind(),
        "name": "cart",
    }
    return OptimalControlProblem(**(given | changes))


QUICK = DirectTranscription(mesh=20, refine=None)


def solved(given: OptimalControlProblem, method=QUICK, **options):
    found = solve(given, method, simulate=options.pop("simulate", False), **options)
    assert found.solved, found.message
    return found


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
    first = solved(problem())
    second = solved(
        problem(disturbances=wind(0.7), final={"place": 3.0}, bounds={"force": (-9, 9)})
    )
    assert second.seconds["compile"] < 0.5 * first.seconds["compile"] + 0.1
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


# -- how a solve ends ---------------------------------------------------------------------------


def test_no_feasible_point():
    found = solve(problem(bounds={"force": (-0.5, 0.5)}, name="weak cart"), QUICK)
    assert found.ending is Ending.INFEASIBLE
    assert not found.solved
    assert found.replays == ()
    assert "misses by" in found.message
    assert "dynamics of" in found.reason
    assert "force (upper bound 0.5)" in found.reason
    assert "conflict" in found.summary()


def test_iteration_limit():
    hard = problem(cost=lambda s: s.u.force**2 * (1 + s.x.place**2))
    found = solve(hard, replace(QUICK, most_iterations=1))
    assert found.ending is Ending.LIMIT
    assert "raise most_iterations" in found.message


def test_a_mesh_that_stays_too_coarse_is_said_to_be():
    method = DirectTranscription(scheme="trapezoidal", mesh=5, refine=1e-8, most_refinements=1)
    found = solve(problem(), method, simulate=False)
    assert found.ending is Ending.COARSE
    assert found.solved
    assert [m["intervals"] for m in found.meshes] == [5, 20]


def test_the_solver_steps_back_where_a_function_is_not_defined(capfd):
    # The force that a path in 3 s needs is close to where the logarithm ends.
    tight = problem(horizon=(0.0, 3.0), cost=lambda s: -jnp.log(2.8 - s.u.force))
    found = solved(tight)
    assert 2.0 < found.trajectory["force"].max() < 2.8
    assert capfd.readouterr() == ("", "")


def test_interrupt_returns_the_best_iterate(monkeypatch):
    calls = []
    original = program.Program.hessian

    def interrupted(self, *arguments):
        calls.append(1)
        if len(calls) == 4:
            signal.raise_signal(signal.SIGINT)
        return original(self, *arguments)

    monkeypatch.setattr(program.Program, "hessian", interrupted)
    hard = problem(cost=lambda s: s.u.force**2 * (1 + s.x.place**2), bounds={"force": (-2.0, 2.0)})
    before = signal.getsignal(signal.SIGINT)
    found = solve(hard, QUICK)
    assert found.ending is Ending.INTERRUPTED
    assert found.iterations <= 6
    assert np.isfinite(found.trajectory.values).all()
    assert "solve again with it as guess" in found.message
    assert signal.getsignal(signal.SIGINT) is before
    monkeypatch.undo()
    assert solve(hard, QUICK, found, simulate=False).solved


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


# -- bad input ----------------------------------------------------------------------------------


def nan_after(s):
    return jnp.where(s.t > 2.5, jnp.nan, 1.0) * s.u.force**2


def branch(s):
    return s.u.force if s.u.force > 0 else 0.0


BAD = {
    "unknown signal": (
        {"cost": lambda s: s.x.sped**2},
        r"the cost: no channel 'sped' among the states; did you mean 'speed'\?",
    ),
    "wrong group": (
        {"cost": lambda s: s.x.force**2},
        r"the cost: 'force' is one of the controls, not of the states: write u\.force",
    ),
    "unknown in a constraint": (
        {"constraints": {"c": (lambda s: s.y.powr, None, 1.0)}},
        r"constraints 'c': no channel 'powr' among the outputs; did you mean 'power'\?",
    ),
    "control at an end": (
        {"final_cost": lambda start, end: end.u.force},
        r"the final cost: the ends of the horizon have t, x and p, not 'u'",
    ),
    "not a scalar": (
        {"cost": lambda s: [s.x.place, s.x.speed]},
        r"the cost returns 2 values, expected one number",
    ),
    "an if": ({"cost": branch}, r"the cost cannot be followed by JAX .* jnp\.where"),
    "one argument": (
        {"final_cost": lambda end: end.t},
        r"the final cost cannot be evaluated: .* positional argument",
    ),
    "depends on nothing": (
        {"constraints": {"c": (lambda s: s.w.wind - s.t, None, 1.0)}},
        r"constraints 'c' depends on nothing that can be chosen",
    ),
    "boundary depends on nothing": (
        {"boundary": {"c": (lambda start, end: end.t, None, 1.0)}},
        r"boundary 'c' depends on nothing that can be chosen",
    ),
    "nan": (
        {"cost": nan_after},
        r"the cost is not finite at 2\.625 s for the guess: give a guess or bounds",
    ),
    "nothing to minimise": ({"cost": None}, r"nothing to minimise"),
    "bounds that cross": (
        {"bounds": {"force": (lambda t: t - 3, 1.0)}},
        r"bounds of 'force' go from 1\.025 to 1 at 4\.025 s",
    ),
    "initial outside bounds": (
        {"bounds": {"place": (1.0, None)}},
        r"the initial 'place' is to be in 0, its bounds are \[1, inf\]: no value meets both",
    ),
    "unknown bound": (
        {"bounds": {"forc": (0, 1)}},
        r"bounds: no channel 'forc'; did you mean 'force'\?",
    ),
    "rate of a state": (
        {"rates": {"speed": (0, 1)}},
        r"rates: 'speed' is one of the states, expected controls",
    ),
    "short wind": (
        {"disturbances": wind(stop=4.0)},
        r"the disturbances of wind last from 0 s to 4 s, the horizon from 0 s to 5 s",
    ),
    "no wind": ({"disturbances": None}, r"the disturbances wind are missing: give a run"),
    "parameter without a value": ({"parameters": {}}, r"parameter 'mass' has no value"),
    "horizon": ({"horizon": (5.0, 5.0)}, r"the horizon is \(5\.0, 5\.0\), expected"),
    "free time with moving bounds": (
        {"horizon": (0.0, (1.0, 9.0)), "bounds": {"force": (None, lambda t: t)}},
        r"the limits of 'force' vary in time, which needs a fixed last time",
    ),
    "weights": ({"weights": (1.0, 2.0)}, r"weights is \[1\.0, 2\.0\], expected 1 positive numbers"),
    "constraint without limits": (
        {"constraints": {"c": lambda s: s.x.place}},
        r"constraints 'c' is .*, expected \(function, low, high\)",
    ),
    "bounds without a pair": (
        {"bounds": {"force": 3.0}},
        r"bounds of 'force' are 3\.0, expected a pair \(low, high\)",
    ),
    "initial text": (
        {"initial": {"place": "zero"}},
        r"initial of 'place' are 'zero', expected a number or a pair",
    ),
    "horizon of lists": (
        {"horizon": (0.0, [1.0, 9.0])},
        r"the horizon is \(0\.0, \[1\.0, 9\.0\]\)",
    ),
    "limit of another length": (
        {"bounds": {"force": (None, lambda t: np.ones(3))}},
        r"a limit of 'force' has shape \(3,\) at 201 times",
    ),
    "overdetermined": (
        {"constraints": {"c": (lambda s: s.x.place, 1.0, 1.0)}},
        r"121 equality constraints for 119 variables leave nothing to choose",
    ),
    "no model": ({"model": "cart"}, r"model is a str, expected a DFSM or an ODESystem"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_earns_one_sentence(case):
    changes, message = BAD[case]
    with pytest.raises(DfsmError, match=message) as caught:
        solve(problem(**changes), QUICK)
    assert "\n" not in str(caught.value)


def test_bad_settings_and_guesses():
    for settings, message in (
        ({"mesh": 0}, "mesh is 0"),
        ({"mesh": (0.0, 0.5, 0.4, 1.0)}, "edges that increase from 0"),
        ({"scheme": "euler"}, "scheme is euler"),
        ({"refine": 0.0}, "refine is 0.0"),
        ({"degree": 0}, "degree is 0"),
    ):
        with pytest.raises(DfsmError, match=message):
            solve(problem(), DirectTranscription(**settings))
    with pytest.raises(DfsmError, match="segments is 0"):
        MultipleShooting(segments=0)
    with pytest.raises(DfsmError, match="holds none of the states and controls"):
        solve(problem(), QUICK, wind())
    with pytest.raises(DfsmError, match="guess is a float"):
        solve(problem(), QUICK, 1.0)

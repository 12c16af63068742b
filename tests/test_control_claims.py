"""What `solved` claims: errors between the nodes, chatter, limits, knots, sizes, and time."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.control import (
    DirectTranscription,
    Ending,
    OptimalControlProblem,
    load_solution,
    save_solution,
    solve,
)
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.simulators import ODESystem

INTEGRATOR = ODESystem(
    f=lambda x, u, w, p: u + 0 * w[0],
    states=(Channel("x"),),
    controls=(Channel("u"),),
    disturbances=(Channel("w"),),
)
DOUBLE = ODESystem(
    f=lambda x, u, w, p: jnp.stack([x[1], u[0]]),
    states=(Channel("x"), Channel("v")),
    controls=(Channel("u"),),
)
TIME = np.linspace(0, 10, 41)
WIND = Trajectory(TIME, np.sin(3.0 * np.arange(41))[:, None], (Channel("w"),))
COARSE = DirectTranscription(mesh=20, refine=None)


def pulse(t):
    return jnp.exp(-(((t - 6.37) / 0.04) ** 2))


def follow_pulse(s):
    return (s.x.x - pulse(s.t)) ** 2 + 1e-4 * s.u.u**2


def follow_wind(s):
    return (s.x.x - s.w.w) ** 2 + 1e-2 * s.u.u**2


def turning(s):
    return (s.u.u - jnp.cos(4 * jnp.pi * s.t)) ** 2 + 1e-3 * s.x.x**2


def rest(s):
    return s.x.x**2 + 0.1 * s.u.u**2


def effort(s):
    return s.u.u**2


def integrator(**changes) -> OptimalControlProblem:
    fields = {"model": INTEGRATOR, "horizon": (0.0, 10.0), "initial": {"x": 0.0}, "cost": rest}
    return OptimalControlProblem(**(fields | {"disturbances": WIND} | changes))


def moved(**changes) -> OptimalControlProblem:
    fields = {"model": DOUBLE, "horizon": (0.0, 1.0), "initial": {"x": 0.0, "v": 0.0}}
    fields |= {"final": {"x": 1.0, "v": 0.0}, "cost": effort}
    return OptimalControlProblem(**(fields | changes))


# -- between the nodes --------------------------------------------------------------------------


def test_a_pulse_between_the_nodes_of_the_cost_is_seen_and_refined(tmp_path):
    problem = integrator(cost=follow_pulse)
    coarse = solve(problem, COARSE, simulate=False)
    assert coarse.errors["dynamics"] < 1e-12
    assert coarse.errors["cost"] > 0.5
    found = solve(problem, simulate=False)
    fine = DirectTranscription(scheme="radau", mesh=1000, refine=None)
    true = solve(problem, fine, simulate=False).objective
    assert found.solved
    assert max(found.errors["cost"], found.errors["constraints"]) <= 1e-6
    assert found.objective == pytest.approx(true, rel=1e-5)
    assert "errors between the nodes: dynamics" in found.summary()
    save_solution(found, tmp_path / "solution")
    assert load_solution(tmp_path / "solution").errors == found.errors


def test_a_bound_between_the_nodes_is_seen_and_refined():
    def least(t):
        return np.array(pulse(t)) - 0.01

    problem = integrator(bounds={"x": (least, None)})
    coarse = solve(problem, COARSE, simulate=False)
    assert coarse.violation < 1e-8
    assert coarse.errors["constraints"] > 0.5
    found = solve(problem, simulate=False)
    tau = np.linspace(0, 1, 20001)
    assert found.solved
    assert (least(10 * tau) - found.at(tau)[0][:, 0]).max() < 2e-6
    assert found.objective > 0.5


def test_a_mesh_that_misses_a_bound_is_not_solved_and_names_it():
    problem = integrator(bounds={"x": (lambda t: np.array(pulse(t)) - 0.01, None)})
    found = solve(problem, DirectTranscription(most_refinements=0), simulate=False)
    assert found.ending is Ending.COARSE
    assert not found.solved
    assert found.reason.startswith("between the nodes x exceeds its limit by 0.9")
    assert found.reason.endswith(" at 6.371 s")


@pytest.mark.parametrize("where", ["disturbances", "table"])
def test_cuts_are_made_at_the_knots_of_tables(where):
    cost = follow_wind
    if where == "table":
        known = jnp.asarray(WIND["w"])

        def cost(s):
            return (s.x.x - jnp.interp(s.t, TIME, known)) ** 2 + 1e-2 * s.u.u**2

    found = solve(integrator(cost=cost), DirectTranscription(mesh=7), simulate=False)
    assert found.solved
    knots = TIME[1:-1] / 10
    assert np.abs(found.grid.edges[:, None] - knots).min(axis=0).max() < 1e-9


# -- starting again, and stopping ---------------------------------------------------------------


def test_a_finer_mesh_is_tried_where_the_coarse_one_is_infeasible():
    # Three nodes of a control within bounds cannot reach both ends; seven can.
    problem = moved(bounds={"u": (-5.0, 5.0), "v": (None, 1.6)})
    method = DirectTranscription(scheme="trapezoidal", mesh=2, refine=1e-2)
    found = solve(problem, method, simulate=False)
    assert found.solved
    assert [mesh["intervals"] for mesh in found.meshes[:2]] == [2, 6]
    kept = solve(problem, replace(method, refine=None))
    assert kept.ending is Ending.INFEASIBLE


def test_refinement_stops_where_it_improves_nothing(monkeypatch):
    from dfsm.control.nlp.estimate import Estimate

    stuck = Estimate(np.array([1e-3]), np.zeros(1), np.zeros(1), 1e-3)
    monkeypatch.setattr(
        "dfsm.control.nlp.transcription.estimate_of",
        lambda shot, *a: replace(stuck, dynamics=np.full(shot.grid.intervals, 1e-3)),
    )
    found = solve(moved(), DirectTranscription(mesh=2), simulate=False)
    assert found.ending is Ending.COARSE
    assert len(found.meshes) == 4
    assert "3 finer meshes did not lower the largest error, 0.001 of the dynamics" in found.reason


def test_a_time_limit_ends_a_solve():
    far = integrator(initial={"x": 1.0}, bounds={"u": (-0.2, None)})
    found = solve(far, DirectTranscription(most_seconds=1e-9), simulate=False)
    assert found.ending is Ending.TIME
    assert "raise most_seconds" in found.message
    with pytest.raises(DfsmError, match="most_seconds is 0"):
        DirectTranscription(most_seconds=0)


# -- what is told -------------------------------------------------------------------------------


def test_rates_and_path_constraints_are_named_where_they_leave_no_point():
    slow = solve(moved(rates={"u": (-5.0, 5.0)}), COARSE)
    assert slow.ending is Ending.INFEASIBLE
    assert "at their limits are rate of u (" in slow.reason
    assert "limit -5)" in slow.reason
    weak = {"push": (lambda s: s.u.u + 0.1 * s.x.v, None, 0.5)}
    assert "push (upper limit 0.5)" in solve(moved(constraints=weak), COARSE).reason


def test_an_unbounded_problem_names_what_runs_away():
    found = solve(moved(final={}, cost=lambda s: s.x.x), COARSE, simulate=False)
    assert found.ending is Ending.UNBOUNDED
    assert not found.solved
    assert found.reason.startswith("u runs away to -")


@pytest.mark.parametrize(
    ("f", "g", "message"),
    [
        (lambda x, u, w, p: jnp.stack([u[0], u[0]]), None, "f returns 2 values for the 1 states x"),
        (lambda x, u, w, p: u, lambda x, u, w, p: x[:0], "g returns 0 values for the 1 outputs y"),
        (lambda x, u, w, p: u @ jnp.ones(3), None, "the model's f cannot be evaluated"),
    ],
)
def test_functions_of_the_wrong_size_earn_a_sentence(f, g, message):
    outputs = (Channel("y"),) if g else ()
    model = ODESystem(f, states=(Channel("x"),), controls=(Channel("u"),), outputs=outputs, g=g)
    problem = OptimalControlProblem(
        model=model, horizon=(0.0, 1.0), initial={"x": 0.0}, cost=effort
    )
    with pytest.raises(DfsmError, match=message):
        solve(problem, COARSE)


def test_a_singular_arc_chatters_with_hermite_simpson_and_not_with_radau():
    problem = moved(
        horizon=(0.0, 5.0),
        initial={"x": 0.0, "v": 1.0},
        final={},
        bounds={"u": (-1.0, 1.0)},
        cost=lambda s: (s.x.x**2 + s.x.v**2) / 2,
    )
    found = solve(problem, replace(COARSE, mesh=60, refine=1e-2), simulate=False)
    assert found.ending is Ending.CHATTERING
    assert not found.solved
    assert found.reason.startswith("u turns ")
    assert "use scheme radau" in found.message
    # On a mesh that is to stay as it is, it is told.
    kept = solve(problem, replace(COARSE, mesh=60), simulate=False)
    assert kept.ending is Ending.SOLVED
    assert "scheme radau follows the arc" in kept.message
    smooth = solve(problem, replace(COARSE, mesh=60, scheme="radau"), simulate=False)
    assert smooth.ending is Ending.SOLVED
    assert smooth.objective == pytest.approx(0.376992, rel=1e-4)


def test_a_control_that_a_cost_makes_turn_does_not_chatter():
    # The sign changes from node to node, and leaving it would cost.
    found = solve(integrator(cost=turning, initial={}), COARSE, simulate=False)
    assert (np.diff(np.sign(found.trajectory["u"])) != 0).sum() > 20
    assert found.ending is Ending.SOLVED


def test_a_solver_that_gives_up_at_a_solution_has_solved_it(monkeypatch):
    from dfsm.control.nlp import ipopt

    monkeypatch.setattr(ipopt, "_ending", lambda _word: "failed")
    found = solve(moved(), COARSE, simulate=False)
    assert found.ending is Ending.STALLED
    assert found.optimality.worst < 1e-6
    assert found.objective == pytest.approx(12.0, rel=1e-6)

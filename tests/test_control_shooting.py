"""Shooting knows what happens between its nodes; what is said where no mesh or no scheme helps."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.control import (
    DirectTranscription,
    Ending,
    MultipleShooting,
    OptimalControlProblem,
    SingleShooting,
    solve,
)
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.simulators import ODESystem

DOUBLE = ODESystem(
    f=lambda x, u, w, p: jnp.stack([x[1], u[0]]),
    states=(Channel("x"), Channel("v")),
    controls=(Channel("u"),),
)
# A body in waves: with the velocity w/(2 c) the most energy is taken out, ∫ w²/(4 c) dt.
DAMPING, PERIOD = 0.2, 2 * np.pi / 0.6
BODY = ODESystem(
    f=lambda x, u, w, p: jnp.stack([x[1], w[0] + u[0] - DAMPING * x[1] - x[0]]),
    states=(Channel("x"), Channel("v")),
    controls=(Channel("F"),),
    disturbances=(Channel("wave"),),
)
TIME = np.linspace(0, 40, 2001)
WAVE = Trajectory(TIME, np.sin(0.6 * TIME)[:, None], (Channel("wave"),))


def half_effort(s):
    return 0.5 * s.u.u**2


def below(s):
    return s.x.x


def bryson_denham(**changes) -> OptimalControlProblem:
    """Least effort below x = 1/9: the optimum is 4."""
    fields: dict[str, Any] = {"model": DOUBLE, "horizon": (0.0, 1.0), "cost": half_effort}
    fields |= {"initial": {"x": 0.0, "v": 1.0}, "final": {"x": 0.0, "v": -1.0}}
    fields["bounds"] = {"x": (None, 1 / 9)}
    return OptimalControlProblem(**(fields | changes))


def test_shooting_keeps_a_bound_between_its_nodes():
    problem = bryson_denham()
    kept = solve(problem, MultipleShooting(refine=None), simulate=False)
    assert kept.objective < 3.9999
    assert kept.errors["constraints"] > 2e-6
    assert kept.errors["dynamics"] < 1e-12
    found = solve(problem, MultipleShooting(), simulate=False)
    assert found.solved
    assert found.errors["constraints"] <= 1e-6
    assert found.objective == pytest.approx(4.0, rel=1e-6)


@pytest.mark.parametrize("method", [MultipleShooting, SingleShooting])
def test_shooting_that_misses_a_limit_is_not_solved_and_names_it(method):
    limits = {"low": (below, None, 1 / 9)}
    problem = bryson_denham(bounds={}, constraints=limits)
    found = solve(problem, method(most_refinements=0), simulate=False)
    assert found.ending is Ending.COARSE
    assert found.reason.startswith("between the nodes low exceeds its limit by ")
    assert found.message.endswith("raise most_refinements, or loosen refine")
    assert "errors between the nodes: dynamics" in found.summary()


def test_shooting_tells_the_errors_of_its_steps():
    fast = ODESystem(
        lambda x, u, w, p: u - 50 * x, states=(Channel("x"),), controls=(Channel("u"),)
    )
    problem = OptimalControlProblem(
        model=fast, horizon=(0.0, 1.0), initial={"x": 1.0}, cost=lambda s: s.u.u**2 + s.x.x**2
    )
    method = MultipleShooting(segments=20, pieces=1, steps=1, refine=None)
    kept = solve(problem, method, simulate=False)
    # One step of h = 1/20: 1 − 2.5 + 2.5²/2 − 2.5³/6 + 2.5⁴/24 = 0.648 in place of e^−2.5 = 0.082.
    assert kept.errors["dynamics"] == pytest.approx(0.648 - 0.082, rel=0.05)
    assert kept.errors["cost"] > 0.01
    found = solve(problem, MultipleShooting(segments=20, pieces=1, steps=1), simulate=False)
    assert found.errors["dynamics"] < 1e-5


def test_an_objective_without_limit_on_a_mesh_asks_for_radau_first():
    problem = OptimalControlProblem(
        model=BODY,
        horizon=(0.0, PERIOD),
        cost=lambda s: s.u.F * s.x.v,
        disturbances=WAVE,
        boundary={"periodic": (lambda a, b: jnp.stack([a.x.x - b.x.x, a.x.v - b.x.v]), 0.0, 0.0)},
    )
    found = solve(problem, simulate=False)
    assert found.ending is Ending.UNBOUNDED
    told = found.message
    assert told.index("use scheme radau first") < told.index("correct the sign")
    radau = solve(problem, DirectTranscription(scheme="radau"), simulate=False)
    assert radau.objective == pytest.approx(-PERIOD / (8 * DAMPING), rel=1e-4)


def test_where_finer_meshes_do_not_help_something_else_is_advised(monkeypatch):
    from dfsm.control.nlp.estimate import Estimate

    def stuck(shot, *_rest):
        n = shot.grid.intervals
        return Estimate(np.full(n, 1e-3), np.zeros(n), np.zeros(n), 1e-3)

    monkeypatch.setattr("dfsm.control.nlp.transcription.estimate_of", stuck)
    problem = bryson_denham(bounds={})
    for method, advice in (
        (DirectTranscription(mesh=2), "use scheme radau"),
        (DirectTranscription(scheme="radau", mesh=2), "replace kinks"),
    ):
        found = solve(problem, method, simulate=False)
        assert found.ending is Ending.COARSE
        assert f"error, 0.001 of the dynamics: {advice}" in found.message
        assert "most_refinements" not in found.message

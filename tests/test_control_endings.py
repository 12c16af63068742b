"""Optimal control: how a solve ends, and what bad input earns."""

from __future__ import annotations

import signal
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from cart import QUICK, problem, solved, wind
from dfsm.control import DirectTranscription, Ending, MultipleShooting, solve
from dfsm.control.nlp import program
from dfsm.errors import DfsmError

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
    assert not found.solved
    assert found.reason.startswith("the error of the cost is 0.0046, most of it near ")
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
    "no values": (
        {"constraints": {"c": (lambda s: [], None, 1.0)}},
        r"constraints 'c' cannot be evaluated: Need at least one array",
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
    "constraints without names": (
        {"constraints": [lambda s: s.x.place]},
        r"constraints are a list, expected a dict by name, \{name: \(function, low, high\)\}",
    ),
    "a cost that is a name": ({"cost": "force"}, r"cost is a str, expected a function"),
    "a path as wind": (
        {"disturbances": "wind.csv"},
        r"disturbances hold a str, expected a Trajectory or a list of them",
    ),
    "a parameter that is no number": (
        {"parameters": {"mass": float("nan")}},
        r"parameter 'mass' is nan, expected a finite number, or a pair",
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

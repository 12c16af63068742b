"""What a simulation, a campaign or a system does not accept, and runs that fail."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest

from dfsm import Channel, DfsmError, ODESystem, RandomKnots, Trajectory, Uniform, excite, mass_chain

TIME = np.linspace(0, 1, 201)
KNOTS = RandomKnots(low=-1.0, high=1.0, spacing=0.25)
X, U = (Channel("x", "m"),), (Channel("u", "N"),)


def decay(x, u, w, p):
    return -1.0 * x


def driven(x, u, w, p):
    return u - x


@pytest.mark.parametrize("backend", ["jax", "numpy"])
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((TIME, [1.0, 2.0]), r"initial state: shape \(2,\), expected \(1,\): x"),
        ((TIME, [np.nan]), "initial state: 'x' is nan, expected a finite number"),
        ((TIME, ["one"]), "initial state: a list, expected numbers"),
        ((TIME[::-1], [1.0]), "time goes from 1 s to 0.995 s at sample 1, expected increasing"),
        (([0.0], [1.0]), r"time has shape \(1,\), expected \(time,\), at least 2"),
        ((TIME, [1.0]), r"the controls are missing, expected \(1,\): u"),
        ((TIME, [1.0], excite(KNOTS, 1, 0.5)), "last from 0 s to 0.5 s, the simulation from 0 s"),
        ((TIME, [1.0], excite(KNOTS, 2, 1.0)), r"a signal of 2 channels, expected \(1,\): u"),
        ((TIME, [1.0], KNOTS), "controls: a RandomKnots, draw a signal from it with excite"),
        ((TIME, [1.0], np.zeros((7, 1))), r"shape \(7, 1\), expected .* each of the 201 times"),
        ((TIME, [1.0], [np.inf]), "controls: a value is not finite"),
        ((TIME, [1.0], "sine"), "controls: a str, expected numbers"),
        ((TIME, [1.0], [0.0], [1.0]), r"disturbances: shape \(1,\), expected \(0,\)"),
        ((TIME, [1.0], [0.0], None, [1.0]), r"parameters: shape \(1,\), expected \(0,\)"),
    ],
)
def test_simulations_that_make_no_sense(backend, arguments, sentence):
    with pytest.raises(DfsmError, match=sentence) as caught:
        ODESystem(driven, X, U, backend=backend).simulate(*arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((0, TIME, [1.0], KNOTS), "runs is 0, expected at least 1"),
        ((2, TIME - 1, [1.0], KNOTS), "the first time is -1 s, expected 0 s or later"),
        ((2, TIME, [[1.0, 2.0]], KNOTS), r"the initial state: shape \(2,\), expected \(1,\): x"),
        ((2, TIME, Uniform(low=(0.0, 1.0), high=2.0), KNOTS), "one for each of the 1 channels"),
        ((2, TIME, [1.0]), "no signal for the controls u: say what kind to draw"),
        ((2, TIME, [1.0], KNOTS, KNOTS), "the system has no disturbances to excite"),
        ((2, TIME, [1.0], KNOTS, None, [2.0]), r"the parameters: shape \(1,\), expected \(0,\)"),
        ((2, TIME, [1.0], KNOTS, None, (), -1), "seed is -1, expected 0 or more"),
    ],
)
def test_campaigns_that_make_no_sense(arguments, sentence):
    with pytest.raises(DfsmError, match=sentence):
        ODESystem(driven, X, U).campaign(*arguments)


def test_missing_parameters_of_a_campaign():
    with pytest.raises(DfsmError, match=r"the parameters: shape \(0, 1\), expected \(1,\): k"):
        ODESystem(decay, X, parameters=(Channel("k"),)).campaign(1, TIME, [1.0])


@pytest.mark.parametrize(
    ("keywords", "sentence"),
    [
        ({"states": ()}, "no states were given"),
        ({"controls": X}, "channel 'x' was given twice"),
        ({"g": decay}, "output channels missing"),
        ({"outputs": U}, "g missing"),
        ({"f": lambda x, u: x}, r"f takes \(x, u\), expected \(states, controls, disturbances"),
        ({"g": lambda x: x, "outputs": U}, r"g takes \(x\)"),
        ({"backend": "torch"}, "backend is torch, expected jax or numpy"),
        ({"rtol": 0.0}, "rtol is 0.0, expected more than 0"),
    ],
)
def test_systems_that_make_no_sense(keywords, sentence):
    with pytest.raises(DfsmError, match=sentence):
        ODESystem(**{"f": decay, "states": X, **keywords})


@pytest.mark.parametrize("backend", ["jax", "numpy"])
def test_functions_that_return_the_wrong_shape(backend):
    two = ODESystem(lambda x, u, w, p: [x[0], x[0]], X, backend=backend)
    with pytest.raises(DfsmError, match=r"f returns shape \(2,\), expected \(1,\), one value for"):
        two.simulate(TIME, [1.0])
    with pytest.raises(DfsmError, match=r"f returns shape \(2,\)"):
        two.jacobians([1.0])
    outputs = ODESystem(decay, X, outputs=U, g=two.f, backend=backend)
    with pytest.raises(DfsmError, match=r"g returns shape \(2,\), .* of the outputs"):
        outputs.simulate(TIME, [1.0])


@pytest.mark.parametrize("f", [lambda x, u, w, p: [math.sin(x[0])], lambda x, u, w, p: np.sin(x)])
def test_functions_that_jax_cannot_follow(f):
    with pytest.raises(DfsmError, match=r"JAX cannot follow f, .* or set backend to numpy"):
        ODESystem(f, X).simulate(TIME, [1.0])
    run = ODESystem(f, X, backend="numpy").simulate(TIME, [1.0])
    # x' = sin x has the solution 2 arctan(tan(1/2) exp t).
    assert np.allclose(run["x"], 2 * np.arctan(np.tan(0.5) * np.exp(TIME)), rtol=0, atol=1e-8)


@pytest.mark.parametrize("backend", ["jax", "numpy"])
def test_a_run_that_fails_is_named(backend):
    system = ODESystem(lambda x, u, w, p: x**2, X, backend=backend, name="explosion")
    # x = 1 / (1/x0 - t) ends at 1/x0.
    with pytest.raises(DfsmError, match=r"run001: the solver gave up between 0\.5\d* s and 0\.5"):
        system.campaign(3, TIME, [[0.5], [1 / 0.502], [0.1]])


@pytest.mark.parametrize(("backend", "xp"), [("jax", jnp), ("numpy", np)])
def test_a_derivative_that_is_no_number_at_the_start(backend, xp):
    system = ODESystem(lambda x, u, w, p: xp.sqrt(x) + u, X, U, backend=backend, name="root")
    with pytest.raises(
        DfsmError, match=r"run: f gives no finite derivative of 'x' at the start \(x = -1, u = 2\)"
    ):
        system.simulate(TIME, [-1.0], [2.0])


def test_a_run_without_a_channel():
    with pytest.raises(DfsmError, match="no channel 'u'"):
        ODESystem(driven, X, U).derivative(Trajectory([0, 1], [[1.0], [2.0]], X))


def test_a_chain_without_masses():
    with pytest.raises(DfsmError, match="masses is 0, expected at least 1"):
        mass_chain(0)

"""What is told where something ends: a rollout, a fit without squares, refinement in vain."""

from __future__ import annotations

import numpy as np
import pytest

import dfsm
from dfsm.data.derivatives import DerivativeSettings
from dfsm.data.suspects import screened
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, hushed
from dfsm.fitting.settings import FitSettings
from dfsm.fitting.verdicts import Evidence, _advice
from systems import linear_model

TIME = np.linspace(0, 20, 201)


def run_of(x: float | np.ndarray, u: float) -> Trajectory:
    values = np.stack([np.broadcast_to(x, TIME.shape), np.full(len(TIME), u)], axis=1)
    return Trajectory(TIME, values, (Channel("x0", "m"), Channel("u0", "N")))


@pytest.mark.parametrize(("rate", "u", "driven"), [(-1.0, 300.0, True), (1.0, 0.1, False)])
def test_a_rollout_that_leaves_tells_whether_an_input_drove_it(
    rate: float, u: float, driven: bool
) -> None:
    """A stable model under an input thirty times too large, and one that is unstable."""
    model = linear_model(np.array([[rate]]), np.ones((1, 1)))
    with hushed():
        rollout = dfsm.simulate(model, run_of(0.0, u))
    assert rollout.status is dfsm.Status.LEFT_REGION
    assert ("while its input u0 was at 300 (training range -10 to 10)" in rollout.message) == driven


@pytest.mark.parametrize("what", ["refuse", "drop", "keep"])
def test_numbers_without_squares_are_refused(what: str) -> None:
    run = run_of(1e160 * np.sin(TIME), 1.0)
    with pytest.raises(DfsmError, match=r"'x0' is .* squared in 64 bits: .* in a larger unit"):
        screened([run], ["x0", "u0"], what, (None, None), DerivativeSettings())  # pyright: ignore[reportArgumentType]


def test_refinement_in_vain_is_not_advised_again() -> None:
    settings = FitSettings(states=(dfsm.StateSpec(name="x0"),), controls=("u0",))
    told = {
        discarded: _advice(
            "x0", settings, Evidence({}, None, (), refined=False, discarded=discarded)
        )[1]
        for discarded in (False, True)
    }
    assert told[False].startswith("refine, ")
    assert "no better on the runs held out" in told[True]


def test_a_stray_sample_of_a_test_run_is_told() -> None:
    """Else its error is taken for the model's."""
    model = linear_model(np.array([[-1.0]]), np.ones((1, 1)))
    x = 1 - np.exp(-TIME)
    wrong = x.copy()
    wrong[50] = 1e6
    with hushed():
        plain, told = (dfsm.validate(model, [run_of(v, 1.0)]).warnings for v in (x, wrong))
    assert not any("far beyond" in text for text in plain)
    assert any("'x0' is 1e+06 at 5 s, far beyond all its other samples" in text for text in told)

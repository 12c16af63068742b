"""Hidden states beyond what the data tell, without inputs, from runs of two rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from benchmarks.twins import TWINS
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.fit import fit
from dfsm.fitting.hidden.form import Form
from dfsm.fitting.hidden.search import last_steps
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.hidden.starts import Candidate
from dfsm.fitting.settings import FitSettings
from dfsm.simulation.simulate import simulate

# An oscillator whose velocity nobody measures: eigenvalues -0.15 ± 1.6i.
A = np.array([[0.0, 1.0], [-(0.15**2 + 1.6**2), -0.3]])
SETTINGS = FitSettings(
    states=(StateSpec(name="q"),),
    inputs="hold",
    nonlinear_only=False,
    hidden=HiddenSettings(count=1, form="none"),
)


def decay(start: tuple[float, float], step: float = 0.1, samples: int = 160) -> Trajectory:
    """A free oscillation, exact."""
    over, x = expm(A * step), [np.array(start)]
    for _ in range(samples - 1):
        x.append(over @ x[-1])
    q = np.array(x)[:, :1]
    time = step * np.arange(samples)
    return Trajectory(time, q, (Channel("q", "m"),), name=f"free from {start} every {step:g} s")


def driven(seed: int, samples: int = 300) -> Trajectory:
    """The same under an input that is held, with noise of a fiftieth of what is seen."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, samples // 5).repeat(5)
    over = expm(np.block([[A, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]) * 0.2)
    x, q = np.zeros(2), np.empty(samples)
    for k, v in enumerate(u):
        q[k] = x[0]
        x = over[:2, :2] @ x + over[:2, 2] * v
    q += 0.02 * q.std() * rng.standard_normal(samples)
    channels = (Channel("u", "N"), Channel("q", "m"))
    return Trajectory(0.2 * np.arange(samples), np.stack([u, q], axis=1), channels, name="driven")


def test_a_system_without_inputs_has_hidden_states_too() -> None:
    """What is measured in half the run tells the velocity there, and so the rest of it."""
    model = fit([decay((1.0, 0.0)), decay((-0.5, 2.0))], SETTINGS).model
    new = decay((0.3, -1.5))
    free = simulate(model, new, start=8.0).trajectory
    np.testing.assert_allclose(free["q"], new["q"][80:], atol=0.01 * new["q"].std())
    whole = simulate(model, new).trajectory
    np.testing.assert_allclose(whole["q"], new["q"], atol=0.01 * new["q"].std())


def test_more_hidden_states_than_the_data_tell_are_told() -> None:
    settings = FitSettings(
        states=(StateSpec(name="q"),),
        controls=("u",),
        nonlinear_only=False,
        hidden=HiddenSettings(count=4, form="none"),
    )
    match = r"hidden.count is 4, more than the data can tell: .* set hidden.count to [23], or"
    with pytest.warns(DfsmWarning, match=match):
        result = fit([driven(1)], settings)
    assert [*result.model.provenance.record["hidden"]["by_count"]] == ["2", "3", "4"]
    assert len(result.model.signals.latents) == 4


def test_a_plant_that_grows_is_told_what_hidden_states_have_for_it() -> None:
    """q'' = 0.04 q + u in open loop: linear.margin and refine do not go with hidden states."""
    over = expm(np.array([[0.0, 1, 0], [0.04, 0, 1], [0, 0, 0]]) * 0.2)
    u = np.random.default_rng(3).uniform(-1, 1, 24).repeat(5)
    x, q = np.zeros(2), np.empty(len(u))
    for k, v in enumerate(u):
        q[k] = x[0]
        x = over[:2, :2] @ x + over[:2, 2] * v
    channels = (Channel("u", "N"), Channel("q", "m"))
    time = 0.2 * np.arange(len(u))
    run = Trajectory(time, np.stack([u, q], axis=1), channels, name="grows")
    with pytest.warns(DfsmWarning, match=r"for any other set hidden.stable or fewer hidden states"):
        model = fit([run], replace(SETTINGS, controls=("u",))).model
    grows = np.linalg.eigvals(np.asarray(model.jacobians(np.zeros(2), np.zeros(1), [])[0])).real
    np.testing.assert_allclose(grows.max(), 0.2, atol=0.01)


def test_as_many_hidden_states_as_there_are_are_no_reason_to_doubt() -> None:
    settings = FitSettings(
        states=(StateSpec(name="q"),),
        controls=("u",),
        nonlinear_only=False,
        hidden=HiddenSettings(count=1, form="none"),
    )
    told = fit([driven(1)], settings).model.provenance.record
    assert not any("more than the data" in text for text in told["warnings"])
    by_count = told["hidden"]["by_count"]
    assert by_count["1"] < 0.2 * by_count["0"]


def test_runs_of_two_rates_are_refused_by_the_rates_that_there_are() -> None:
    runs = [decay((1.0, 0.0)), decay((0.0, 1.0), 0.2)]
    with pytest.raises(DfsmError, match=r"every 0.2 s has samples 0.2 s apart, where 0.1 s are"):
        fit(runs, SETTINGS)


def test_what_is_nonlinear_is_not_taken_for_hidden_states() -> None:
    """To a linear system a spring that hardens looks like two states more, with noise beside it."""
    twin = TWINS["duffing"]
    settings = FitSettings(
        states=(StateSpec(name="y"),),
        disturbances=("u",),
        nonlinear_only=False,
        hidden=HiddenSettings(form="polynomial", most=3, iterations=20),
    )
    # Nor is it told, by derivatives that are not to be fitted, that the input is held.
    model = fit([twin.record(400, 1, 0.002)], settings).model
    told = model.provenance.record["hidden"]
    assert told["by_count"]["3"] < 0.7 * told["by_count"]["1"]
    assert told["count"] < 3
    assert model.signals.between == ("cubic",)
    test = twin.record(400, 2)
    begin = float(test.time[50])
    free = simulate(model, test, start=begin).trajectory
    np.testing.assert_allclose(free["y"], test["y"][50:], atol=0.1 * test["y"].std())


def test_the_last_steps_go_as_far_as_data_left_out_let_the_search_go() -> None:
    """Where these ended it early, it would go on learning noise of the few data there are."""
    tanh = Form(2, 1, 1, "tanh", 2)

    def taken(steps: int, form: Form = tanh) -> int:
        return last_steps(Candidate(form, np.zeros(form.size), 0.1, steps), 40)

    assert taken(20) == taken(21) == 5
    assert taken(30) == 20
    assert taken(42) == 40
    # Linear systems and searches that came to their end are followed to the end.
    assert taken(20, Form(2, 1, 1)) == taken(0) == 40

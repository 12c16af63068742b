"""Optimization on surrogates where the truth is known: the adaptive loop, and co-design."""

from __future__ import annotations

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import adaptive_robot
import codesign
import dfsm
from conftest import example_module
from dfsm.control import DirectTranscription
from dfsm.errors import hushed
from dfsm.loops.adaptive import Agreement, realised

METHOD = DirectTranscription(mesh=20, refine=None)
TIME = np.linspace(0, 2, 101)


def swing(x, u, _w, _p):
    return jnp.stack([x[1], u[0] - 4 * jnp.sin(x[0]) - 0.2 * x[1]])


PENDULUM = dfsm.ODESystem(
    swing,
    states=(dfsm.Channel("angle", "rad"), dfsm.Channel("speed", "rad/s")),
    controls=(dfsm.Channel("torque", "N m"),),
    name="pendulum",
)


# One function, so that problems on one model share compilations.
def effort(s):
    return s.u.torque**2


def problem(model, **changes):
    given = {
        "model": model,
        "horizon": (0.0, 2.0),
        "initial": {"angle": 0.0, "speed": 0.0},
        "final": {"angle": 1.8, "speed": 0.0},
        "bounds": {"torque": (-6.0, 6.0)},
        "cost": effort,
        "name": "swing up",
    }
    return dfsm.OptimalControlProblem(**(given | changes))


def first_runs(count=4):
    return PENDULUM.campaign(
        count,
        TIME,
        dfsm.Uniform(low=(-0.5, -0.5), high=(0.5, 0.5)),
        dfsm.RandomKnots(low=(-2,), high=(2,), spacing=0.3),
    )


def fitted(corrective):
    def fit(runs):
        states = (dfsm.StateSpec(name="angle"), dfsm.StateSpec(name="speed"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", dfsm.DfsmWarning)
            return dfsm.fit(
                runs,
                dfsm.FitSettings(
                    states=states,
                    controls=("torque",),
                    corrective=corrective,
                    nonlinear_only=False,
                ),
            ).model

    return fit


def simulated(found):
    controls = found.trajectory.select(["torque"]).channels
    torque = dfsm.Trajectory(TIME, found.at(TIME / 2)[1], controls)
    start = found.trajectory.select(["angle", "speed"]).values[0]
    return PENDULUM.simulate(TIME, start, torque, name="optimum")


@pytest.fixture(scope="module")
def truth():
    return dfsm.solve(problem(PENDULUM), METHOD, simulate=False)


# -- the loop -----------------------------------------------------------------------------------


def test_the_loop_finds_the_optimum_of_the_true_system(truth):
    options = dfsm.AdaptiveSettings(method=METHOD, most_rounds=8)
    runs = first_runs()
    result = dfsm.optimize_adaptively(
        runs, fitted(dfsm.GP(samples=60)), problem, simulated, options
    )
    assert result.status is Agreement.AGREED, result.summary()
    assert result.simulations == len(result.rounds) == result.best + 1 > 1
    # The first surrogate has never seen such angles.
    assert result.rounds[0].difference > 0.1
    assert result.rounds[-1].difference <= 0.01
    assert result.solution.objective == pytest.approx(truth.objective, rel=0.02)
    assert list(result.runs[: len(runs)]) == runs
    assert result.runs[-1] is result.rounds[-1].run
    assert len(runs) == 4  # what was given stays as it was
    assert f"{result.simulations} true simulations" in result.summary()
    assert "round 1: predicted" in result.summary()
    assert "(best)" in result.summary().splitlines()[-1]


def test_a_surrogate_that_cannot_know_better_is_said_not_to_agree():
    options = dfsm.AdaptiveSettings(method=METHOD, most_rounds=2)
    result = dfsm.optimize_adaptively(
        first_runs(), fitted(dfsm.NoCorrection()), problem, simulated, options
    )
    assert result.status is Agreement.LIMIT
    assert "raise most_rounds" in result.message
    assert result.solution is result.rounds[result.best].solution
    assert result.rounds[result.best].difference == min(r.difference for r in result.rounds)


def test_a_problem_without_a_feasible_point_is_said_to_be():
    options = dfsm.AdaptiveSettings(method=METHOD, most_rounds=1)
    result = dfsm.optimize_adaptively(
        first_runs(),
        fitted(dfsm.NoCorrection()),
        lambda model: problem(model, bounds={"torque": (-0.01, 0.01)}),
        simulated,
        options,
    )
    assert result.status is Agreement.UNSOLVED
    assert result.simulations == 1
    assert "no feasible point was found" in result.summary()


def test_the_price_of_a_miss_is_what_ending_there_costs_less(truth):
    run = simulated(truth)
    exact = realised(problem(PENDULUM), truth, run)
    assert exact.cost == pytest.approx(truth.objective, rel=1e-3)
    assert abs(exact.price) <= exact.at_most < 1e-2 * truth.objective
    step = 1e-3
    values = np.array(run.values)
    values[-1, run.column("angle")] += step
    moved = dfsm.Trajectory(run.time, values, run.channels)
    missed = realised(problem(PENDULUM), truth, moved)
    assert missed.miss["angle"] == pytest.approx(exact.miss["angle"] + step)
    ends = [
        dfsm.solve(
            problem(PENDULUM, final={"angle": 1.8 + d, "speed": 0.0}), METHOD, simulate=False
        ).objective
        for d in (-step, step)
    ]
    slope = (ends[1] - ends[0]) / (2 * step)
    assert missed.price - exact.price == pytest.approx(-slope * step, rel=1e-2)
    wanted = {"angle": (1.0, 2.0)}
    assert realised(problem(PENDULUM, final=wanted), truth, moved).miss == {"angle": 0.0}


def test_runs_and_problems_that_do_not_fit_earn_a_sentence(truth):
    run = simulated(truth)
    with pytest.raises(dfsm.DfsmError, match="expected the solution's 0 s to 2 s"):
        realised(problem(PENDULUM), truth, run.window(0, 1.5))
    with pytest.raises(dfsm.DfsmError, match="no channel 'torque'"):
        realised(problem(PENDULUM), truth, run.select(["angle", "speed"]))
    for name, value in (("tolerance", 0.0), ("most_rounds", 0)):
        with pytest.raises(dfsm.DfsmError, match=name):
            dfsm.AdaptiveSettings(**{name: value})


# -- the studies --------------------------------------------------------------------------------


def test_the_robot_of_the_adaptive_study():
    robot = adaptive_robot.problem(adaptive_robot.ROBOT)
    found = dfsm.solve(robot, adaptive_robot.METHOD, simulate=False)
    assert found.objective == pytest.approx(5.2337355, rel=1e-6)
    costs = realised(robot, found, adaptive_robot.simulated(found))
    assert costs.cost + costs.price == pytest.approx(found.objective, rel=1e-3)
    assert len(adaptive_robot.training_runs(3, 0)) == 3


def test_the_arm_of_the_codesign_study():
    def solved(*mass):
        return dfsm.solve(codesign.problem(codesign.ARM, *mass), METHOD, simulate=False)

    truth = solved()
    best = truth.parameters["m2"]
    assert 2.4 < best < 2.6
    costs = [solved(m).objective for m in (best, 2.3, 2.7)]
    assert costs[0] == pytest.approx(truth.objective, rel=1e-6)
    assert min(costs[1:]) > 1.002 * truth.objective


def test_mass_and_torques_on_a_small_surrogate():
    size = codesign.CodesignSettings(runs=6, masses=3)
    runs = codesign.training_runs(size, 0)
    assert len(runs) == 18
    assert {float(r["m2"][0]) for r in runs} == {2.0, 2.5, 3.0}
    model = codesign.surrogate(runs, dfsm.GP(samples=60))
    with hushed():  # how far the optimum strays from so few runs differs between machines
        found = dfsm.solve(codesign.problem(model), METHOD, simulate=False)
    assert found.solved
    assert 2.0 <= found.parameters["m2"] <= 3.0


@pytest.mark.slow
def test_the_example_tells_what_both_studies_found(monkeypatch, capsys):
    example = example_module("robot/study")
    arm = codesign.CodesignSettings(runs=4, masses=3, corrective=dfsm.GP(samples=40))
    turn = adaptive_robot.AdaptiveRobotSettings(
        runs=4,
        corrective=dfsm.GP(samples=40),
        loop=dfsm.AdaptiveSettings(most_rounds=1, method=adaptive_robot.METHOD),
    )
    monkeypatch.setattr(codesign, "CodesignSettings", lambda: arm)
    monkeypatch.setattr(adaptive_robot, "AdaptiveRobotSettings", lambda: turn)
    example.main(["--seed", "1"])
    out = capsys.readouterr().out
    assert "on a surrogate of 12 runs" in out
    assert "truth: m2 = 2.4967 kg, cost 0.98313" in out
    assert "from 4 runs:" in out
    assert "round 1: predicted" in out
    assert "truth: 5.23374" in out

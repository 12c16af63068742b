"""Closed loops, sweeps and tunings tell in one sentence what they cannot take, from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import dfsm
from dfsm.controllers.actuator import Actuator
from dfsm.controllers.pid import PID
from dfsm.controllers.sensor import Sensor
from dfsm.controllers.state_space import StateFeedback, StateSpace
from dfsm.errors import DfsmError
from dfsm.loops.sweep import gain_grid
from dfsm.loops.trust_region import TrustSettings
from dfsm.loops.truth import FlownRuns, SystemTruth
from dfsm.loops.tuning import TuningTask
from dfsm.loops.tuning_problem import Goal, Limit, TuneSettings, TuningProblem
from systems import driving_run, linear_model

NAMES = {
    "measurements": ["q"], "measurement_units": ["m"],
    "commands": ["u0"], "command_units": ["N"], "interval": 0.1,
}  # fmt: skip
PI = PID(kp=0.4, ki=0.1, setpoint=0.2, **NAMES)
TIME = np.arange(0, 12.01, 0.1)
AT_ONCE = dfsm.ClosedLoopSettings(start_up=0.0)
STD = Goal(measure="std", channel="q")
ASKED = TuningProblem(parameters={"kp": (0.1, 2.0)}, objective=(STD,))
NAN = float("nan")


@pytest.fixture(scope="module")
def model():
    A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0], [2.0]])
    return linear_model(A, B, names=["q", "v"])


def run_of(model, name="run"):
    return driving_run(model, TIME, 0 * TIME[:, None], np.tile((1.0, 0.0), (len(TIME), 1)), name)


def own(**changes):
    """A controller of one's own, with parts that are changed, or left out where they are None."""
    parts = NAMES | {"start": lambda m, c: 0.0, "step": lambda s, m, t: (s, [0.1])} | changes
    return SimpleNamespace(**{name: part for name, part in parts.items() if part is not None})


def test_an_own_controller_that_is_one_closes_the_loop(model):
    with dfsm.errors.hushed():
        found = dfsm.closed_loop(model, run_of(model), own(), settings=AT_ONCE)
    assert found.status is dfsm.LoopStatus.COMPLETED


NOT_CONTROLLERS = [
    ("DISCON.IN", "is 'DISCON.IN', expected a controller: dfsm.read_rosco reads"),
    (Path("DISCON.IN"), "is the path 'DISCON.IN', expected a controller"),
    (42, "no controller: 42 has no measurements, measurement_units, "),
    (None, "no controller: None has no measurements"),
    (PID, r"is the class PID, expected an object of it: PID\(…\)"),
    (own(measurement_units=None), "SimpleNamespace has no measurement_units, and a controller"),
    (own(step=None), "has no step, and"),
    (own(step=3), "step is 3, expected a method"),
    (own(measurements="q"), "measurements is 'q', expected a list of texts"),
    (own(measurements=[], measurement_units=[]), "measurements is empty, expected at least one"),
    (own(command_units=[]), r"command_units is \[\], expected one for each of the commands"),
    (own(measurement_units=[None]), r"measurement_units is \[None\], expected a list of texts"),
    (own(commands=["u0"] * 2, command_units=["N"] * 2), "commands is .* expected each one once"),
    *[
        (own(interval=v), rf"interval is {t}, expected seconds, more than 0")
        for v, t in ((0.0, "0.0"), (-0.1, "-0.1"), (NAN, "nan"), ("0.1", "'0.1'"), (True, "True"))
    ],
]


@pytest.mark.parametrize(("law", "sentence"), NOT_CONTROLLERS)
def test_what_a_controller_is_has_one_check(model, law, sentence):
    run = run_of(model)
    for use in (
        lambda: dfsm.closed_loop(model, run, law, settings=AT_ONCE),
        lambda: dfsm.prepare_loop(model, [run], law, settings=AT_ONCE),
        lambda: dfsm.validate_closed_loop(model, [run], law, settings=AT_ONCE),
        lambda: dfsm.sweep(model, [run], {"a": law}),
        lambda: dfsm.tune(model, [run], law, ASKED),
        lambda: gain_grid(law, {}),
        lambda: Actuator(law, corner=1.0),
        lambda: Sensor(law, delay=0.1),
    ):
        with pytest.raises(DfsmError, match=sentence):
            use()


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: replace(PI, kp="2"), "kp is '2', expected a number"),
        (lambda: replace(PI, kp=None), "kp is None, expected a number"),
        (lambda: replace(PI, ki=NAN), "ki is nan, expected a finite number"),
        (lambda: replace(PI, setpoint=np.inf), "setpoint is inf, expected a finite number"),
        (lambda: replace(PI, smoothing=NAN), "smoothing is nan, expected seconds, at least 0"),
        (lambda: replace(PI, interval=NAN), "interval is nan, expected seconds"),
        (lambda: replace(PI, measurement_units=[]), r"measurement_units is \(\), expected one for"),
        (lambda: replace(PI, measurements="q"), "measurements is 'q', expected a list of texts"),
        (lambda: replace(PI, limits=(0.0, NAN)), r"limits is \(0.0, nan\), expected the lower"),
        (lambda: replace(PI, limits=1.0), "limits is 1.0, expected the lower"),
        (lambda: replace(PI, limits=(0.0, "9")), "limits is '9', expected a number"),
        (lambda: Actuator(PI, corner=0.0), "corner is 0.0, expected rad/s, more than 0"),
        (lambda: Actuator(PI, corner=NAN), "corner is nan, expected rad/s, more than 0"),
        (lambda: Actuator(PI, corner="1"), "corner is '1', expected a number"),
        (lambda: Actuator(PI, corner=1.0, damping=-0.5), "damping is -0.5, expected at least 0"),
        (lambda: Actuator(PI, rate=NAN), "rate is nan, expected more than 0"),
        (lambda: Actuator(PI, limits=(NAN, 1.0)), "limits is .* the lower one first"),
        (lambda: Actuator(PI, acts_on="u0"), "acts_on is 'u0', expected a list of texts"),
        (lambda: Sensor(PI, corner=-1.0), "corner is -1.0, expected rad/s, more than 0"),
        (lambda: Sensor(PI, noise=-1.0), "noise is -1.0, expected at least 0"),
        (lambda: Sensor(PI, noise=NAN), "noise is nan, expected at least 0"),
        (lambda: Sensor(PI, delay=NAN), "delay is nan, expected seconds, at least 0"),
        (lambda: Sensor(PI, delay=np.inf), "delay is inf, expected seconds, at least 0"),
        (lambda: Sensor(PI, seed=0.5), "seed is 0.5, expected a whole number"),
        (lambda: Sensor(PI, seed=1.0), "seed is 1.0, expected a whole number"),
        (lambda: dfsm.read_rosco(42, interval=0.1), "path is 42, expected the path of a DISCON.IN"),
        (lambda: dfsm.BladedLibrary(42, interval=0.1), "library is 42, expected the path"),
        (lambda: StateSpace([[NAN]], [[1]], [[1]], [[0]], **NAMES), "A is nan, expected a finite"),
        (lambda: StateSpace(1.0, [[1]], [[1]], [[0]], **NAMES), r"A of shape is \(\), expected"),
        (
            lambda: StateFeedback([[1]], [0], [0], integral_gain=[[1, 2]], **NAMES),
            r"integral_gain of shape is \(1, 2\), expected shape \(1, 1\)",
        ),
        (
            lambda: StateFeedback([[1]], [0], [0], limits=(1, 0), **NAMES),
            r"limits is \(1, 0\), expected the lower one first",
        ),
    ],
)
def test_numbers_of_controllers_are_what_they_must_be(make, sentence):
    with pytest.raises(DfsmError, match=sentence):
        make()


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: dfsm.ClosedLoopSettings(start_up=NAN), "start_up is nan, expected seconds"),
        (lambda: dfsm.ClosedLoopSettings(start_up="60"), "start_up is '60', expected seconds"),
        (lambda: dfsm.ClosedLoopSettings(step=np.inf), "step is inf, expected seconds"),
        (lambda: dfsm.SweepSettings(speed="q", rated_speed=0.0), "rated_speed is 0.0, expected"),
        (lambda: dfsm.SweepSettings(speed="q", rated_speed=NAN), "rated_speed is nan, expected"),
        (lambda: dfsm.SweepSettings(power=3), "power is 3, expected the name of a signal"),
        (lambda: dfsm.SweepSettings(block=np.inf), "block is inf, expected seconds"),
        (lambda: dfsm.SweepSettings(years=NAN), "years is nan, expected more than 0"),
        (lambda: dfsm.SweepSettings(start=NAN), "start is nan, expected seconds, or None"),
        (lambda: dfsm.SweepSettings(loop={}), r"loop is \{\}, expected dfsm.ClosedLoopSettings"),
        (lambda: dfsm.SweepSettings(extremes="q"), "extremes is 'q', expected a list of texts"),
        (lambda: Limit(measure="std", channel="q", at_most=NAN), "at_most of std of q is nan"),
        (lambda: Limit(measure="std", channel="q", at_least="1"), "at_least of std of q is '1'"),
        (lambda: Limit(measure="std", channel="q", at_most=np.inf), "at_most of std of q is inf"),
        (lambda: replace(STD, measure=None), "measure is None, expected one of mean, std"),
        (lambda: replace(STD, weight="1"), "weight of std of q is '1', expected a number"),
        (lambda: replace(STD, scale=np.inf), "scale of std of q is inf, expected more than 0"),
        (lambda: replace(STD, exponent=np.inf), "exponent is inf, expected at least 1"),
        (
            lambda: Goal(measure="overshoot", channel="q", reference=NAN),
            "reference of overshoot of q is nan, expected a value that is not 0",
        ),
        (lambda: replace(ASKED, weights=[1.0, NAN]), "one of the weights is nan, expected a"),
        (lambda: replace(ASKED, weights=[]), r"weights is \[\], expected one per run"),
        (lambda: replace(ASKED, parameters=["kp"]), r"parameters is \['kp'\], expected bounds"),
        (lambda: replace(ASKED, parameters={3: (0, 1)}), r"names of parameters is \[3\], expected"),
        (lambda: replace(ASKED, parameters={"kp": 1.0}), "bounds of kp is 1.0, expected two"),
        (lambda: replace(ASKED, parameters={"kp": (1, NAN)}), "one of the bounds of kp is nan"),
        (lambda: replace(ASKED, objective=STD), "objective is .* expected a list of dfsm.Goal"),
        (lambda: replace(ASKED, constraints=[STD]), r"a term of the constraints is .*dfsm.Limit"),
        (lambda: TuneSettings(starts=1.5), "starts is 1.5, expected a whole number"),
        (lambda: TuneSettings(starts=2.0), "starts is 2.0, expected a whole number"),
        (lambda: TuneSettings(seed=-1), "seed is -1, expected a whole number"),
        (lambda: TuneSettings(tolerance=NAN), "tolerance is nan, expected between 0 and 1"),
        (lambda: TuneSettings(pareto=1), "pareto is 1, expected 0, or a whole number from 2 on"),
        (lambda: TrustSettings(radius="1"), "radius is '1', expected above 0, up to 1"),
        (lambda: dfsm.weibull_weights([8, NAN, 12], mean=9), "one of the winds is nan"),
        (lambda: dfsm.weibull_weights(8, mean=9), "winds is 8, expected one for every run"),
        (lambda: dfsm.weibull_weights([8, 12], mean=NAN), "mean is nan, expected m/s"),
        (lambda: FlownRuns(3), "folder is 3, expected the path of a folder"),
        (lambda: SystemTruth("turbine"), "system is 'turbine', expected a dfsm.ODESystem"),
    ],
)
def test_settings_of_loops_are_what_they_must_be(make, sentence):
    with pytest.raises(DfsmError, match=sentence):
        make()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"model": "model"}, "model is 'model', expected a model: dfsm.load reads one"),
        ({"runs": "run.csv"}, "runs is 'run.csv', expected runs: dfsm.read reads one"),
        ({"runs": Path("run.csv")}, "runs is the path 'run.csv', expected runs"),
        ({"runs": ["run.csv"]}, "one of the runs is 'run.csv', expected runs"),
        ({"runs": 3}, "runs is 3, expected runs"),
        ({"runs": []}, "no runs were given"),
        ({"measurements": ["q"]}, r"measurements is \['q'\], expected names of the model's"),
        ({"measurements": {"q": 3}}, "measurements: q is 3, expected the name of a signal"),
        ({"settings": {"start_up": 0}}, r"settings is \{'start_up': 0\}, expected dfsm\."),
    ],
)
def test_what_a_loop_is_closed_with_is_what_it_must_be(model, changes, sentence):
    asked = {"model": model, "runs": [run_of(model)]} | changes
    for use in (
        lambda: dfsm.closed_loop(controller=PI, **asked),
        lambda: dfsm.prepare_loop(controller=PI, **asked),
        lambda: dfsm.validate_closed_loop(controller=PI, **asked),
        lambda: dfsm.sweep(controllers={"a": PI}, **asked),
        lambda: dfsm.tune(controller=PI, problem=ASKED, **asked),
    ):
        with pytest.raises(DfsmError, match=sentence):
            use()


def test_a_time_window_lies_within_the_run(model):
    run = run_of(model)
    for window, sentence in (
        (
            {"start": 500.0},
            r"run.csv: start is 500 s, expected a time within the run, from 0 to 12 s:",
        ),
        ({"stop": -1.0}, "stop is -1 s, expected a time within the run"),
        ({"start": NAN}, "start is nan, expected seconds"),
        ({"stop": "9"}, "stop is '9', expected seconds"),
        ({"start": 9.0, "stop": 5.0}, "goes from 9 s to 5 s: swap the two"),
    ):
        with pytest.raises(DfsmError, match=sentence):
            dfsm.closed_loop(model, run, PI, **window)


def test_what_a_sweep_compares_has_names_of_its_own(model):
    runs = [run_of(model)]
    for controllers, sentence in (
        ([PI], r"controllers is .* expected controllers by name"),
        ({}, "no controllers were given"),
        ({"recorded": PI}, "the name of a controller is 'recorded', expected a text, and not"),
        ({3: PI}, "the name of a controller is 3, expected a text"),
        ({"a": 42}, "controller 'a' is no controller: 42 has no"),
    ):
        with pytest.raises(DfsmError, match=sentence):
            dfsm.sweep(model, runs, controllers)
    with pytest.raises(DfsmError, match="one of the weights is nan"):
        dfsm.sweep(model, [*runs, *runs], {"a": PI}, weights=[1.0, NAN])
    # Values that agree in the digits that are shown are two values nevertheless.
    assert list(gain_grid(PI, {"kp": [1, 2.0]})) == ["as it is", "kp 1", "kp 2"]
    close = gain_grid(PI, {"kp": [1.0, 1.00000001]})
    assert list(close) == ["as it is", "kp 1.0", "kp 1.00000001"]
    for values, sentence in (
        ([1, 1.0], r"values of kp is \[1, 1.0\], expected a list of numbers, each once"),
        ([1, NAN], "a value of kp is nan, expected a list of numbers"),
        (["1"], "a value of kp is '1', expected a list of numbers"),
        (2.0, "values of kp is 2.0, expected a list of numbers"),
        ([], "values of kp is none, expected at least one"),
    ):
        with pytest.raises(DfsmError, match=sentence):
            gain_grid(PI, {"kp": values})


def test_flown_runs_have_names_of_their_own(model, tmp_path):
    runs = [
        replace(run_of(model, n), source=f"{n}/{f}.csv") for n, f in (("a", "Run"), ("b", "run"))
    ]
    runs = [replace(run, name=Path(run.source).stem) for run in runs]
    task = TuningTask(model, runs, PI, ASKED, None, None, TuneSettings(loop=AT_ONCE))
    with pytest.raises(DfsmError, match=r"a/Run.csv and b/run.csv would both be looked for as .*"):
        dfsm.tune_with_truth(task, FlownRuns(tmp_path / "flown"))
    assert not (tmp_path / "flown").exists()


def test_a_tuning_is_confirmed_by_what_flies_and_given_what_it_tunes(model):
    task = TuningTask(model, [run_of(model)], PI, ASKED, None, None, TuneSettings(loop=AT_ONCE))
    for truth in ("flown", FlownRuns):
        with pytest.raises(DfsmError, match=r"expected a truth, which has a method run\(case\)"):
            dfsm.tune_with_truth(task, truth)
    with pytest.raises(DfsmError, match="value of kp is None, expected a number"):
        task.given({})


def test_a_table_has_loads_that_were_counted(model):
    swept = dfsm.sweep(model, [run_of(model)], {"a": PI}, settings=dfsm.SweepSettings(loop=AT_ONCE))
    with pytest.raises(DfsmError, match=r"exponent is 5\.5, expected one of 3, 4, 5, 10"):
        swept.table(5.5)


class _Leaves(eqx.Module):
    """All its fields are leaves, names and interval too."""

    kp: float = 0.4
    interval: float = 0.1
    measurements: tuple[str, ...] = ("q",)
    measurement_units: tuple[str, ...] = ("m",)
    commands: tuple[str, ...] = ("u0",)
    command_units: tuple[str, ...] = ("N",)

    def start(self, measurements, commands):
        return ()

    def step(self, state, measurements, time):
        return state, jnp.array([-self.kp * measurements[0]])


def test_names_and_interval_may_be_leaves_of_a_module(model):
    run = run_of(model)
    for law, name in ((_Leaves(), "kp"), (Actuator(_Leaves(), corner=8.0), "inner.kp")):
        with dfsm.errors.hushed():
            found = dfsm.closed_loop(model, run, law, settings=AT_ONCE)
        assert found.status is dfsm.LoopStatus.COMPLETED
        asked = replace(ASKED, parameters={name: (0.1, 2.0)})
        own = TuneSettings(loop=AT_ONCE, iterations=2)
        tuned = dfsm.tune(model, [run], law, asked, settings=own)
        assert tuned.objective < tuned.before_objective


def test_a_regulator_names_its_interval_and_what_is_accepted(model):
    point = dfsm.SteadyState(*[np.zeros(2), np.zeros(1), *[np.zeros(0)] * 4], 0.0, True, "")
    asked = {"states": {"q": 1.0}, "controls": {"u0": 1.0}, "interval": 0.1}
    assert dfsm.linear_quadratic(model, point, **asked).interval == 0.1
    for changes, sentence in (
        ({"interval": 0.0}, "interval is 0.0, expected seconds, more than 0"),
        ({"interval": NAN}, "interval is nan, expected seconds"),
        ({"states": {"q": NAN}}, "states: q is nan, expected a deviation above 0"),
        ({"controls": {"u0": np.inf}}, "controls: u0 is inf, expected a deviation above 0"),
        ({"states": ["q"]}, r"states is \['q'\], expected the deviation"),
    ):
        with pytest.raises(DfsmError, match=sentence):
            dfsm.linear_quadratic(model, point, **(asked | changes))


class _Decides(PID):
    def step(self, state, measurements, time):
        return state, jnp.array([1.0 if measurements[0] > 0 else 0.0])


def test_numbers_that_are_no_fields_cannot_be_gains():
    sentence = "SimpleNamespace has no numbers that could be replaced by name, as 'kp': declare"
    with pytest.raises(DfsmError, match=sentence):
        gain_grid(own(kp=1.0), {"kp": [1.0, 2.0]})


def test_a_step_that_jax_cannot_follow_is_told_with_a_cure(model):
    law = _Decides(kp=1.0, ki=0.0, setpoint=0.0, **NAMES)
    with pytest.raises(DfsmError, match=r"step fails with Tracer.*jnp.where in place of if"):
        dfsm.closed_loop(model, run_of(model), law, settings=AT_ONCE)


def test_a_measurement_that_is_misspelt_names_what_was_meant():
    model = linear_model(-np.eye(1), np.ones((1, 1)), names=["GenSpeed"])
    law = PID(
        kp=0.4, ki=0.1, setpoint=0.2, measurements=["Genspeed"], measurement_units=["m"],
        commands=["u0"], command_units=["N"], interval=0.1,
    )  # fmt: skip
    run = driving_run(model, TIME, 0 * TIME[:, None], np.ones((len(TIME), 1)), "run")
    with pytest.raises(DfsmError, match=r"does not have; did you mean 'GenSpeed'\?: fit it with"):
        dfsm.closed_loop(model, run, law, settings=AT_ONCE)

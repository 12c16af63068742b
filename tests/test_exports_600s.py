"""Models with hidden states for 600 s in other programs, inputs held, on lines and on splines."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from shutil import which
from typing import Any

import casadi
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import dfsm as package
from dfsm.core.types import Array
from dfsm.data.between import polynomials
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import hushed
from dfsm.exports.c_code import write_c
from dfsm.exports.fmu import write_fmu
from dfsm.exports.functions import description
from dfsm.exports.python_model import write_python
from dfsm.models.dfsm import DFSM
from exported import close, hidden

needs_compiler = pytest.mark.skipif(which("cc") is None, reason="needs a C compiler")
TIME, START = np.arange(0, 600.1, 0.2), [0.3, -0.2, 0.1]
KINDS = {"polynomial": ("hold", "cubic"), "tanh": ("linear", "cubic")}
STEP = 0.1  # of the model: two per sample


@cache
def model_of(kind: str) -> DFSM:
    """A control that is held or goes on a line, and a disturbance on a spline."""
    model = hidden(kind)
    control, other = model.signals.controls
    signals = replace(
        model.signals,
        controls=(control,),
        disturbances=(replace(other, role="disturbance"),),
        between=KINDS[kind],
    )
    return replace(model, signals=signals)


def inputs() -> Array:
    """The control stays for seconds; the disturbance is fast beside its samples."""
    wave = np.cos(5.1 * TIME) + 0.5 * np.sin(1.3 * TIME)
    return np.stack([np.repeat(np.sin(np.arange(len(TIME) // 10 + 1.0)), 10)[: len(TIME)], wave], 1)


@cache
def along(kind: str) -> tuple[Array, Array, Array]:
    """States, outputs and distances of `simulate`."""
    model = model_of(kind)
    channels = (Channel("u0", "N"), Channel("u1", "N"))
    with hushed():
        run = package.simulate(model, Trajectory(TIME, inputs(), channels), initial=START)
    states, outputs = (
        run.trajectory.select(model.signals.names(g)).values for g in ("states", "outputs")
    )
    low, high = (np.asarray(v) for v in (model.region.low, model.region.high))
    vectors = np.hstack([inputs(), states])
    return states, outputs, np.abs((vectors - (low + high) / 2) / (high - low) * 2).max(axis=1)


def at(kind: str) -> Callable[[float, int], Array]:
    """The inputs at a time within an interval, by its first sample."""
    c = polynomials(TIME, inputs(), KINDS[kind])
    return lambda since, k: c[3, k] + since * (c[2, k] + since * (c[1, k] + since * c[0, k]))


def marched(f: Callable[..., Array], kind: str, samples: int = len(TIME)) -> Array:
    """RK4 in the model's steps of some derivative of time, states and inputs."""
    u, x, path = at(kind), np.array(START), [np.array(START)]
    for k in range(samples - 1):
        for since in (0.0, STEP):
            values = [u(since + share * STEP, k) for share in (0.0, 0.5, 1.0)]
            k1 = f(TIME[k] + since, x, values[0])
            k2 = f(TIME[k] + since + STEP / 2, x + STEP / 2 * k1, values[1])
            k3 = f(TIME[k] + since + STEP / 2, x + STEP / 2 * k2, values[1])
            k4 = f(TIME[k] + since + STEP, x + STEP * k3, values[2])
            x = x + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        path.append(x)
    return np.stack(path)


def test_what_the_model_is_compared_at():
    for kind, between in KINDS.items():
        told = description(model_of(kind))
        assert told["step"] == pytest.approx(STEP)
        entries = [*told["controls"], *told["disturbances"]]
        assert tuple(e["between_samples"] for e in entries) == between
        assert along(kind)[0].std(axis=0).min() > 0.05
    # A line instead of the spline is another drive by far.
    middle = (inputs()[1:, 1] + inputs()[:-1, 1]) / 2
    smooth = CubicSpline(TIME, inputs()[:, 1])((TIME[1:] + TIME[:-1]) / 2)
    assert np.abs(smooth - middle).max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_numpy_alone(kind, tmp_path, monkeypatch):
    write_python(model_of(kind), tmp_path / "light")
    monkeypatch.syspath_prepend(tmp_path / "light")
    monkeypatch.delitem(sys.modules, "run_model", raising=False)
    from run_model import Model  # pyright: ignore[reportMissingImports]

    light, (states, outputs, distances) = Model(tmp_path / "light" / "model.npz"), along(kind)
    x, y = light.simulate(TIME, START, inputs()[:, :1], inputs()[:, 1:])
    close(x, states, 1e-9)
    close(y, outputs, 1e-9)
    k = int(np.argmax(distances))
    told = light.distance(states[k], inputs()[k, :1], inputs()[k, 1:])
    assert told == pytest.approx(distances[k], rel=1e-12)
    with pytest.raises(ValueError, match="times go back"):
        light.simulate(TIME[::-1], START, inputs()[:, :1], inputs()[:, 1:])


@pytest.mark.parametrize("kind", KINDS)
def test_casadi(kind):
    made, (states, outputs, distances) = package.to_casadi(model_of(kind)), along(kind)
    x, v = casadi.MX.sym("x", 3), casadi.MX.sym("v", 10)

    def f(x: Any, place: int) -> Any:
        return made.f(x, v[2 * place], v[2 * place + 1], [])

    new, rows = x, []
    for first in (0, 2):  # the model's two steps in a sample
        k1 = f(new, first)
        k2 = f(new + STEP / 2 * k1, first + 1)
        k3 = f(new + STEP / 2 * k2, first + 1)
        k4 = f(new + STEP * k3, first + 2)
        new = new + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    u = at(kind)
    rows = [np.concatenate([u(s * STEP / 2, k) for s in range(5)]) for k in range(len(TIME) - 1)]
    path = casadi.Function("s", [x, v], [new]).mapaccum(len(rows))(START, np.array(rows).T)
    close(np.array(path).T, states[1:], 1e-9)
    columns = (states.T, inputs()[:, :1].T, inputs()[:, 1:].T, np.zeros((0, len(TIME))))
    close(np.array(made.g.map(len(TIME))(*columns)).T, outputs, 1e-9)
    close(np.array(made.distance.map(len(TIME))(*columns)).ravel(), distances, 1e-9)


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_c(kind, tmp_path):
    write_c(model_of(kind), tmp_path / "plant")
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1"]
    command = ["cc", *strict, "-shared", "-fPIC", "-o", "plant.so", "plant/plant.c", "-lm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(tmp_path / "plant.so"))

    def pointer(values: Array) -> Any:
        return values.ctypes.data_as(ctypes.c_void_p)

    (states, outputs, distances), path = along(kind), np.zeros((len(TIME), 3))
    path[0] = START
    u, w = (np.ascontiguousarray(inputs()[:, k]) for k in (0, 1))
    driven = (pointer(u), pointer(w), None)
    assert library.plant_simulate(len(TIME), pointer(TIME), *driven, pointer(path)) == 0
    close(path, states, 1e-9)
    y, d = np.zeros(1), np.zeros(1)
    for k in range(0, len(TIME), 100):
        here = (pointer(path[k]), pointer(u[k:]), pointer(w[k:]), None)
        assert library.plant_output(*here, pointer(y)) == 0
        assert library.plant_distance(*here, pointer(d)) == 0
        np.testing.assert_allclose([y[0], d[0]], [outputs[k, 0], distances[k]], rtol=1e-9)
    back = TIME[::-1].copy()
    assert library.plant_simulate(3, pointer(TIME), *driven, pointer(path)) == 2  # no spline
    assert library.plant_simulate(9, pointer(back), *driven, pointer(path)) == 2
    assert library.plant_simulate(1, pointer(TIME), *driven, pointer(path)) == 0


# -- FMUs ---------------------------------------------------------------------------------------


def unpacked(kind: str, fmi: int, folder: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """What FMPy opens an FMU by, and value references by name."""
    fmpy = pytest.importorskip("fmpy")
    made = write_fmu(model_of(kind), folder / "plant.fmu", fmi=fmi)
    extracted = fmpy.extract(str(made.path), str(folder / "unpacked"))
    about = fmpy.read_model_description(extracted, validate=True)
    refs = {v.name: v.valueReference for v in about.modelVariables}
    opened = {"guid": about.guid, "unzipDirectory": extracted, "modelIdentifier": "plant"}
    return opened, refs


def ran(function: Callable[..., Any], *arguments: Any) -> Any:
    """FMPy raises on errors, and returns a status only of some functions."""
    result = function(*arguments)
    assert result in (None, 0), (function, result)
    return result


NAMES = (("y", "hidden1", "hidden2"), ("u0", "u1"), ("y0", "training_distance"))


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_co_simulation_with_derivatives_of_the_inputs(kind, tmp_path):
    pytest.importorskip("fmpy")
    from fmpy.fmi2 import FMU2Slave

    opened, refs = unpacked(kind, 2, tmp_path)
    slave: Any = FMU2Slave(**opened, instanceName="slave")
    x, u, y = ([refs[n] for n in names] for names in NAMES)
    slave.instantiate()
    ran(slave.setupExperiment)
    ran(slave.enterInitializationMode)
    ran(slave.setReal, x, START)
    ran(slave.setReal, u, list(inputs()[0]))
    ran(slave.exitInitializationMode)
    c, path, seen = polynomials(TIME, inputs(), KINDS[kind]), [], []
    for k in range(len(TIME) - 1):
        ran(slave.setReal, u, list(inputs()[k]))
        path.append(slave.getReal(x))
        seen.append(slave.getReal(y))
        orders, derivatives = [1, 1, 2, 2, 3, 3], [*c[2, k], *2 * c[1, k], *6 * c[0, k]]
        ran(slave.setRealInputDerivatives, u * 3, orders, derivatives)
        ran(slave.doStep, TIME[k], 0.2)
    states, outputs, distances = along(kind)
    close(np.array(path), states[:-1], 1e-9)
    close(np.array(seen), np.stack([outputs[:-1, 0], distances[:-1]], 1), 1e-9)
    with pytest.raises(Exception, match="fmi2SetRealInputDerivatives"):
        slave.setRealInputDerivatives(u[:1], [4], [1.0])
    slave.terminate()
    slave.freeInstance()


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_co_simulation_with_inputs_set_within_steps(kind, tmp_path):
    pytest.importorskip("fmpy")
    from fmpy.fmi3 import FMU3Slave

    opened, refs = unpacked(kind, 3, tmp_path)
    moving = [n for n, b in zip(("u0", "u1"), KINDS[kind], strict=True) if b != "hold"]
    of, places = at(kind), [("u0", "u1").index(n) for n in moving]
    slave: Any = FMU3Slave(**opened, instanceName="slave")
    now, asked = [0], []

    def update(_environment, time, wanted, *_):
        assert wanted
        asked.append(time)
        values = of(time - TIME[now[0]], now[0])[places]
        slave.setFloat64([refs[n] for n in moving], list(values))

    slave.instantiate(
        intermediateUpdate=update, requiredIntermediateVariables=[refs[n] for n in moving]
    )
    x, u, y = ([refs[n] for n in names] for names in NAMES)
    ran(slave.enterInitializationMode)
    ran(slave.setFloat64, x, START)
    ran(slave.exitInitializationMode)
    path, seen = [], []
    for k in range(len(TIME) - 1):
        now[0] = k
        ran(slave.setFloat64, u, list(inputs()[k]))
        path.append(slave.getFloat64(x))
        seen.append(slave.getFloat64(y))
        assert slave.doStep(TIME[k], 0.2)[:3] == (False, False, False)
    states, outputs, distances = along(kind)
    close(np.array(path), states[:-1], 1e-9)
    close(np.array(seen), np.stack([outputs[:-1, 0], distances[:-1]], 1), 1e-9)
    # Two steps of 0.1 s from 0 s on: their ends and middles, once each.
    np.testing.assert_allclose(asked[:5], [0, 0.05, 0.1, 0.15, 0.2], atol=1e-12)
    assert len(asked) == 5 * (len(TIME) - 1)
    slave.terminate()
    slave.freeInstance()


@needs_compiler
def test_an_input_that_is_held_cannot_be_set_within_a_step(tmp_path):
    pytest.importorskip("fmpy")
    from fmpy.fmi3 import FMU3Slave

    opened, refs = unpacked("polynomial", 3, tmp_path)
    slave: Any = FMU3Slave(**opened, instanceName="slave")
    refused = []

    def update(_environment, _time, *_):
        try:
            slave.setFloat64([refs["u0"]], [1.0])
        except Exception as error:
            refused.append(str(error))

    slave.instantiate(intermediateUpdate=update, requiredIntermediateVariables=[refs["u1"]])
    ran(slave.enterInitializationMode)
    ran(slave.exitInitializationMode)
    with pytest.raises(Exception, match="fmi3DoStep"):
        slave.doStep(0.0, 0.2)
    assert len(refused) == 1
    slave.freeInstance()


@needs_compiler
def test_what_cannot_be_set_is_told(tmp_path):
    pytest.importorskip("fmpy")
    from fmpy.fmi3 import FMU3Slave

    opened, refs = unpacked("tanh", 3, tmp_path)
    slave: Any = FMU3Slave(**opened, instanceName="slave")
    logged = []
    slave.instantiate(logMessage=lambda *told: logged.append(told[3].decode()))
    for reference, value, sentence in (
        (999, 1.0, "there is no variable of this value reference"),
        (refs["der(y)"], 1.0, "time, derivatives and outputs are computed"),
        (refs["u0"], np.inf, "a value to set is not finite"),
        (refs["rk4_step"], 0.0, "rk4_step must be above 0 s"),
    ):
        with pytest.raises(Exception, match="fmi3SetFloat64"):
            slave.setFloat64([reference], [value])
        assert logged[-1].startswith(sentence)
    slave.freeInstance()


@needs_compiler
def test_leaving_the_training_data_is_logged_once(tmp_path):
    pytest.importorskip("fmpy")
    from fmpy.fmi3 import FMU3Slave

    opened, refs = unpacked("tanh", 3, tmp_path)
    logged = []
    for logs in (True, False):
        slave: Any = FMU3Slave(**opened, instanceName="slave")
        slave.instantiate(loggingOn=logs, logMessage=lambda *told: logged.append(told[1:]))
        ran(slave.enterInitializationMode)
        ran(slave.exitInitializationMode)
        for k in range(4):
            ran(slave.setFloat64, [refs["u0"]], [9.0 if k < 2 else 11.0])
            assert (slave.getFloat64([refs["training_distance"]])[0] > 1) == (k >= 2)
            slave.doStep(0.2 * k, 0.2)
        slave.freeInstance()
    ((status, category, text),) = logged
    assert (status, category) == (1, b"logStatusWarning")
    assert text == b"the training data are left: training_distance, an output, is above 1"


@needs_compiler
@pytest.mark.parametrize("fmi", [2, 3])
def test_model_exchange(fmi, tmp_path):
    pytest.importorskip("fmpy")
    from fmpy.fmi2 import FMU2Model
    from fmpy.fmi3 import FMU3Model

    opened, refs = unpacked("polynomial", fmi, tmp_path)
    unit: Any = (FMU2Model if fmi == 2 else FMU3Model)(**opened, instanceName="model")
    put = "setReal" if fmi == 2 else "setFloat64"
    rates = "getDerivatives" if fmi == 2 else "getContinuousStateDerivatives"
    driving = [refs["u0"], refs["u1"]]
    unit.instantiate()
    if fmi == 2:
        ran(unit.setupExperiment)
    ran(unit.enterInitializationMode)
    ran(unit.exitInitializationMode)
    ran(unit.enterContinuousTimeMode)
    x, dx = (ctypes.c_double * 3)(), (ctypes.c_double * 3)()

    def f(time: float, states: Array, values: Array) -> Array:
        x[:] = states.tolist()
        ran(unit.setTime, time)
        ran(unit.setContinuousStates, x, 3)
        ran(getattr(unit, put), driving, values.tolist())
        ran(getattr(unit, rates), dx, 3)
        return np.array(dx)

    close(marched(f, "polynomial"), along("polynomial")[0], 1e-9)
    unit.terminate()
    unit.freeInstance()

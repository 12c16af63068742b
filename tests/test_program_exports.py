"""Models as C, as NumPy alone and as FMUs, against the model along points and rollouts."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path
from shutil import which
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import dfsm as package
from dfsm.core.types import Array
from dfsm.errors import DfsmError, hushed
from dfsm.exports.c_code import write_c
from dfsm.exports.fmu import FMU, write_fmu
from dfsm.exports.identifiers import comment, identifier, literal
from dfsm.exports.python_model import write_python
from dfsm.models.model_folder import save
from exported import close, drive, points, turning, whole
from systems import linear_model

needs_compiler = pytest.mark.skipif(which("cc") is None, reason="needs a C compiler")
START = [8.0, 0.2, 0.0, 0.1, -0.1]


@pytest.fixture(scope="module")
def along() -> tuple[dict[str, Array], Array, Array]:
    """Inputs of a run of 600 s by group, and states and outputs of `simulate`."""
    model, run = whole(), drive(whole())
    with hushed():
        simulated = package.simulate(model, run, initial=START).trajectory
    groups = ("controls", "disturbances", "parameters", "field")
    inputs = {g: run.select(model.signals.names(g)).values for g in groups} | {"time": run.time}
    both = (simulated.select(model.signals.names(g)).values for g in ("states", "outputs"))
    states, outputs = both
    return inputs, states, outputs


# -- C ------------------------------------------------------------------------------------------


class Library:
    """The compiled functions, with arrays of NumPy."""

    def __init__(self, file: Path, name: str) -> None:
        self.library, self.name = ctypes.CDLL(str(file)), name

    def __call__(self, function: str, size: int, *values) -> Array:
        result = np.zeros(size)
        arguments = [
            v if isinstance(v, ctypes.c_double) else np.ascontiguousarray(v, dtype=float).ctypes
            for v in [*values, result]
        ]
        given = [
            a if isinstance(a, ctypes.c_double) else a.data_as(ctypes.c_void_p) for a in arguments
        ]
        assert getattr(self.library, f"{self.name}_{function}")(*given) == 0
        return result


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    folder = tmp_path_factory.mktemp("c") / "2 my-turbine"
    made = write_c(whole(), folder)
    assert made.name == "m_2_my_turbine"
    target = folder.parent / "library.so"
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1"]
    command = ["cc", *strict, "-shared", "-fPIC", "-o", target, folder / f"{made.name}.c", "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return Library(target, made.name)


@needs_compiler
def test_c_is_the_model_at_points_and_along_a_rollout(library, along):
    model, groups = whole(), points(whole())
    ours = np.stack([library("derivative", 5, *row) for row in zip(*groups, strict=True)])
    close(ours, np.asarray(model.derivative(*groups)))
    ours = np.stack([library("output", 3, *row) for row in zip(*groups, strict=True)])
    close(ours, np.asarray(model.output(*groups)))
    psi, field = turning(model)
    rows = zip(*groups, map(ctypes.c_double, psi), field, strict=True)
    ours = np.stack([library("output_at_azimuth", 3, *row) for row in rows])
    close(ours, np.asarray(model.output(*groups, azimuth=psi, field=field)))
    inputs, states, _ = along
    x, path = np.array(START), [np.array(START)]
    u, w, p = (inputs[g] for g in ("controls", "disturbances", "parameters"))
    for k, h in enumerate(np.diff(inputs["time"])):
        end = [u[k, 0], u[k + 1, 1]]  # the torque is held
        x = library("step", 5, ctypes.c_double(h), x, u[k], w[k], end, w[k + 1], p[0])
        path.append(x)
    close(np.stack(path), states, 1e-9)


@needs_compiler
def test_c_holds_names_and_units(library):
    def texts(what):
        array = (ctypes.c_char_p * 4).in_dll(library.library, f"{library.name}_{what}")
        return [text.decode() for text in array[:3]]

    assert texts("outputs_names") == ['2"P', "TwrBsMyt", "Yaw"]
    assert texts("states_units") == ["rpm", "m", "m/s"]


def test_names_and_texts_in_c():
    assert [identifier(n) for n in ("a b--c", "3P", "int", "θ")] == [
        "a_b_c",
        "m_3P",
        "int_model",
        "model",
    ]
    assert literal('a"b\\?°') == '"a\\042b\\134\\077\\302\\260"'
    assert "*/" not in comment("end */ of \\")
    assert comment("°/s\n") == "\\xb0/s "


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path):
    (tmp_path / "notes.c").write_text("int mine;")
    for write in (write_c, write_python):
        with pytest.raises(DfsmError, match="not a folder that dfsm wrote"):
            write(whole(), tmp_path)
    assert (tmp_path / "notes.c").read_text() == "int mine;"


# -- NumPy --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("python") / "exported"
    write_python(whole(), folder)
    text = (folder / "run_model.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 200
    assert {line.split()[1] for line in text.splitlines() if line.startswith("import")} == {
        *("json", "math", "sys", "numpy")
    }
    space: dict = {"__name__": "run_model"}
    exec(compile(text, "run_model.py", "exec"), space)
    return space["Model"](folder / "model.npz")


def test_numpy_is_the_model_at_points_and_along_a_rollout(runtime, along):
    model, (psi, field) = whole(), turning(whole())
    groups = points(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        rows = list(zip(*groups, strict=True))
        ours = np.stack([runtime.derivative(*row) for row in rows])
        close(ours, np.asarray(model.derivative(*groups)))
        some = slice(0, 100)
        ours = np.stack([runtime.output(*row) for row in rows[some]])
        close(ours, np.asarray(model.output(*groups))[some])
        ours = np.stack([runtime.output(*rows[k], psi[k], field[k]) for k in range(100)])
        close(ours, np.asarray(model.output(*groups, azimuth=psi, field=field))[some])
    follow(runtime, along, 101)
    assert runtime.names("controls") == ["Gen Torque", "BldPitch1"]
    np.testing.assert_array_equal(runtime.start("parameters"), [1.5])
    with pytest.raises(ValueError, match="states are 2 numbers, expected: RotSpeed, heave"):
        runtime.derivative([1, 2], *rows[0][1:])


def follow(runtime, along, count: int) -> None:
    """A rollout over some samples."""
    (inputs, states, outputs), some = along, slice(0, count)
    x, y = runtime.simulate(
        inputs["time"][some], START, inputs["controls"][some], inputs["disturbances"][some],
        inputs["parameters"][0], np.deg2rad(30), inputs["field"][some],
    )  # fmt: skip
    close(x, states[some], 1e-9)
    close(y, outputs[some], 1e-9)


@pytest.mark.slow
def test_numpy_is_the_model_for_600_s(runtime, along):
    follow(runtime, along, len(along[0]["time"]))


# -- FMUs ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[2, 3])
def fmu(request, tmp_path_factory: pytest.TempPathFactory) -> tuple[int, FMU]:
    path = tmp_path_factory.mktemp("fmu") / "turbine.fmu"
    return request.param, write_fmu(whole(), path, fmi=request.param, step=0.25)


def test_an_fmu_says_what_it_is(fmu):
    _fmi, made = fmu
    with zipfile.ZipFile(made.path) as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        assert {"sources/fmu.c", "sources/turbine.c", "sources/turbine.h"} <= set(
            archive.namelist()
        )
    assert [e.tag for e in root][:2] == ["ModelExchange", "CoSimulation"]
    units = {u.get("name") for u in root.iter("Unit")}
    assert {"rpm", "kN m", "rpm/s"} <= units
    rest = "at rest under the start values of the inputs"
    note = f"latent state, start value: {rest}, trained from -1 to 1"
    latent = next(v for v in made.variables if v.name == "latent1")
    assert (latent.role, latent.note) == ("state", note)
    assert latent.start is not None
    assert next(v.note for v in made.variables if v.name == "eta_dot").startswith(
        "eta_dot (m/s) is"
    )
    assert (made.binary is None) == (which("cc") is None)


def ran(call, *arguments):
    """What FMPy calls: every status counts."""
    status = call(*arguments)
    assert status in (None, 0), f"{call} answered {status}"


@needs_compiler
def test_co_simulation_and_model_exchange_are_the_model(fmu, along, tmp_path):
    fmpy = pytest.importorskip("fmpy")
    from fmpy.fmi2 import FMU2Model, FMU2Slave
    from fmpy.fmi3 import FMU3Model, FMU3Slave

    fmi, made = fmu
    inputs, states, outputs = along
    folder = fmpy.extract(str(made.path), str(tmp_path))
    about = fmpy.read_model_description(folder, validate=True)
    at = {v.name: v.valueReference for v in about.modelVariables}
    model, names = whole(), {g: [at[n] for n in whole().signals.names(g)] for g in _GROUPS}
    slave_class, model_class = (FMU2Slave, FMU2Model) if fmi == 2 else (FMU3Slave, FMU3Model)
    places = {"guid": about.guid, "unzipDirectory": folder, "modelIdentifier": "turbine"}
    slave: Any = slave_class(**places, instanceName="slave")
    get, put = (("getReal", "setReal"), ("getFloat64", "setFloat64"))[fmi - 2]
    driving = names["controls"] + names["disturbances"] + names["field"]
    rows = np.hstack([inputs["controls"], inputs["disturbances"], inputs["field"]])

    def begin(unit, *, reset: bool = False) -> None:
        if reset:
            ran(unit.reset)
        if fmi == 2:
            ran(unit.setupExperiment)
        ran(unit.enterInitializationMode)
        ran(getattr(unit, put), [*names["states"], at["azimuth"]], [*START, np.deg2rad(30)])
        ran(getattr(unit, put), names["parameters"], list(inputs["parameters"][0]))
        ran(getattr(unit, put), driving, list(rows[0]))
        ran(unit.exitInitializationMode)

    slave.instantiate()
    time, count = inputs["time"], 201
    first: Any = None
    for turn in range(2):  # what is reset runs as what is new
        begin(slave, reset=turn > 0)
        x, y = [], []
        for k in range(count):
            ran(getattr(slave, put), driving, list(rows[k]))
            x.append(getattr(slave, get)(names["states"]))
            y.append(getattr(slave, get)(names["outputs"]))
            if fmi == 2:
                # The torque is held; all others go along lines.
                slopes = list((rows[k + 1] - rows[k]) / 0.25)
                slopes[0] = 0.0
                ran(slave.setRealInputDerivatives, driving, [1] * len(driving), slopes)
            ended: Any = slave.doStep(time[k], 0.25)
            if fmi == 3:
                assert ended[:3] == (False, False, False)
                assert ended[3] == pytest.approx(time[k + 1], abs=1e-9)
        last = getattr(slave, get)([at["time"]])[0]
        assert last == pytest.approx(time[count], abs=1e-9)
        first = (x, y) if first is None else first
        assert (x, y) == first
    if fmi == 2:
        close(np.array(first[0]), states[:count], 1e-9)
        close(np.array(first[1]), outputs[:count], 1e-9)
    else:
        # Inputs are held between communication points.
        close(np.array(first[0]), held_rollout(model, inputs, count), 1e-9)
    slave.terminate()
    slave.freeInstance()

    unit: Any = model_class(**places, instanceName="model")
    unit.instantiate()
    begin(unit)
    unit.enterContinuousTimeMode()
    n = len(START) + 1
    x, dx = (ctypes.c_double * n)(), (ctypes.c_double * n)()
    rates = unit.getDerivatives if fmi == 2 else unit.getContinuousStateDerivatives
    for k in range(20):
        x[:] = [*states[k], 0.0]
        ran(unit.setContinuousStates, x, n)
        ran(getattr(unit, put), driving, list(rows[k]))
        ran(rates, dx, n)
        expected = model.derivative(
            states[k], inputs["controls"][k], inputs["disturbances"][k], inputs["parameters"][0]
        )
        np.testing.assert_allclose(dx[:5], np.asarray(expected), rtol=1e-10, atol=1e-12)
        assert dx[5] == pytest.approx(states[k][0] * np.pi / 30)
    unit.terminate()
    unit.freeInstance()


_GROUPS = ("states", "controls", "disturbances", "parameters", "outputs", "field")


def held_rollout(model, inputs: dict[str, Array], count: int) -> Array:
    """RK4 with all inputs held between samples."""
    x, path = np.array(START), []
    for k in range(count):
        path.append(x)
        u, w, p = (inputs[g][min(k, len(inputs[g]) - 1)] for g in _GROUPS[1:4])
        k1 = np.asarray(model.derivative(x, u, w, p))
        k2 = np.asarray(model.derivative(x + 0.125 * k1, u, w, p))
        k3 = np.asarray(model.derivative(x + 0.125 * k2, u, w, p))
        k4 = np.asarray(model.derivative(x + 0.25 * k3, u, w, p))
        x = x + 0.25 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.stack(path)


# -- the command line ---------------------------------------------------------------------------


def test_the_command_line(tmp_path, monkeypatch, dfsm):
    monkeypatch.chdir(tmp_path)
    save(linear_model(np.array([[-1.0]]), np.array([[2.0]])), "model")
    assert dfsm("export", "c", "model", "-o", "turbine").out == "wrote turbine\n"
    assert sorted(p.name for p in Path("turbine").iterdir()) == ["turbine.c", "turbine.h"]
    assert dfsm("export", "c", "model", "-o", "turbine").code == 0
    assert dfsm("export", "python", "model", "-o", "light").out == "wrote light\n"
    done = subprocess.run(
        [sys.executable, "run_model.py"], cwd="light", capture_output=True, text=True, check=True
    )
    assert '"x0"' in done.stdout
    shown = dfsm("export", "fmu", "model", "-o", "m.fmu", "--fmi", "2", "--kind", "co-simulation")
    assert (shown.code, shown.out.splitlines()[0][:11]) == (0, "wrote m.fmu")
    assert zipfile.is_zipfile("m.fmu")
    for wrong in (("--fmi", "1"), ("--kind", "both"), ("--step", "0")):
        shown = dfsm("export", "fmu", "model", "-o", "no.fmu", *wrong)
        assert (shown.code, shown.err.count("\n")) == (2, 1)
    assert not Path("no.fmu").exists()

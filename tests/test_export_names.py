"""Names, steps and sentences of exports: what a file may be called, and what it tells by whom."""

from __future__ import annotations

import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path
from shutil import which
from xml.etree import ElementTree

import numpy as np
import pytest

from dfsm.data.features import Feature
from dfsm.data.trajectory import Channel
from dfsm.exports.c_code import to_c
from dfsm.exports.fmu import write_fmu
from exported import hidden, whole
from systems import linear_model

needs_compiler = pytest.mark.skipif(which("cc") is None, reason="needs a C compiler")
STRICT = ["cc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror"]


@needs_compiler
@pytest.mark.parametrize("name", ["TURBINE_UPPER", "RENAME", "int", "casadi", "f", "m" * 120])
def test_c_of_any_name_is_what_its_header_declares(name, tmp_path):
    made = to_c(linear_model(np.array([[-1.0]]), np.array([[2.0]])), name)
    (tmp_path / f"{made.name}.h").write_text(made.header)
    (tmp_path / f"{made.name}.c").write_text(made.source)
    n = made.name
    (tmp_path / "main.c").write_text(
        f'#include "{n}.h"\n#include <stdio.h>\nint main(void) {{\n'
        "  double x[3] = {1.0}, u[3] = {1.0, 1.0, 1.0}, t[3] = {0.0, 0.1, 0.2}, d, y[1];\n"
        f"  int failed = {n}_simulate(3, t, u, 0, 0, x) || {n}_distance(x, u, 0, 0, &d)\n"
        f"      || {n}_step(0.1, x, u, 0, u, 0, 0, y) || y[0] != x[1];\n"
        f'  printf("%.17g %g %g", x[2], d, {n}_states_high[0]);\n  return failed;\n}}\n'
    )
    command = [*STRICT, "-o", "main", "main.c", f"{n}.c", "-lm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told = subprocess.run(
        [tmp_path / "main"], capture_output=True, text=True, check=True
    ).stdout.split()
    assert float(told[0]) == pytest.approx(2 - np.exp(-0.2), rel=1e-6)
    assert told[1:] == ["0.1", "10"]


@needs_compiler
@pytest.mark.parametrize("name", ["at", "count"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_of_any_name_is_compiled(name, fmi, tmp_path):
    # Of these the functions of FMI have constants of their own.
    made = write_fmu(whole() if fmi == 3 else hidden("tanh"), tmp_path / f"{name}.fmu", fmi=fmi)
    assert made.binary is not None
    with zipfile.ZipFile(made.path) as archive:
        archive.extractall(tmp_path)
    command = [*STRICT, "-fsyntax-only", "fmu.c", f"{name}.c"]
    done = subprocess.run(
        command, cwd=tmp_path / "sources", capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_computed_input_is_told_beside_its_variable_whatever_its_name(tmp_path: Path):
    late = Feature(source="Wave elev", kind="delay", seconds=2.5)
    model = hidden("tanh")
    controls = (Channel("Wave", "m"), Channel(late.name, "N"))
    model = replace(model, signals=replace(model.signals, controls=controls, features=(late,)))
    made = write_fmu(model, tmp_path / "m.fmu")
    notes = {v.name: v.note for v in made.variables}
    sentence = f"{late.name} (N) is Wave elev as it was 2.5 s ago: supply it"
    spline = "goes along a spline between samples, trained from -10 to 10"
    assert notes[late.name] == f"{sentence}, {spline}"
    assert notes["Wave"] == "control, held between samples, trained from -10 to 10"
    with zipfile.ZipFile(made.path) as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    told = {v.get("name"): v for v in root.iter("Float64")}
    assert told[late.name].get("description") == notes[late.name]
    moving = [told[name].get("intermediateUpdate") for name in ("Wave", late.name)]
    assert moving == [None, "true"]
    (way,) = root.iter("CoSimulation")
    assert way.get("providesIntermediateUpdate") == "true"


def test_only_co_simulation_has_steps_to_set_inputs_within(tmp_path: Path):
    made = write_fmu(hidden("tanh"), tmp_path / "m.fmu", kind="model-exchange")
    with zipfile.ZipFile(made.path) as archive:
        assert b"ntermediateUpdate" not in archive.read("modelDescription.xml")


def test_names_that_xml_cannot_hold_are_told_without_them(tmp_path: Path):
    names = ["bell\x07 <b>", "new\nline", "der(x)", "x", "training_distance", "time", " "]
    model = linear_model(-np.eye(7), np.ones((7, 1)), names=names, units=["m\x00s"] * 7)
    made = write_fmu(model, tmp_path / "m.fmu", fmi=2)
    with zipfile.ZipFile(made.path) as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    told = [v.get("name") for v in root.iter("ScalarVariable")]
    assert len(set(told)) == len(told)
    assert told[1:8] == [
        *("bell <b>", "new line", "der(x)", "x", "training_distance", "time_2", "unnamed"),
    ]
    assert told[11:13] == ["der(x)_2", "der(training_distance)"]
    assert told[-1] == "training_distance_2"
    assert {u.get("name") for u in root.iter("Unit")} >= {"m s", "m s/s"}


def test_an_fmu_takes_the_step_that_its_model_was_made_for(tmp_path: Path):
    model = hidden("polynomial")
    model = replace(model, signals=replace(model.signals, step=0.25))
    made = write_fmu(model, tmp_path / "m.fmu")
    assert next(v.start for v in made.variables if v.name == "rk4_step") == pytest.approx(0.25)
    # Whoever asks for nothing holds inputs no longer than that.
    with zipfile.ZipFile(made.path) as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
    (experiment,) = root.iter("DefaultExperiment")
    assert float(experiment.get("stepSize", "")) == pytest.approx(0.25)

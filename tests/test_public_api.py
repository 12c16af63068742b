"""Habits of the public interface: every name documented, every argument too, no stray keywords."""

from __future__ import annotations

import dataclasses
import enum
import inspect
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

import dfsm

NAMES = [n for n in dfsm.__all__ if n != "__version__"]
OBJECTS = {n: getattr(dfsm, n) for n in NAMES}
FUNCTIONS = [n for n, o in OBJECTS.items() if isinstance(o, types.FunctionType)]
CLASSES = [n for n, o in OBJECTS.items() if isinstance(o, type)]
SECTIONS = "Parameters|Returns|Raises|Attributes|Warns|Yields|Notes|References|Examples"


def documented(text: str | None, section: str) -> set[str]:
    """Names that a section of a numpy docstring explains."""
    found = re.search(
        rf"^{section}\n-+\n(.*?)(?=^(?:{SECTIONS})\n-+\n|\Z)",
        inspect.cleandoc(text or "") + "\n",
        re.MULTILINE | re.DOTALL,
    )
    if found is None:
        return set()
    heads = re.findall(r"^(?! )(.+?)(?: : .*)?$", found[1], re.MULTILINE)
    return {name.strip("* ") for head in heads for name in head.split(",")}


def parameters(function) -> set[str]:
    """Names that a caller can give."""
    return set(inspect.signature(function).parameters) - {"self", "cls"}


def public_methods(cls):
    """Functions and properties that a class itself defines under a public name."""
    for name, value in vars(cls).items():
        if name.startswith("_"):
            continue
        if isinstance(value, classmethod | staticmethod):
            yield name, value.__func__
        elif isinstance(value, property):
            yield name, value.fget
        elif isinstance(value, types.FunctionType) or hasattr(value, "__wrapped__"):
            yield name, inspect.unwrap(value)


METHODS = [
    pytest.param(f, id=f"{n}.{m}")
    for n in CLASSES
    if not issubclass(OBJECTS[n], enum.Enum)
    for m, f in public_methods(OBJECTS[n])
]


def test_every_public_name_is_a_function_or_a_class():
    assert len(NAMES) == len(set(NAMES)) == len(FUNCTIONS) + len(CLASSES)
    assert set(dir(dfsm)) >= set(NAMES)
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = dfsm.nonsense


@pytest.mark.parametrize("name", NAMES)
def test_every_name_has_a_docstring_of_its_own(name):
    text = OBJECTS[name].__doc__
    assert text
    # A dataclass without one is given its signature instead.
    assert not text.startswith(f"{name}(")
    assert text.splitlines()[0].rstrip().endswith((".", ":"))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_parameter_is_documented(name):
    function = OBJECTS[name]
    told = documented(function.__doc__, "Parameters")
    if len(parameters(function)) <= 1 and not told:
        return  # one argument that the first line explains
    assert told == parameters(function)


@pytest.mark.parametrize("function", METHODS)
def test_methods_have_docstrings_and_document_no_ghosts(function):
    assert function.__doc__
    told = documented(function.__doc__, "Parameters")
    assert not told or told == parameters(function)


@pytest.mark.parametrize("name", [n for n in CLASSES if dataclasses.is_dataclass(OBJECTS[n])])
def test_every_attribute_is_documented(name):
    cls = OBJECTS[name]
    own = {f.name for f in dataclasses.fields(cls)} - {"kind"}
    told = documented(cls.__doc__, "Attributes") - {"kind"}
    assert told - {n for n, _ in public_methods(cls)} == own


def test_every_key_of_the_configuration_is_documented():
    from dfsm.config import fit as config

    assert issubclass(config.DataConfig, BaseModel)
    told = documented(config.DataConfig.__doc__, "Attributes")
    assert told == set(config.DataConfig.model_fields)


@pytest.mark.parametrize("name", NAMES)
def test_unknown_keywords_are_refused(name):
    value = OBJECTS[name]
    if isinstance(value, type) and issubclass(value, enum.Enum | Exception):
        return
    with pytest.raises(TypeError, match=r"unexpected keyword argument|missing"):
        value(nonsense=1)
    assert not [p for p in inspect.signature(value).parameters.values() if p.kind is p.VAR_KEYWORD]


# What settings need that is no text.
_RATIOS, _GRID = np.arange(5.0, 10.0), np.ones((5, 5))
VALID = {
    "Filter": {"window": 1.0},
    "BoxSettings": {
        "points": (4, 4, 4),
        "spacing": (1.0, 1.0, 1.0),
        "mean_wind": 8.0,
        "hub_height": 90.0,
    },
    "UniformSettings": {"hub_height": 90.0},
    "RotorTable": {
        "pitch": np.arange(5.0),
        "tip_speed_ratio": _RATIOS,
        "cp": 0.4 * _GRID,
        "ct": 0.8 * _GRID,
        "cq": 0.4 * _GRID / _RATIOS[:, None],
    },
    "Rotor": {"radius": 60.0, "wind": "w", "speed": "s", "pitch": "p"},
    "Product": {"factors": ("a", "b")},
    "Function": {"function": lambda x: x, "inputs": ("a",)},
    "Goal": {"measure": "std", "channel": "x"},
    "Limit": {"measure": "std", "channel": "x", "at_most": 1.0},
    "TuningProblem": {
        "parameters": {"kp": (0.0, 1.0)},
        "objective": (dfsm.Goal(measure="std", channel="x"),),
    },
}


@pytest.mark.parametrize("name", [n for n in CLASSES if hasattr(OBJECTS[n], "__pydantic_config__")])
def test_settings_are_frozen_and_keyword_only(name):
    cls = OBJECTS[name]
    with pytest.raises(TypeError, match="positional argument"):
        cls("x")
    required = {
        f.name: "moving_average" if f.name == "kind" else "x"
        for f in dataclasses.fields(cls)
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    }
    value = cls(**(required | VALID.get(name, {})))
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, dataclasses.fields(cls)[0].name, 1)


def test_importing_costs_nothing():
    heavy = [
        "jax",
        "casadi",
        "pandas",
        "scipy",
        "sklearn",
        "plotly",
        "pyarrow",
        "diffrax",
        "numpy",
        "rich",
    ]
    code = f"import sys, dfsm; print([m for m in {heavy!r} if m in sys.modules])"
    assert python(code) == "[]"
    heavy.remove("rich")
    code = f"import sys, dfsm.cli; print([m for m in {heavy!r} if m in sys.modules])"
    assert python(code) == "[]"


def test_no_module_bears_the_name_of_a_public_function():
    folder = Path(dfsm.__file__).parent
    top = {path.stem for path in folder.iterdir()}
    assert not top & set(NAMES)


def test_the_version_is_that_of_the_package():
    from importlib.metadata import version

    assert dfsm.__version__ == version("dfsm")


def python(code: str) -> str:
    """Run code in a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_runs_have_their_earlier_address_too():
    from dfsm.trajectory import Channel, Trajectory

    assert (Channel, Trajectory) == (dfsm.Channel, dfsm.Trajectory)

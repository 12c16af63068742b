"""The component for OpenMDAO: values, exact partials and their sparsity, names and units."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import exported
import fits
from systems import linear_model

pytestmark = [
    # OpenMDAO's own, on import and on every problem.
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:.*:UserWarning:openmdao"),
]
om = pytest.importorskip("openmdao.api")
NODES = 4


def problem(model):
    """A problem of the component alone, at random points inside and outside the data."""
    from dfsm.exports.openmdao_component import DFSMComp

    made = om.Problem(reports=False)
    component = DFSMComp(model=model, num_nodes=NODES)
    made.model.add_subsystem("plant", component, promotes=["*"])
    made.setup(check=False)
    middle, std = (np.asarray(v) for v in (model.region.mean, model.region.std))
    points = middle + 2 * std * np.random.default_rng(0).normal(size=(NODES, len(middle)))
    for k, c in enumerate(model.signals.inputs):
        constant = c in model.signals.parameters
        made.set_val(component.variables[c.name], points[0, k] if constant else points[:, k])
    made.run_model()
    return made, component, points


@pytest.mark.parametrize("which", ["scheduled", "corrected"])
def test_values_and_partials_are_the_models(which, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # OpenMDAO makes folders where it runs
    model = fits.scheduled() if which == "scheduled" else fits.duffing().model
    made, component, points = problem(model)
    x, u, w, p = model.split(jnp.asarray(points))
    rates, outputs = np.asarray(model.derivative(x, u, w, p)), np.asarray(model.output(x, u, w, p))
    for k, c in enumerate(model.signals.states):
        found = made.get_val(component.variables[f"d {c.name}/dt"])
        np.testing.assert_allclose(found, rates[:, k], rtol=1e-9, atol=1e-9)
    for k, c in enumerate(model.signals.outputs):
        found = made.get_val(component.variables[c.name])
        np.testing.assert_allclose(found, outputs[:, k], rtol=1e-9, atol=1e-9)
    # All that is not declared is zero for the checker, so this tests the sparsity, too.
    checks = made.check_partials(out_stream=None, method="fd", form="central", step=1e-5)
    for (of, wrt), told in checks["plant"].items():
        error = np.abs(told["J_fwd"] - told["J_fd"]).max()
        assert error < 1e-5 * (1 + np.abs(told["J_fd"]).max()), (of, wrt)


def test_what_cannot_depend_has_no_entry():
    from dfsm.exports.openmdao_component import dependence

    A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0], [2.0]])
    model = linear_model(A, B, np.array([[3.0, 0.0]]), names=["q", "v"])
    expected = [[False, True, False], [True, True, True], [True, False, False]]
    np.testing.assert_array_equal(dependence(model), expected)


def test_a_term_depends_on_what_it_takes_alone():
    from dfsm.exports.openmdao_component import dependence

    model = exported.whole()
    depends = dependence(replace(model, e=None, corrected=()))
    names = [c.name for group in ("states", "controls", "disturbances", "parameters")
             for c in getattr(model.signals, group)]  # fmt: skip
    rate = depends[2]  # of heave_dot: wave, heave, its rate, RotSpeed·heave² and drag
    taken = {name for name, used in zip(names, rate, strict=True) if used}
    assert taken == {"eta_dot", "heave <z>", "heave <z>_dot", "RotSpeed"}


def test_a_rate_of_a_number_is_per_second():
    from dfsm.exports.openmdao_component import _rate

    assert {u: _rate(u) for u in ("-", "1", "m", "")} == {
        "-": "1/s", "1": "1/s", "m": "m/s", "": None,
    }  # fmt: skip


def test_names_and_units_are_those_that_openmdao_takes():
    from dfsm.exports.openmdao_component import unit_of, variables_of

    A, B = np.array([[0.0, 1.0], [-4.0, -0.6]]), np.array([[0.0], [2.0]])
    model = linear_model(A, B, names=["-B1.x", "_B1 x"])
    names = variables_of(model)
    assert names == {
        "-B1.x": "s__B1_x", "_B1 x": "s__B1_x_", "u0": "u0",
        "d -B1.x/dt": "d_s__B1_x_dt", "d _B1 x/dt": "d_s__B1_x_dt_",
    }  # fmt: skip
    known = {u: unit_of(u) for u in ("kN-m", "m/s^2", "rpm", "(deg)", "", "furlong?", "kN·m")}
    assert known == {
        "kN-m": "kN*m", "m/s^2": "m/s**2", "rpm": "rpm", "(deg)": "deg", "": None,
        "furlong?": None, "kN·m": "kN*m",
    }  # fmt: skip


def test_units_mean_to_openmdao_what_they_mean_here():
    from openmdao.utils.units import convert_units  # pyright: ignore[reportMissingImports]

    from dfsm.core.units import conversion
    from dfsm.exports.openmdao_component import _rate, unit_of

    pairs = {"kN m": "N*m", "s-1": "1/min", "m s-2": "ft/s**2", "C": "degK", "deg F": "degC"}
    pairs |= {"°": "rad", "kg m2": "g*m**2", "kNm": "J", "N.m/rad": "kN*m/deg", "m²": "mm**2"}
    for unit, other in pairs.items():
        scale, shift = conversion(unit, other.replace("degK", "K")) or (0.0, 0.0)
        spelled = unit_of(unit)
        assert spelled is not None, unit
        assert convert_units(3.0, spelled, other) == pytest.approx(3.0 * scale + shift), unit
    # A rate of a temperature has no zero to be told from.
    assert {u: _rate(u) for u in ("degC", "kN m", "??")} == {
        "degC": "K**1*s**-1", "kN m": "kN*m/s", "??": None,
    }  # fmt: skip


def test_a_component_takes_channels_in_units_with_spaces(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    A, B = np.array([[-1.0]]), np.array([[2.0]])
    made, component, _points = problem(linear_model(A, B, names=["load"], units=["kN m"]))
    value = made.get_val(component.variables["load"], units="N*m")
    assert value == pytest.approx(1e3 * made.get_val(component.variables["load"]))

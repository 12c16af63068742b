from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import Field, TypeAdapter

from dfsm.core.types import Array
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.models.terms import (
    FORMS,
    Function,
    FunctionTerm,
    Product,
    QuadraticDrag,
    Rotor,
    Term,
    Terms,
    TermSettings,
    terms_of,
)
from rotors import CHANNELS, COLUMNS, UNITS, rotor, term_of

# -- the other kinds ----------------------------------------------------------------------------


def test_quadratic_drag():
    one, two = (term_of(QuadraticDrag(velocity="Wind", against=a)) for a in (None, "Surge"))
    inputs = jnp.zeros(len(UNITS)).at[COLUMNS["Wind"]].set(-3.0).at[COLUMNS["Surge"]].set(2.0)
    assert one(inputs).tolist() == [-9.0]
    assert two(inputs).tolist() == [-25.0]
    assert one.channels == (Channel("drag(Wind)", "(m/s)^2"),)
    assert two.channels[0].name == "drag(Wind - Surge)"
    assert float(jax.grad(lambda i: two(i)[0])(inputs)[COLUMNS["Wind"]]) == 10.0
    assert jax.jacfwd(one)(jnp.zeros(len(UNITS))).tolist() == [[0.0] * len(UNITS)]


def test_drag_needs_one_unit_and_two_channels():
    with pytest.raises(DfsmError, match="'Wind' is in 'm/s' and 'Speed' in 'rpm', expected one"):
        term_of(QuadraticDrag(velocity="Wind", against="Speed"))
    with pytest.raises(DfsmError, match="which is the velocity itself"):
        QuadraticDrag(velocity="Wind", against="Wind")


def test_products_and_powers():
    term = term_of(Product(factors=("Speed", "Wind", "Speed")))
    inputs = jnp.zeros(len(UNITS)).at[COLUMNS["Wind"]].set(-3.0).at[COLUMNS["Speed"]].set(2.0)
    assert term(inputs).tolist() == [-12.0]
    assert term.channels == (Channel("Speed^2*Wind", "rpm^2*(m/s)"),)
    slopes = jax.jacfwd(term)(inputs)[0]
    assert slopes[COLUMNS["Speed"]] == 2 * 2.0 * -3.0
    assert slopes[COLUMNS["Wind"]] == 4.0
    assert term_of(Product(factors=("Wind", "Speed"), name="x")).channels[0].name == "x"
    with pytest.raises(DfsmError, match=r"product\.factors is Wind, expected two channels or more"):
        Product(factors=("Wind",))


def test_functions_of_a_user():
    settings = Function(
        name="lift", unit="kN", function=lambda v, b: v**2 * jnp.sin(b), inputs=("Wind", "Radians")
    )
    term = term_of(settings)
    inputs = jnp.zeros(len(UNITS)).at[COLUMNS["Wind"]].set(3.0).at[COLUMNS["Radians"]].set(0.5)
    np.testing.assert_allclose(term(inputs), [9 * np.sin(0.5)])
    assert term.channels == (Channel("lift", "kN"),)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda v, w: v, "cannot be traced by JAX with 1 numbers"),
        (lambda v: float(v), "cannot be traced by JAX with 1 numbers"),
        (lambda v: jnp.stack([v, v]), "returns (2,), expected one number"),
        ("v**2", "function.function is str, expected a function of 1 numbers"),
    ],
)
def test_functions_that_are_refused(function, message):
    with pytest.raises(DfsmError, match=re.escape(message)):
        term_of(Function(name="lift", function=function, inputs=("Wind",)))


def test_a_function_needs_a_name_and_inputs():
    with pytest.raises(DfsmError, match=r"function\.name is empty"):
        Function(name="", function=jnp.sin, inputs=("Wind",))
    with pytest.raises(DfsmError, match=r"function\.inputs is empty"):
        Function(name="f", function=jnp.sin, inputs=())


@pytest.mark.parametrize(
    "settings",
    [
        QuadraticDrag(velocity="Wnd"),
        Product(factors=("Speed", "Wnd")),
        Function(name="f", function=jnp.sin, inputs=("Wnd",)),
    ],
)
def test_unknown_channels_are_refused(settings):
    with pytest.raises(DfsmError, match=r"'Wnd' is no state.*; did you mean 'Wind'\?"):
        term_of(settings)


# -- all terms together -------------------------------------------------------------------------


def double(x: jax.Array) -> jax.Array:
    return 2 * x


SETTINGS = (
    rotor(corrections=("Inner",), hub_height=150.0, pitch_rate="PitchRate"),
    QuadraticDrag(velocity="Surge"),
    Product(factors=("Wind", "Speed")),
    Function(name="twice", function=double, inputs=("Wind",)),
)
MIDDLE = np.array([19e3, 4.0, 11.0, 0.0, 0.0, 7.0, 0.0, 0.0, 0.1, 1.0, 400.0])


def samples(count: int = 200) -> Array:
    rng = np.random.default_rng(1)
    return MIDDLE + 0.1 * (1 + MIDDLE / 10) * rng.standard_normal((count, len(MIDDLE)))


@pytest.fixture(scope="module")
def terms() -> Terms:
    made = terms_of(SETTINGS, tuple(CHANNELS.values()), samples())
    assert made is not None
    return made


def test_terms_stand_one_after_another(terms):
    inputs = jnp.asarray(samples(1)[0])
    values = jnp.concatenate([part(inputs) for part in terms.parts])
    np.testing.assert_array_equal(terms(inputs), values)
    np.testing.assert_array_equal(terms.extend(inputs), jnp.concatenate([inputs, values]))
    names = [c.name for c in terms.channels]
    assert names == ["rotor.thrust", "rotor.torque", "drag(Surge)", "Wind*Speed", "twice"]
    along = terms.along(samples())
    np.testing.assert_allclose(along[0], terms(jnp.asarray(samples()[0])), rtol=1e-12)
    np.testing.assert_allclose(terms.mean, along.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(terms.std, along.std(axis=0), rtol=1e-12)
    slopes = terms.slopes(samples(3))
    assert slopes.shape == (3, 5, len(UNITS))
    assert slopes[0, 4].tolist() == [2.0 * (name == "Wind") for name in UNITS]


def test_values_that_never_change_have_scale_one(terms):
    still = replace(terms, std=jnp.array([2.0, 0.0, 1.0, 3.0, 0.0]))
    assert still.scale.tolist() == [2.0, 1.0, 1.0, 3.0, 1.0]


def test_more_inputs_in_between_change_nothing(terms):
    inputs, at = samples(1)[0], COLUMNS["Speed"]
    wider = np.insert(inputs, at, [7.0, -3.0])
    more = terms.with_more_inputs(at, 2)
    np.testing.assert_array_equal(more(jnp.asarray(wider)), terms(jnp.asarray(inputs)))


def test_parameters_of_all_parts_are_moved(terms):
    second = rotor(name="other", corrections=("Inner", "Outer")).term(CHANNELS, COLUMNS)
    both = replace(terms, parts=(*terms.parts, second))
    assert [a.shape for a in both.parameters] == [(1,), (2,)]
    moved = both.moved([jnp.array([0.5]), jnp.array([1.0, -1.0])])
    spread = samples().std(axis=0)
    expected = 0.5 * spread[COLUMNS["Wind"]] / spread[COLUMNS["Inner"]]
    np.testing.assert_allclose(moved.parameters[0], [expected])
    np.testing.assert_array_equal(moved.parameters[1], [1.0, -1.0])


def test_terms_are_checked_together(terms):
    values = dict(zip(UNITS, samples().T, strict=True))
    assert terms.check(values) == []
    values["Wind"] = np.where(np.arange(200) < 60, -1.0, values["Wind"])
    assert len(terms.check(values)) == 1


def test_without_settings_there_are_no_terms():
    assert terms_of((), tuple(CHANNELS.values()), samples()) is None


def test_terms_with_one_name_and_values_that_are_not_finite_are_refused():
    channels = tuple(CHANNELS.values())
    twice = (QuadraticDrag(velocity="Wind", name="a"), Product(factors=("Wind", "Speed"), name="a"))
    with pytest.raises(DfsmError, match="two inputs of the linear fit are called 'a'"):
        terms_of(twice, channels, samples())
    with pytest.raises(DfsmError, match="two inputs of the linear fit are called 'Speed'"):
        terms_of((QuadraticDrag(velocity="Wind", name="Speed"),), channels, samples())
    root = Function(name="root", function=jnp.sqrt, inputs=("Surge",))
    with pytest.raises(DfsmError, match=r"'root' is not finite at \d+ of 200 training samples"):
        terms_of((root,), channels, samples())


# -- model folders and configurations -----------------------------------------------------------


def again(term: Term, **more) -> Term:
    """What comes back of a term through JSON and arrays."""
    told = json.loads(
        json.dumps(
            {"kind": term.kind, "columns": term.columns}
            | {"channels": [asdict(c) for c in term.channels]}
            | term.structure()
        )
    )
    arrays = {name: jnp.asarray(np.asarray(a)) for name, a in term.arrays().items()}
    channels = tuple(Channel(**c) for c in told["channels"])
    form: Callable[..., Term] = FORMS[told["kind"]].restored
    return form(tuple(told["columns"]), channels, arrays, told, **more)


def test_terms_come_back_as_they_were(terms):
    inputs = jnp.asarray(samples(1)[0])
    moved = terms.moved([jnp.array([0.3])])
    for part in moved.parts:
        more = {"functions": {"twice": double}} if isinstance(part, FunctionTerm) else {}
        back = again(part, **more)
        assert eqx.tree_equal(back, part)
        np.testing.assert_array_equal(back(inputs), part(inputs))
        assert back.channels == part.channels
        # Compiled functions are kept by what is static in a term.
        assert jax.tree.structure(back) == jax.tree.structure(part)
        hash(jax.tree.structure(back))


def test_a_function_must_be_passed_again():
    term = term_of(Function(name="twice", function=double, inputs=("Wind",)))
    with pytest.raises(DfsmError, match=r"pass functions=\{'twice': f\}$"):
        again(term)
    with pytest.raises(DfsmError, match=r"pass functions=\{'twice': f\}; did you mean 'twise'\?"):
        again(term, functions={"twise": double})
    with pytest.raises(DfsmError, match="function 'twice' cannot be traced by JAX with 1 numbers"):
        again(term, functions={"twice": lambda a, b: a + b})


def test_settings_are_told_apart_by_kind():
    adapter = TypeAdapter(list[Annotated[TermSettings, Field(discriminator="kind")]])
    read = adapter.validate_python(
        [
            {"kind": "rotor", "table": "t.txt", "radius": 120, "wind": "W", "speed": "S"}
            | {"pitch": "P", "corrections": ["A"]},
            {"kind": "quadratic_drag", "velocity": "W"},
            {"kind": "product", "factors": ["W", "S"]},
        ]
    )
    assert read == [
        Rotor(table="t.txt", radius=120, wind="W", speed="S", pitch="P", corrections=("A",)),
        QuadraticDrag(velocity="W"),
        Product(factors=("W", "S")),
    ]

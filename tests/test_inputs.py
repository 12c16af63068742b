"""The order of I = [u, w, ξ, p] against arrays put together by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.errors import DfsmError
from dfsm.models.inputs import InputOrder

ORDER = InputOrder(
    controls=("u1", "u2"), disturbances=("w",), states=("q", "v", "r"), parameters=("k", "m")
)
X, U, W, P = (jnp.array(a) for a in ([1.0, 2.0, 3.0], [4.0, 5.0], [6.0], [7.0, 8.0]))
INPUTS = np.array([4, 5, 6, 1, 2, 3, 7, 8])


def test_names_stand_where_their_values_do():
    values = {"u1": 4, "u2": 5, "w": 6, "q": 1, "v": 2, "r": 3, "k": 7, "m": 8}
    assert ORDER.names == tuple(values)
    np.testing.assert_array_equal(ORDER.join(X, U, W, P), INPUTS)
    assert {n: INPUTS[ORDER.column(n)] for n in values} == values
    assert InputOrder.of(lambda group: getattr(ORDER, group)) == ORDER


def test_groups_stand_where_they_are_said_to():
    for group, values in (("states", X), ("controls", U), ("disturbances", W), ("parameters", P)):
        np.testing.assert_array_equal(INPUTS[ORDER.columns(group)], values)
    assert ORDER.names[ORDER.driving_columns] == ORDER.driving == ("u1", "u2", "w")


def test_what_is_joined_is_split_again():
    many = np.random.default_rng(0).normal(size=(4, 5, 8))
    parts = ORDER.split(jnp.asarray(many))
    assert [p.shape for p in parts] == [(4, 5, 3), (4, 5, 2), (4, 5, 1), (4, 5, 2)]
    np.testing.assert_array_equal(ORDER.join(*parts), many)
    # Leading axes broadcast.
    wide = np.asarray(ORDER.join(parts[0], U, W, P))
    np.testing.assert_array_equal(wide[2, 3], [4, 5, 6, *many[2, 3, 3:6], 7, 8])


def test_exogenous_values_are_those_without_states():
    assert ORDER.exogenous == ("u1", "u2", "w", "k", "m")
    for values, expected in zip(
        ORDER.split_exogenous(jnp.array([4.0, 5, 6, 7, 8])), (U, W, P), strict=True
    ):
        np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("column", range(8))
def test_an_element_is_taken_from_its_own_group_alone(column):
    groups = (X, U, W, P)
    assert ORDER.element(column, *groups) == INPUTS[column]
    slopes = jax.grad(lambda groups: ORDER.element(column, *groups))(groups)
    np.testing.assert_array_equal(ORDER.join(*slopes), np.eye(8)[column])
    traced = jax.make_jaxpr(lambda x: ORDER.element(column, x, U, W, P))(X)
    depends = any(v in eqn.invars for eqn in traced.eqns for v in traced.jaxpr.invars)
    assert depends == (ORDER.names[column] in ORDER.states)


def test_without_a_column_the_element_is_zero():
    assert ORDER.element(None, X, U, W, P) == 0


def test_a_group_of_another_size_and_an_unknown_name_are_told():
    with pytest.raises(DfsmError, match=r"controls have shape \(1,\).* hold 2: u1, u2"):
        ORDER.arrays(X, [1.0], W, P)
    with pytest.raises(DfsmError, match="'u3' is no input; known are: u1, u2, w, q"):
        ORDER.column("u3")

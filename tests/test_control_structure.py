"""Constraints on which no choice has an effect are refused, value by value; all others are kept."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cart import CART, QUICK, problem, solved
from dfsm.control import solve
from dfsm.control.guess import start_of
from dfsm.control.nlp.structure import curved, dependent, varies
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError

NOTHING = "depends on nothing that can be chosen: leave it out, or use a state"


def path(function, **changes):
    return problem(constraints={"c": (function, None, 9.0)}, **changes)


def test_a_branch_by_where_is_a_constraint_like_any_other():
    # The part of the speed above 0.9 m/s: 0.1 m/s of it are allowed.
    excess = lambda s: jnp.where(s.x.speed > 0.9, s.x.speed - 0.9, 0.0)  # noqa: E731
    limited = solved(problem(constraints={"excess": (excess, None, 0.1)}))
    bounded = solved(problem(bounds={"speed": (None, 1.0)}))
    assert limited.trajectory["speed"].max() == pytest.approx(1.0, abs=1e-6)
    assert limited.objective == pytest.approx(bounded.objective, rel=1e-6)


@pytest.mark.parametrize(
    "function",
    [
        lambda s: 0 * s.x.speed,
        lambda s: jax.jit(lambda v: 2 * v)(s.x.speed),
        lambda s: jax.jit(lambda v: jnp.where(v > 0, v, 0.0))(s.x.speed),
        lambda s: [s.u.force, jnp.maximum(s.x.speed, 0.0)],
        lambda s: jax.lax.fori_loop(0, 3, lambda _, v: 0.5 * v, s.x.speed),
        lambda s: jax.lax.cond(s.w.wind > 0, lambda v: v, lambda v: -v, s.x.speed),
    ],
    ids=["times nothing", "jit", "where in jit", "two values", "loop", "branch"],
)
def test_what_depends_on_a_choice_is_accepted(function):
    assert solved(path(function)).trajectory["speed"].max() > 0


@pytest.mark.parametrize(
    "function",
    [
        lambda s: 3.0,
        lambda s: s.w.wind - s.t,
        lambda s: s.p.mass,
        lambda s: jax.jit(lambda w, speed: jnp.sin(w))(s.w.wind, s.x.speed),
        lambda s: jnp.stack([s.x.speed, s.w.wind])[1],
        lambda s: jnp.zeros(0),
    ],
    ids=["number", "disturbance", "fixed parameter", "unused argument", "picked", "no values"],
)
def test_what_depends_on_nothing_is_refused(function):
    with pytest.raises(DfsmError, match=f"cart: constraints 'c' {NOTHING}"):
        solve(path(function), QUICK)


@pytest.mark.parametrize(
    "function",
    [
        lambda s: [s.x.speed, s.w.wind, s.u.force],
        lambda s: jnp.concatenate([jnp.array([s.u.force]), jnp.ones(1)]) * 2.0,
        lambda s: jnp.sin(jnp.stack([s.x.speed, s.t])).reshape(2, 1),
        lambda s: jnp.stack([s.w.wind, s.x.speed])[::-1] + s.t,
        lambda s: jnp.stack([jnp.stack([s.x.place, s.t]), jnp.stack([s.x.speed, s.t])]).T[:, 1],
    ],
    ids=["list", "concatenated", "reshaped", "reversed", "transposed"],
)
def test_the_value_that_depends_on_nothing_is_named(function):
    with pytest.raises(DfsmError, match=f"cart: value 1 of constraints 'c' {NOTHING}"):
        solve(path(function), QUICK)


def test_a_fixed_parameter_beside_a_free_one_is_still_fixed():
    two = replace(CART, parameters=(*CART.parameters, Channel("length", "m")))
    changes = {"model": two, "parameters": {"mass": (1.0, 3.0), "length": 2.0}}
    with pytest.raises(DfsmError, match=f"constraints 'c' {NOTHING}"):
        solve(path(lambda s: s.p.length, **changes), QUICK)
    ends = {"c": (lambda start, end: [end.p.mass, end.p.length + end.t], None, 9.0)}
    with pytest.raises(DfsmError, match=f"value 1 of boundary 'c' {NOTHING}"):
        solve(problem(boundary=ends, **changes), QUICK)


def test_masks_follow_places():
    def function(z, fixed):
        grid = jnp.stack([z, fixed]).T.reshape(-1)  # z0, fixed0, z1, fixed1
        moved = jnp.broadcast_to(grid[1:3, None], (2, 2))
        return grid, moved, jnp.cumsum(fixed), jnp.cumsum(jnp.stack([fixed[0], z[0]]))

    masks = dependent(function, jnp.ones(2), jnp.ones(2))
    expected = [[1, 0, 1, 0], [[0, 0], [1, 1]], [0, 0], [1, 1]]
    for mask, wanted in zip(masks, expected, strict=True):
        np.testing.assert_array_equal(mask, np.array(wanted, dtype=bool))


def test_slopes_tell_linear_from_curved():
    assert not varies(jax.jacfwd(lambda z: 3 * z[0] - z[1]), jnp.ones(2))
    assert varies(jax.jacfwd(lambda z: z[0] * z[1]), jnp.ones(2))


def test_elements_in_which_a_function_is_affine_are_proved():
    def function(z, fixed):
        return fixed * z[0] + z[1] ** 2 + jnp.sin(fixed) * z[2] * z[3] + z[4]

    np.testing.assert_array_equal(curved(function, jnp.ones(5), 2.0), [0, 1, 1, 1, 0])
    # Of a gather nobody can tell.
    assert curved(lambda z: z[jnp.array([1])][0] ** 2, jnp.ones(2)).all()
    affine = lambda z: jnp.array([[1.0, 2.0]]) @ jnp.stack([z[1], z[0]]) + 3  # noqa: E731
    assert not curved(lambda z: affine(z)[0], jnp.ones(2)).any()


def test_constant_slopes_are_computed_once_and_what_cannot_move_has_none():
    # The mass is fixed, the place enters nothing, speed and force only the power.
    limited = problem(bounds={"power": (-9.0, 9.0)})
    shot = QUICK.shot(limited, QUICK.grid(), start_of(limited, None, QUICK.grid().tau))
    term, asked = shot.program.blocks[0].term, []
    original = term.jacobian

    def counted(z, data, common, of):
        asked.append(tuple(of))
        return original(z, data, common, of)

    term.jacobian = counted
    z = np.ones(shot.program.n)
    first, second = (shot.program.slopes(point)[0] for point in (z, 2 * z))
    del term.jacobian
    assert asked == [(0,), (1, 2), (1, 2)]
    np.testing.assert_array_equal(first[..., 2], second[..., 2])
    local = np.asarray(z * shot.program.scale)[shot.program.blocks[0].columns]
    b = shot.program.blocks[0]
    whole = original(local, b.data, b.common, (1, 2, 0))
    np.testing.assert_allclose(first, whole, rtol=1e-14)

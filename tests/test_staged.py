"""The form of a model that loops evaluate: the same function, computed in another order."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dfsm.data.trajectory import Channel
from dfsm.models.corrective.gaussian_units import GaussianUnits
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel, SplitLinear
from dfsm.models.staged import staged
from dfsm.models.terms import Product
from dfsm.models.terms.form import Schedule
from dfsm.models.terms.terms import Terms
from dfsm.numerics.exponential import exp
from rotors import CHANNELS, COLUMNS, UNITS, rotor
from systems import linear_model

RNG = np.random.default_rng(0)


def test_the_exponential_function_and_its_slope():
    x = np.concatenate([np.linspace(-708, 700, 4001), [0.0, -0.0, 1e-20, -1e-300]])
    np.testing.assert_allclose(jax.jit(exp)(x), np.exp(x), rtol=5e-16, atol=0)
    ends = jax.jit(exp)(jnp.array([-709.0, -1e9, -np.inf, np.nan]))
    np.testing.assert_array_equal(ends, [0.0, 0.0, 0.0, np.nan])
    np.testing.assert_allclose(jax.grad(exp)(-1.5), np.exp(-1.5), rtol=1e-15)


def model(points: int) -> DFSM:
    """Three states, a control and two disturbances, the second of them the schedule."""
    units = GaussianUnits(
        shift=jnp.zeros(6),
        scale=jnp.array([1.0, np.inf, 2.0, 1.5, np.inf, 1.0]),
        centres=jnp.asarray(RNG.normal(size=(6, 5))),
        weights=jnp.asarray(RNG.normal(size=(1, 5))),
        bias=jnp.array([0.3]),
    )
    plain = linear_model(np.eye(3), np.ones((3, 3)), corrective=units)
    s = plain.signals
    control, *disturbances = s.controls
    signals = replace(s, controls=(control,), disturbances=tuple(disturbances))
    channels = {c.name: Channel(c.name, c.unit) for c in signals.inputs}
    columns = {name: i for i, name in enumerate(channels)}
    term = Product(factors=("u0", "x1", "u2")).term(channels, columns)
    f = LinearModel(
        jnp.linspace(-1.0, 2.0, points) if points > 1 else jnp.zeros(1),
        jnp.asarray(RNG.normal(size=(points, 3, 7))),
        jnp.asarray(RNG.normal(size=(points, 3))),
        2 if points > 1 else None,
    )
    terms = Terms((term,), jnp.zeros(1), jnp.ones(1))
    return replace(plain, f=f, signals=signals, terms=terms)


@pytest.mark.parametrize("points", [1, 4])
def test_a_staged_model_is_the_same_function(points):
    whole = model(points)
    fast = staged(whole)
    x, u, w = (RNG.uniform(-2, 3, (30, n)) for n in (3, 1, 2))
    way = RNG.normal(size=3)

    def both(m: DFSM, x, u, w):
        return jax.jvp(lambda x: m.derivative(x, u, w), (x,), (way,))

    found, expected = (jax.jit(jax.vmap(partial(both, m)))(x, u, w) for m in (fast, whole))
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)
    if points == 1:
        many = fast.derivative(x, u, w)
        np.testing.assert_allclose(many, expected[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("points", [1, 5])
@pytest.mark.parametrize(("few", "moving"), [(0.1, 0.3), (0.1, 0.0), (1.0, 0.5), (1.0, 1.0)])
def test_coefficients_that_are_zero_or_the_same_along_the_schedule_are_told_apart(
    points, few, moving
):
    shape = (points, 9, 50)
    L = np.where(RNG.random(shape[1:]) < few, RNG.normal(size=shape[1:]), 0.0) * np.ones(shape)
    L = np.where((L != 0) & (RNG.random(shape[1:]) < moving), L + RNG.normal(size=shape), L)
    L[:, 4] = 0.0
    grid = jnp.cumsum(jnp.asarray(RNG.uniform(0.5, 2, points)))
    offsets = jnp.asarray(RNG.normal(size=shape[:2]))
    linear = LinearModel(grid, jnp.asarray(L), offsets, None if points == 1 else 0)
    order = RNG.permutation(50)
    split = SplitLinear.of(linear, order[:25].tolist(), order[25:].tolist())
    inputs = RNG.normal(size=(40, 50))
    inputs[:, 0] = RNG.uniform(float(grid[0]) - 1, float(grid[-1]) + 1, 40)
    way = RNG.normal(size=50)

    def apart(row):
        return split(row[order[:25]], row[order[25:]], row[0])

    def both(f):
        return jax.jit(jax.vmap(lambda row: jax.jvp(f, (row,), (way,))))(inputs)

    np.testing.assert_allclose(both(apart), both(linear), rtol=1e-12, atol=1e-12)
    # Few are written out one by one, many are a matrix.
    many = (split.first.same, split.first.along)[int(points > 1 and moving == 1)]
    assert (many.entries is None) == (few == 1)


@pytest.mark.parametrize("lags", [False, True])
def test_a_staged_rotor_has_the_same_forces(lags):
    settings = rotor(
        hub_height=150.0,
        pitch_rate="PitchRate",
        surge_rate="Surge",
        corrections=("Inner", "Outer"),
        uncertainty=0.1,
    )
    term = settings.term(CHANNELS, COLUMNS, {"Wind": 3.0, "Inner": 1.5, "Outer": 1.0})
    schedule = Schedule(COLUMNS["Wind"], np.array([6.0, 9.0, 15.0]))
    first = len(UNITS)
    if lags:
        term, first = term.lagging(("induced", "slow"), first), first + 2
    late = term.with_latents(["l0", "l1"], first, np.array([0.4, -0.2]), schedule)
    moved = late.moved([jnp.asarray(RNG.normal(size=a.shape)) for a in late.parameters])
    low, high = [2, 0, -8, -1, -1, -2, -2, -1, -1, 4], [25, 9, 40, 1, 1, 2, 2, 1, 1, 18]
    rows = RNG.uniform(low, high, (40, 10))
    if lags:
        rows = np.insert(rows, [7, 7], RNG.uniform(0, 5, (40, 2)), axis=1)
    signals, ready = jnp.asarray(rows), moved.staged()
    both = jax.jit(jax.vmap(lambda row: (ready.of_numbers(list(row)), moved.values(row))))
    forces, expected = map(np.asarray, both(signals))
    size = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(forces / size, expected / size, rtol=0, atol=1e-13)

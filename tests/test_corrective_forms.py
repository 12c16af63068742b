"""What every form of a corrective function promises, and a kind that the package does not know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dfsm
from dfsm.core.host import from_host
from dfsm.core.settings import settings_class
from dfsm.fitting.corrective import CorrectiveFit, TrainingSet
from dfsm.models.corrective import FORMS, Corrective, GaussianUnits, Perceptron
from dfsm.models.latents import Poles, add_latents
from dfsm.models.model_folder import load, save
from dfsm.refinement.parameters import Parametrization
from systems import DUFFING


class Cubes(Corrective):
    """A z³: a form that only this test knows."""

    kind = "cubes"
    matrix: jax.Array

    def __call__(self, inputs: jax.Array) -> jax.Array:
        return self.matrix @ ((inputs - self.shift) / self.scale) ** 3

    def select(self, rows: Sequence[int]) -> Cubes:
        return replace(self, matrix=self.matrix[np.array(rows)])

    def with_more_inputs(self, at: int, count: int) -> Cubes:
        place = np.full(count, at)
        return Cubes(
            from_host(np.insert(self.shift, place, 0.0)),
            from_host(np.insert(self.scale, place, 1.0)),
            from_host(np.insert(self.matrix, place, 0.0, axis=1)),
        )

    @property
    def parameters(self) -> tuple[jax.Array, ...]:
        return (self.matrix,)

    def moved(self, deviations: Sequence[jax.Array], spread: jax.Array) -> Cubes:
        return replace(self, matrix=self.matrix + spread[:, None] * deviations[0])


@settings_class
class LeastCubes:
    """Cubes by least squares."""

    kind: Literal["cubes"] = "cubes"

    def train(self, data: TrainingSet, seed: int) -> CorrectiveFit:
        cubes = data.z**3
        A, left = np.linalg.lstsq(cubes, data.targets)[:2]
        function = Cubes(
            *map(from_host, (data.shift, data.scale, (A * data.target_scale).T)),
        )
        return CorrectiveFit(function, 1 - left / len(cubes), "cubes")


def forms() -> dict[str, Corrective]:
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> jax.Array:
        return from_host(rng.normal(size=shape))

    shift, scale = normal(3), 1 + normal(3) ** 2
    return {
        "gaussian_units": GaussianUnits(shift, scale, normal(3, 5), normal(2, 5), normal(2)),
        "perceptron": Perceptron(
            shift,
            scale,
            (normal(4, 3), normal(4, 4), normal(2, 4)),
            (normal(4),) * 2 + (normal(2),),
        ),
        "cubes": Cubes(shift, scale, normal(2, 3)),
    }


@pytest.fixture(params=forms())
def form(request) -> Corrective:
    return forms()[request.param]


POINTS = np.random.default_rng(1).normal(size=(20, 3))


def values(function, points: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(function)(from_host(points)))


def test_prepared_it_is_the_same_function(form):
    expected = values(form, POINTS)
    np.testing.assert_allclose(values(form.prepared(), POINTS), expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(values(form.prepared().prepared(), POINTS), expected)


def test_some_targets_are_those_of_all(form):
    one = form.select([1])
    np.testing.assert_allclose(values(one, POINTS), values(form, POINTS)[:, 1:], rtol=1e-12)


def test_ignored_inputs_are_held_at_the_middle(form):
    held = POINTS.copy()
    held[:, [0, 2]] = np.asarray(form.shift)[[0, 2]]
    ignoring = form.ignoring([0, 2])
    np.testing.assert_allclose(values(ignoring, POINTS), values(form, held), rtol=1e-12)


def test_more_inputs_have_no_effect(form):
    wide = np.insert(POINTS, [1, 1], np.random.default_rng(2).normal(size=(20, 2)), axis=1)
    np.testing.assert_allclose(
        values(form.with_more_inputs(1, 2), wide), values(form, POINTS), rtol=1e-12, atol=1e-13
    )


def test_deviations_add_to_parameters(form):
    zero = [jnp.zeros(p.shape) for p in form.parameters]
    spread = jnp.array([2.0, 0.5])
    for before, after in zip(
        jax.tree.leaves(form), jax.tree.leaves(form.moved(zero, spread)), strict=True
    ):
        np.testing.assert_array_equal(before, after)
    # What is in the unit of a target moves it by its own spread: the last of all forms is.
    *rest, last = [jnp.ones(p.shape) for p in form.parameters]
    change = form.moved([*map(jnp.zeros_like, rest), last], spread).parameters[-1]
    change = np.asarray(change - form.parameters[-1])
    np.testing.assert_allclose(change, (np.ones(change.T.shape) * np.asarray(spread)).T)


def test_it_comes_back_from_what_is_kept(form):
    again = type(form).restored(form.arrays(), form.structure())
    assert jax.tree.structure(again) == jax.tree.structure(form)
    for before, after in zip(jax.tree.leaves(form), jax.tree.leaves(again), strict=True):
        assert before is after


def test_the_registry_names_every_form_of_the_package():
    assert list(FORMS) == ["gaussian_units", "perceptron", "polynomial"]
    assert {kind: FORMS[kind].kind for kind in FORMS} == {kind: kind for kind in FORMS}


def test_a_new_kind_needs_no_change_elsewhere(monkeypatch, tmp_path):
    """Fitted, saved, loaded, with latent states added and as refinement sees it."""
    runs = DUFFING.many(4, [(0, 3), (0, 2)], np.arange(0, 20.01, 0.05), spread=0.8)
    settings = dfsm.FitSettings(
        states=(dfsm.StateSpec(name="q", order=2),),
        controls=("u",),
        disturbances=("w",),
        corrective=LeastCubes(),  # pyright: ignore[reportArgumentType]
    )
    result = dfsm.fit(runs, settings)
    model = result.model
    assert isinstance(model.e, Cubes)
    assert result.nonlinear is not None
    # q̈ = … − 3 q³, of which the linear fit has taken the part that is like q.
    x, v = runs[0].select(["q", "v"]).values, runs[0].select(["u", "w"]).values
    truth = DUFFING.f(x.T, v.T).T[:, 1]
    errors = [
        np.std(np.asarray(m.derivative(x, v[:, :1], v[:, 1:]))[:, 1] - truth)
        for m in (model, model.linear_fit())
    ]
    assert errors[0] < 0.75 * errors[1]

    with monkeypatch.context() as patch:
        patch.setitem(FORMS, "cubes", Cubes)  # pyright: ignore[reportArgumentType]
        save(model, tmp_path / "m", result.nonlinear)
        again = load(tmp_path / "m")
    np.testing.assert_array_equal(again.derivative(x, v[:, :1], v[:, 1:]),
                                  model.derivative(x, v[:, :1], v[:, 1:]))  # fmt: skip
    with pytest.raises(dfsm.DfsmError, match="'cubes'"):
        load(tmp_path / "m")

    pair = Poles(jnp.ones(1), jnp.ones(1), jnp.ones((1, 2), dtype=complex), jnp.zeros(1, complex))
    wide = add_latents(model, pair, np.zeros((2, 2)), [np.zeros((3, 2)), np.ones((3, 2))])
    z = np.column_stack([x, np.random.default_rng(0).normal(size=(len(x), 2))])
    np.testing.assert_allclose(
        wide.derivative(z, v[:, :1], v[:, 1:])[:, :2],
        model.derivative(x, v[:, :1], v[:, 1:]),
        rtol=1e-12,
        atol=1e-12,
    )
    parameters = Parametrization.of(wide, np.ones(2))
    theta = np.zeros(parameters.size)
    theta[-1] = 0.1  # the last element of the only corrected row
    moved = parameters.at(jnp.asarray(theta))
    change = np.asarray(moved.e.matrix - wide.e.matrix)
    np.testing.assert_allclose(change, [[0, 0, 0, 0, 0, 0.1]], atol=1e-15)


@pytest.mark.parametrize("ignored", [(1,), (), (0, 1, 2)])
def test_stripped_of_inputs_without_effect_it_is_the_same_function(ignored):
    units = forms()["gaussian_units"].ignoring(ignored)
    ready = units.stripped()
    assert ready.scale.shape == (3 - len(ignored),)
    np.testing.assert_allclose(values(ready, POINTS), values(units, POINTS), rtol=1e-13)
    assert ready.stripped() is ready

"""Linear fits with eigenvalues left of a margin."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from dfsm.core.types import Array
from dfsm.data.derivatives import StateSpec
from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV, LTI, LinearFit, fit_linear, schedule_windows
from dfsm.fitting.settings import FitSettings
from dfsm.fitting.stabilize import stabilise, state_matrix
from dfsm.models.corrective import GaussianUnits
from dfsm.models.stability import destabilised, eigen, fastest_growth
from systems import OSCILLATOR_A, Q, System, U, V, linear_model

# Inputs [u, w, x1, x2, v1, v2]; x' = v is known, v' is fitted.
NAMES = ["u", "w", "x1", "x2", "v1", "v2"]
COLUMNS, KNOWN = slice(2, 6), {0: 2, 1: 3}


def samples(seed: int = 0, growth: float = 0.02) -> tuple[Array, Array]:
    """Noisy accelerations of two coupled oscillators, the first of which grows."""
    rng = np.random.default_rng(seed)
    inputs = rng.normal(size=(4000, 6)) @ (np.eye(6) + 0.3 * rng.normal(size=(6, 6)))
    inputs[:, 1] += 8.0
    A = np.array([[-1.0, 0.1, 2 * growth, 0.0], [0.2, -4.0, 0.1, -0.5]])
    targets = inputs[:, 2:] @ A.T + inputs[:, :2] @ rng.normal(size=(2, 2)) + [1.0, -2.0]
    return inputs, targets + 0.5 * rng.normal(size=targets.shape)


def eigenvalues(fit: LinearFit) -> list[Array]:
    found = []
    for L in np.asarray(fit.model.coefficients):
        found.append(np.linalg.eigvals(state_matrix(L, COLUMNS, KNOWN)).real)
    return found


def residuals(fit: LinearFit, inputs: Array, targets: Array) -> Array:
    L, b = np.asarray(fit.model.coefficients[0]), np.asarray(fit.model.offsets[0])
    return np.sqrt(np.mean((targets - inputs @ L.T - b) ** 2, axis=0))


@pytest.mark.parametrize("margin", [0.001, 0.05, 0.3])
def test_eigenvalues_end_left_of_the_margin(margin: float) -> None:
    inputs, targets = samples()
    plain = fit_linear([(inputs, targets)], NAMES, LTI())
    assert max(eigenvalues(plain)[0]) > 0
    stable, moved = stabilise(plain, COLUMNS, KNOWN, margin, affine=True)
    assert max(eigenvalues(stable)[0]) <= -margin
    assert moved == [0.0]
    # What the account says is what the samples say.
    assert stable.residual_rms == pytest.approx(residuals(stable, inputs, targets), rel=1e-9)
    assert np.all(stable.residual_rms >= plain.residual_rms * (1 - 1e-12))


def test_the_change_is_the_cheapest_one() -> None:
    inputs, targets = samples()
    margin = 0.05
    plain = fit_linear([(inputs, targets)], NAMES, LTI())
    stable, _ = stabilise(plain, COLUMNS, KNOWN, margin, affine=True)
    variance = plain.residual_rms**2

    columns = range(COLUMNS.start, COLUMNS.stop)

    def cost(fixed: Array) -> float:
        found = plain.equations[0].complete(columns, fixed.reshape(2, 4), True)
        return float(np.sum(found[2] / variance))

    def room(fixed: Array) -> float:
        L = np.zeros((2, 6))
        L[:, COLUMNS] = fixed.reshape(2, 4)
        return float(-margin - np.linalg.eigvals(state_matrix(L, COLUMNS, KNOWN)).real.max())

    start = np.asarray(stable.model.coefficients[0])[:, COLUMNS].ravel()
    constraint: Any = {"type": "ineq", "fun": room}
    best = minimize(cost, start, method="SLSQP", constraints=constraint)
    least = cost(np.asarray(plain.model.coefficients[0])[:, COLUMNS].ravel())
    assert cost(start) > least
    # An independent constrained optimizer, started there, finds nothing much cheaper.
    assert cost(start) - least <= 1.05 * (best.fun - least)


def test_a_stable_fit_is_left_alone() -> None:
    inputs, targets = samples(growth=-0.3)
    plain = fit_linear([(inputs, targets)], NAMES, LTI())
    stable, moved = stabilise(plain, COLUMNS, KNOWN, 0.01, affine=True)
    assert moved == []
    np.testing.assert_array_equal(stable.model.coefficients, plain.model.coefficients)
    np.testing.assert_array_equal(stable.model.offsets, plain.model.offsets)


def test_every_schedule_point_is_made_stable() -> None:
    inputs, targets = samples()
    choice = LPV(schedule="w", points=4)
    windows = schedule_windows(inputs[:, 1], 4)
    plain = fit_linear([(inputs, targets)], NAMES, choice, windows)
    stable, moved = stabilise(plain, COLUMNS, KNOWN, 0.05, affine=True)
    unstable = [m > -0.05 for m in map(max, eigenvalues(plain))]
    assert moved == [float(g) for g, u in zip(plain.model.grid, unstable, strict=True) if u]
    assert len(moved) > 0
    assert all(max(e) <= -0.05 for e in eigenvalues(stable))


def test_coefficients_that_are_known_stay() -> None:
    inputs, targets = samples()
    known = {(0, 2): -1.1, (1, 4): 0.2, (0, 0): 0.5}
    plain = fit_linear([(inputs, targets)], NAMES, LTI(), known=known)
    assert max(eigenvalues(plain)[0]) > 0
    stable, _ = stabilise(plain, COLUMNS, KNOWN, 0.05, affine=True)
    assert max(eigenvalues(stable)[0]) <= -0.05
    L = np.asarray(stable.model.coefficients[0])
    for place, value in known.items():
        assert L[place] == value
    assert stable.residual_rms == pytest.approx(residuals(stable, inputs, targets), rel=1e-9)
    # The rest is fitted to what the state matrix and the known ones leave: optimal in each row.
    left = targets - inputs @ L.T - np.asarray(stable.model.offsets[0])
    assert np.abs(left.mean(axis=0)).max() < 1e-9
    assert np.abs(inputs[:, 1] @ left).max() < 1e-6 * len(inputs)


def test_a_growth_that_is_known_cannot_be_removed() -> None:
    inputs, targets = samples()
    known = {(row, column): 0.1 for row in range(2) for column in range(2, 6)}
    plain = fit_linear([(inputs, targets)], NAMES, LTI(), known=known)
    with pytest.raises(DfsmError, match="no stable linear fit was found"):
        stabilise(plain, COLUMNS, KNOWN, 0.05, affine=True)


@pytest.mark.parametrize("margin", [0.0, -1.0])
def test_a_margin_must_be_positive(margin: float) -> None:
    inputs, targets = samples()
    plain = fit_linear([(inputs, targets)], NAMES, LTI())
    with pytest.raises(DfsmError, match=r"linear\.margin is .* expected a positive number"):
        stabilise(plain, COLUMNS, KNOWN, margin, affine=True)


def test_a_mode_out_of_reach_is_an_error() -> None:
    # x1' = x1 is declared kinematic with itself: no fitted row can change that eigenvalue.
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(500, 2))
    targets = -inputs[:, 1:] + 0.1 * rng.normal(size=(500, 1))
    plain = fit_linear([(inputs, targets)], ["a", "b"], LTI())
    with pytest.raises(DfsmError, match="no stable linear fit was found"):
        stabilise(plain, slice(0, 2), {0: 0}, 0.1, affine=True)


def test_a_correction_that_destabilises_an_operating_point_is_named():
    def bumps(height: float) -> GaussianUnits:
        # Two units at ±1 of the last state: an odd function with a slope at its middle.
        centres = jnp.zeros((3, 2)).at[2].set(jnp.array([-1.0, 1.0]))
        weights = jnp.array([[-height, height]])
        return GaussianUnits(jnp.zeros(3), jnp.ones(3), centres, weights, jnp.zeros(1))

    B = np.array([[0.0], [2.0]])
    assert destabilised(linear_model(OSCILLATOR_A, B)) is None
    assert destabilised(linear_model(OSCILLATOR_A, B, corrective=bumps(-1.0))) is None
    said = destabilised(linear_model(OSCILLATOR_A, B, corrective=bumps(1.0)))
    growth = np.linalg.eigvals(OSCILLATOR_A + np.diag([0.0, 4 * np.exp(-1)])).real.max()
    assert growth > 0
    assert said == f"with a correction the model would be unstable (growth {growth:.2g} 1/s)"


def test_mixtures_of_schedule_points_are_stable_too() -> None:
    """Half of [[-1, 4], [0, -1]] and half of its transpose has the eigenvalue 1."""
    rng = np.random.default_rng(0)
    upper = np.array([[-1.0, 4.0], [0.0, -1.0]])
    parts = []
    for wind, A in ((0.0, upper), (1.0, upper.T)):
        x = rng.normal(size=(3000, 2))
        inputs = np.concatenate([wind + 0.05 * rng.normal(size=(3000, 1)), x], axis=1)
        parts.append((inputs, x @ A.T + 0.1 * rng.normal(size=(3000, 2))))
    windows = np.array([[-0.5, 0.5], [0.5, 1.5]])
    plain = fit_linear(parts, ["w", "a", "b"], LPV(schedule="w", points=2), windows)
    columns = slice(1, 3)
    at_points = [
        np.linalg.eigvals(L[:, 1:]).real.max() for L in np.asarray(plain.model.coefficients)
    ]
    assert max(at_points) < -0.7
    assert fastest_growth(np.asarray(plain.model.coefficients)[:, :, columns]) == pytest.approx(
        1.0, abs=0.05
    )
    stable, moved = stabilise(plain, columns, {}, 0.1, affine=True)
    assert fastest_growth(np.asarray(stable.model.coefficients)[:, :, columns]) <= -0.1
    assert len(moved) == 2


# -- eigenvalues that meet ----------------------------------------------------------------------

INTEGRATORS = System(
    (Q, V),
    (U,),
    (Channel("y", "m"),),
    f=lambda x, v: np.stack([x[1], v[0]]),
    g=lambda x, v: x[:1],
)


def test_slopes_of_eigenvalues_against_differences() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        A, change = rng.normal(size=(2, 4, 4))
        values, left, right = eigen(A)
        slopes = [w.conj() @ change @ v for w, v in zip(left, right, strict=True)]
        step = 1e-6
        there, back = (np.linalg.eigvals(A + h * change) for h in (step, -step))
        for value, slope in zip(values, slopes, strict=True):
            after, before = (some[np.argmin(abs(some - value))] for some in (there, back))
            assert slope == pytest.approx((after - before) / (2 * step), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize(
    "A",
    [
        np.diag(np.ones(1), 1),
        np.diag(np.ones(3), 1),
        np.diag(np.ones(1), 1) + 1e-13 * np.array([[0, 0], [1, -2]]),
        np.zeros((3, 3)),
        np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 2.0]]),
    ],
)
def test_eigenvectors_of_a_jordan_block_are_finite(A: Array) -> None:
    values, left, right = eigen(A)
    for found in (values, left, right):
        assert np.isfinite(found).all()
    assert np.abs(left).max() < 1e9
    # They are left and right eigenvectors all the same.
    np.testing.assert_allclose(A @ right.T, right.T * values, atol=1e-6)
    sizes = np.linalg.norm(left, axis=1)[:, None]
    np.testing.assert_allclose(
        left.conj() / sizes @ A, values[:, None] * left.conj() / sizes, atol=1e-6
    )


@pytest.mark.parametrize("margin", [0.01, 0.1, 1.0])
def test_a_double_integrator_can_be_made_stable(margin: float) -> None:
    """A = [[0, 1], [0, 0]] has one eigenvector; both eigenvalues must go."""
    runs = INTEGRATORS.many(4, [(0.0, 1.0)], np.arange(0, 10.01, 0.05))
    settings = FitSettings(
        states=(StateSpec(name="q", order=2, rate="v"),),
        controls=("u",),
        linear=LTI(margin=margin),
        corrective=NoCorrection(),
        nonlinear_only=False,
    )
    model = fit(runs, settings).model
    ((_, values),) = model.eigenvalues()
    assert values.real.max() <= -margin
    # Not further than needed: the cheapest pair of a given decay lies on the margin.
    assert values.real.min() > -3 * margin
    (note,) = [c for c in model.provenance.record["checks"] if "eigenvalues were moved" in c]
    assert f"-{margin:g} 1/s" in note


def test_two_double_integrators_can_be_made_stable() -> None:
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(4000, 6)) * [1, 1, 3, 0.5, 1, 2]
    targets = inputs[:, :2] @ np.array([[1.0, 0.2], [0.1, 2.0]])
    plain = fit_linear([(inputs, targets)], NAMES, LTI())
    stable, moved = stabilise(plain, COLUMNS, KNOWN, 0.1, affine=True)
    assert moved == [0.0]
    assert max(eigenvalues(stable)[0]) <= -0.1


def test_a_state_that_never_varies_is_told() -> None:
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(500, 6))
    inputs[:, 3] = inputs[:, 5] = 0.0
    targets = rng.normal(size=(500, 2))
    plain = fit_linear([(inputs, targets)], NAMES, LTI())
    with pytest.raises(DfsmError, match=r"linear\.margin needs runs in which all states vary"):
        stabilise(plain, COLUMNS, KNOWN, 0.1, affine=True)

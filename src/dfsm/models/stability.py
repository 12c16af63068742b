"""Stability with the schedule frozen: eigenvalues of A at and between schedule points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import numpy as np
import scipy

from dfsm.core.host import from_host
from dfsm.core.types import Array, ComplexArray
from dfsm.models.dfsm import DFSM
from dfsm.models.latents import at_rest

# Between two schedule points A is a mixture of theirs; that many mixtures are examined.
_MIXTURES = 9
# Cosine between left and right eigenvectors below which eigenvalues count as shared: eigenvalues
# that rounding has split lie its root apart.
_DEFECTIVE = float(np.sqrt(np.finfo(float).eps))
# A corrective function is examined at so many places from one operating point to the next.
_PLACES = 4
# Growth to less than e to this power over the longest run is that of an integrator, and one within
# so many standard errors of zero is not told from it.
_INTEGRATES, _TOLD = 0.05, 2.0


@dataclass(frozen=True)
class Growth:
    """What the fastest mode of a model does at one schedule value.

    Attributes
    ----------
    schedule
        The value.
    rate
        Largest real part of the eigenvalues in 1/s.
    seconds
        Longest training run; 0 where nobody knows, and then the sign alone judges.
    error
        Standard error of `rate`, or 0.
    """

    schedule: float
    rate: float
    seconds: float = 0.0
    error: float = 0.0

    @property
    def integrates(self) -> bool:
        """Whether the mode neither grows nor decays over the longest run, or is exactly zero."""
        return abs(self.rate) * self.seconds <= _INTEGRATES and (self.rate == 0 or self.seconds > 0)

    @property
    def unclear(self) -> bool:
        """Whether it grows, but by no more than is known of it."""
        return not self.integrates and 0 < self.rate <= _TOLD * self.error

    @property
    def unstable(self) -> bool:
        """Whether it grows, over the longest run and beyond doubt."""
        return self.rate > 0 and not self.integrates and not self.unclear

    @property
    def word(self) -> str:
        """How a table marks it; empty for a stable one."""
        if self.unstable:
            return "UNSTABLE"
        if self.integrates:
            return "integrator"
        return "growth within two standard errors" if self.unclear else ""


def growths(model: DFSM, seconds: float, errors: Array | None = None) -> list[Growth]:
    """Judge the whole model, corrective function included, at its operating points.

    Parameters
    ----------
    model
        Any; latent states decay whatever the inputs are.
    seconds
        Longest training run.
    errors
        Standard errors of the linear fit's coefficients of the states, ``(state, state)``; they
        say nothing of a model with a corrective function.

    Returns
    -------
    list of Growth
        In the order of the schedule; one of an LTI model without a corrective function.
    """
    if model.e is not None:
        grid, points = operating_points(model)
        rates = np.linalg.eigvals(state_matrices(model, points)).real.max(axis=1)
        return [Growth(float(s), float(r), seconds) for s, r in zip(grid, rates, strict=True)]
    found = []
    for point, A in zip(np.asarray(model.f.grid), model.linear_state_matrices(), strict=True):
        eigenvalues, left, right = eigen(A)
        k = int(np.argmax(eigenvalues.real))
        error = 0.0
        if errors is not None:
            # dλ = wᴴ dA v, with errors of A's entries that are taken as independent.
            slopes = np.real(np.outer(left[k].conj(), right[k]))
            known = np.nan_to_num(errors, nan=0.0, posinf=np.inf)
            error = float(np.sqrt(np.sum((slopes * np.where(slopes, known, 0.0)) ** 2)))
        found.append(Growth(float(point), float(eigenvalues[k].real), seconds, error))
    return found


def told_growths(model: DFSM) -> list[Growth]:
    """`growths` of a model that was fitted, as its record has them, else judged here."""
    record = model.provenance.record
    if "growth" in record:
        return [Growth(**entry) for entry in record["growth"]]
    lengths = [d.get("seconds") for d in record.get("data", [])]
    seconds = max((s for s in lengths if isinstance(s, int | float)), default=0.0)
    return growths(model, seconds)


def places(growths: Sequence[Growth], schedule: str | None) -> str:
    """Where they are, for a sentence."""
    if not schedule:
        return "its only point"
    return f"{schedule} = {', '.join(f'{g.schedule:.4g}' for g in growths)}"


def fastest_growth(A: Array) -> float:
    """Largest real part in 1/s of the eigenvalues at all schedule values, each frozen.

    Parameters
    ----------
    A
        Of a linear model at its schedule points, shape ``(point, state, state)``.
    """
    at_points = max(float(np.linalg.eigvals(a).real.max()) for a in A)
    return max([at_points, *(growth_between(a, b) for a, b in pairwise(A))])


def growth_between(A: Array, B: Array) -> float:
    """Largest real part of the eigenvalues of mixtures of two matrices."""
    shares = np.linspace(0, 1, _MIXTURES + 2)[1:-1, None, None]
    return float(np.linalg.eigvals((1 - shares) * A + shares * B).real.max())


def eigen(A: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Eigenvalues with left and right eigenvectors, from which their slopes follow.

    dλ = wᴴ dA v with wᴴ v = 1. Where eigenvalues meet and share one eigenvector, as those of a
    double integrator do, wᴴ v = 0: they move like a root of the change, and have no slope. There,
    and as near to it as rounding can tell, w stops growing: a large but finite slope along the
    change that splits them.

    Parameters
    ----------
    A
        Shape ``(state, state)``.

    Returns
    -------
    tuple of ndarray
        λ, shape ``(state,)``, and w and v as rows, ``(state, state)``.
    """
    solution: Any = scipy.linalg.eig(A, left=True, right=True)
    eigenvalues, left, right = solution[0], solution[1].T, solution[2].T
    # Cosine of the angle between vectors of length one: the eigenvalue's reciprocal condition.
    cosine = np.sum(left.conj() * right, axis=1)
    size = np.abs(cosine)
    phase = np.where(size > 0, cosine, 1.0) / np.where(size > 0, size, 1.0)
    scale = phase * np.maximum(size, _DEFECTIVE)
    return eigenvalues, left / scale.conj()[:, None], right


def destabilised(model: DFSM) -> str | None:
    """Tell whether the corrective function makes an operating point, or one between two, unstable.

    Parameters
    ----------
    model
        Its linear fit is stable.

    Returns
    -------
    str or None
        What would go wrong, for the user; None where nothing does.
    """
    if model.e is None:
        return None
    grid, points = operating_points(model)
    growth = np.linalg.eigvals(state_matrices(model, points)).real.max(axis=1)
    worst = int(np.argmax(growth))
    if growth[worst] <= 0:
        return None
    place = f" at {model.schedule} = {grid[worst]:.4g}" if model.schedule else ""
    return f"with a correction the model would be unstable{place} (growth {growth[worst]:.2g} 1/s)"


def state_matrices(model: DFSM, points: Array) -> Array:
    """A at inputs ``(point, input)`` with latent states at rest, ``(point, state, state)``."""
    return np.asarray(_state_matrices(model, from_host(points)))


@eqx.filter_jit
def _state_matrices(model: DFSM, points: jax.Array) -> jax.Array:
    def at_point(inputs: jax.Array) -> jax.Array:
        x, *others = model.split(at_rest(model, inputs))
        return jax.jacfwd(lambda x: model.derivative(x, *others))(x)

    return jax.vmap(at_point)(points)


def operating_points(model: DFSM) -> tuple[Array, Array]:
    """Schedule values ``(point,)`` and inputs ``(point, input)`` where stability is looked at."""
    grid, operating = np.asarray(model.region.grid), np.asarray(model.region.operating)
    places = np.arange((len(grid) - 1) * _PLACES + 1) / _PLACES
    table = np.column_stack([grid, operating]).T
    points = np.stack([np.interp(places, np.arange(len(grid)), row) for row in table], axis=1)
    return points[:, 0], points[:, 1:]

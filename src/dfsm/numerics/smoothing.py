"""Splines that differentiate: a quintic that finds its own amount of smoothing, and the paper's.

The smoothing fit minimises ``sum (y_i - f(t_i))**2 + λ ∫ f'''(t)**2 dt`` over quintic splines.
λ comes from the noise level where the file states its quantisation step, else from generalised
cross-validation. Penalising the third derivative is what makes the *second* derivative good: a
cubic smoothing spline penalises the very quantity that is wanted.

The normal equations are banded, ``(BᵀB + λΩ) c = Bᵀy``, and the effective degrees of freedom are
exact: ``tr H = p - d log det(BᵀB + λΩ) / d log λ``, from the Cholesky factor's diagonal.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from dfsm.core.shapes import Series
from dfsm.core.types import Array, IntArray
from dfsm.errors import DfsmError

MIN_SAMPLES = 8
_CROSS_VALIDATED = 20  # with fewer samples, noise cannot be told from curvature
_DEGREE = 5
_WIDTH = _DEGREE + 1  # B-splines that are not zero at a point
# Smoothing length λ^(1/6) over knot spacing: each set of knots serves the range _KEEP to _HEAVY.
# Below it the knots would limit the fit, above it the equations lose digits (condition ~ ratio^6).
_HEAVY, _KEEP, _LIGHT = 8.0, 2.0, 0.1
_THINNING = _HEAVY / _KEEP  # knot spacing of one level over that of the next finer one
_STEPS = 8  # values of λ tried per level
# Products of so many numbers BLAS shares among threads, which wait for one another many times
# longer than they work.
_THREADED = 10_000
_KEPT = 20_000  # size of equations up to which their factors are kept


@dataclass(frozen=True, eq=False)
class SmoothResult:
    """A smoothed signal with its derivatives.

    Attributes
    ----------
    values, first, second
        Signal, first and second time derivative at the samples, each of shape ``(time,)``, in the
        signal's unit, unit/s and unit/s².
    noise_std
        Standard deviation of the noise, in the signal's unit: ``step / sqrt(12)`` where the
        quantisation step set λ, else the estimate from the residual; 0 for interpolation.
    smoothing
        λ of the criterion, in s⁵ for time in s; 0 for interpolation.
    degrees_of_freedom
        Effective number of parameters, tr H: 3 for a parabola, the number of samples for
        interpolation.
    chosen_by
        What set λ. Data without visible noise is interpolated.
    """

    values: Series
    first: Series
    second: Series
    noise_std: float
    smoothing: float
    degrees_of_freedom: float
    chosen_by: Literal["noise level", "cross-validation", "interpolation"]


def smoothing_spline(time: ArrayLike, values: ArrayLike, step: float | None = None) -> SmoothResult:
    """Smooth a signal and differentiate it twice; nothing needs tuning.

    With a known quantisation step q the noise variance is ``q**2 / 12`` and λ is the largest whose
    residual variance ``RSS / (N - tr H)`` does not exceed it (Hall and Titterington, 1987, and
    the discrepancy principle with the fit's own degrees of freedom). That also holds for coarse
    steps, whose rounding errors are not white, where cross-validation follows the staircase.
    Without a step, or where the signal holds more noise than the step explains, λ minimises
    the generalised cross-validation score ``RSS / (N - tr H)**2`` (Craven and Wahba, 1979);
    data without visible noise, and fewer than 20 samples, are interpolated.

    Near the ends, over a few ``(λ h)**(1/6)`` for samples h apart, the second derivative levels
    off: there is data on one side only.

    Parameters
    ----------
    time
        Strictly increasing mesh, shape ``(time,)``, in s; it need not be equidistant.
    values
        Samples, shape ``(time,)``.
    step
        Quantisation step in the unit of `values`, None where unknown.

    Returns
    -------
    SmoothResult
        Values, derivatives and what was chosen.

    Raises
    ------
    DfsmError
        Fewer than 8 samples, a mesh that does not increase, shapes that differ, values that are
        not finite, or a step that is not positive.
    """
    t, y = checked(time, values)
    if step is not None and not (np.isfinite(step) and step > 0):
        raise DfsmError(f"a quantisation step of {step} was given: give a positive one or None")
    known = None if step is None else float(step) / 12**0.5
    centre, scale = float(y.mean()), float(np.ptp(y))
    if scale < np.finfo(np.float64).tiny:
        zero = np.zeros_like(y)
        return SmoothResult(y, zero, zero, known or 0.0, np.inf, 1.0, "interpolation")
    mesh = _mesh(t.tobytes())
    z = (y - centre) / scale
    # Noise beyond a thousand times the signal's range leaves a parabola, as a thousand does.
    variance = None if known is None else min(known / scale, 1e3) ** 2
    with threadpool_limits(limits=1) if len(z) > _THREADED else nullcontext():
        choice = _choose(mesh, z, variance)
    if choice is None:
        return SmoothResult(*interpolate(t, y), 0.0, 0.0, float(len(t)), "interpolation")
    level, lam, noise, chosen_by = choice
    c, residual = level.fit(z, lam)
    spline = scipy.interpolate.BSpline(level.knots, c, _DEGREE)
    return SmoothResult(
        values=y - scale * residual,
        first=spline(mesh.x, 1) * (scale / mesh.h),
        second=spline(mesh.x, 2) * (scale / mesh.h**2),
        noise_std=known if known and chosen_by == "noise level" else noise * scale,
        smoothing=float(lam * mesh.h**5),
        degrees_of_freedom=level.degrees_of_freedom(lam),
        chosen_by=chosen_by,
    )


def cubic_spline(time: ArrayLike, values: ArrayLike) -> tuple[Series, Series, Series]:
    """Interpolate and differentiate as the paper does: SciPy's `CubicSpline`, not-a-knot.

    Parameters
    ----------
    time
        Strictly increasing mesh, shape ``(time,)``, in s.
    values
        Samples, shape ``(time,)``.

    Returns
    -------
    tuple[Array, Array, Array]
        The values themselves, first and second derivative, in unit, unit/s and unit/s².

    Raises
    ------
    DfsmError
        As `smoothing_spline`.
    """
    t, y = checked(time, values)
    spline = scipy.interpolate.CubicSpline(t, y)
    return y, spline(t, 1), spline(t, 2)


def interpolate(time: Series, values: Series) -> tuple[Series, Series, Series]:
    """Values, first and second derivative of the not-a-knot quintic spline through the samples.

    Parameters
    ----------
    time, values
        Shape ``(time,)``, at least 6 samples; see `smoothing_spline`.

    Returns
    -------
    tuple[Array, Array, Array]
        The values themselves, and their derivatives in unit/s and unit/s².
    """
    h = (time[-1] - time[0]) / (len(time) - 1)
    x = (time - time[0]) / h
    spline = scipy.interpolate.make_interp_spline(x, values, k=_DEGREE)
    return values, spline(x, 1) / h, spline(x, 2) / h**2


def checked(time: ArrayLike, values: ArrayLike) -> tuple[Series, Series]:
    """Return time and values as arrays that a spline can take.

    Raises
    ------
    DfsmError
        As `smoothing_spline`.
    """
    t, y = np.asarray(time, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if t.ndim != 1 or t.shape != y.shape:
        raise DfsmError(
            f"time {t.shape} and values {y.shape} do not fit: give two arrays of one dimension "
            "and the same length"
        )
    if len(t) < MIN_SAMPLES:
        raise DfsmError(
            f"{len(t)} samples are too few to differentiate, at least {MIN_SAMPLES} are needed: "
            "widen the time window or leave the run out"
        )
    if not np.isfinite(y).all():
        raise DfsmError(
            f"{np.count_nonzero(~np.isfinite(y))} of {len(y)} values are NaN or infinite: "
            "leave that part out"
        )
    if not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise DfsmError("time does not strictly increase: sort it and drop repeated samples")
    return t, y


# -- choice of λ --------------------------------------------------------------------------------

_Chosen = tuple["_Level", float, float, Literal["noise level", "cross-validation"]]


def _choose(mesh: _Mesh, z: Array, variance: float | None) -> _Chosen | None:
    """Walk from heavy to light smoothing; None where interpolation is best."""
    n = len(z)
    # The natural end conditions bend the ends however little is smoothed; in the sums, that bias
    # would pass for noise and keep noise-free data from being interpolated.
    margin = min(n // 4, 10)
    inner = slice(margin, n - margin)
    # A sample variance scatters. Without this allowance (two standard deviations) the walk can
    # miss a long plateau at the noise level and go on to fit the noise.
    allowance = 1.0 + 2.0 * np.sqrt(0.8 / n)
    path: list[tuple[_Level, float]] = []
    misfit: list[float] = []  # log of the residual variance
    free: list[float] = []  # log of N - tr H
    ends: list[float] = []  # largest residual in the margins
    for level, lam in mesh.path():
        everywhere = level.fit(z, lam, keep=True)[1]
        residual = everywhere[inner]
        dof = n - level.degrees_of_freedom(lam)
        if dof < 1e-5 * n:  # as good as interpolation, and lost in rounding
            break
        rss = float(residual @ residual) * n / len(residual)
        path.append((level, lam))
        misfit.append(float(np.log(max(rss, 1e-300) / dof)))
        free.append(float(np.log(dof)))
        ends.append(float(max(abs(everywhere[:margin]).max(), abs(everywhere[-margin:]).max())))
        # With fewer free residuals than half, their size says little about the noise.
        if variance is not None and dof > n / 2 and misfit[-1] <= np.log(variance * allowance):
            if len(path) > 1:
                part = (misfit[-1] - np.log(variance * allowance)) / (misfit[-1] - misfit[-2])
                lam *= (path[-2][1] / lam) ** part
            return level, lam, float(np.sqrt(variance)), "noise level"
    if n < _CROSS_VALIDATED:
        return None
    return _cross_validate(path, np.array(misfit), np.array(free), np.array(ends))


def _cross_validate(
    path: list[tuple[_Level, float]], misfit: Array, free: Array, ends: Array
) -> _Chosen | None:
    """Minimise the score along the path, then lighten until the ends fit as the rest does."""
    score = misfit - free
    best = int(score.argmin())
    noise = float(np.exp(misfit[best] / 2))
    # Noise does not leave four standard deviations; a bend at the ends of clean data does.
    fitting = np.flatnonzero(ends[best:] <= 4 * noise)
    if len(fitting) == 0 or best + fitting[0] == len(path) - 1:
        return None
    level, lam = path[best + fitting[0]]
    if fitting[0] == 0 and best > 0:
        left, middle, right = score[best - 1 : best + 2]
        shift = 0.5 * (left - right) / max(left - 2 * middle + right, 1e-300)
        lam *= (path[best + 1][1] / lam) ** min(max(shift, -1.0), 1.0)
    return level, lam, noise, "cross-validation"


# -- knots and banded equations -----------------------------------------------------------------


class _Level:
    """Least squares on one set of knots; it depends on the mesh alone, not on the data."""

    def __init__(self, x: Array, sites: Array) -> None:
        # Two sites next to each end carry no knot (not-a-knot): as many unknowns as sites.
        first, last = np.full(_WIDTH, sites[0]), np.full(_WIDTH, sites[-1])
        self.knots = np.concatenate([first, sites[3:-3], last])
        self.size = len(sites)
        self.basis = scipy.interpolate.BSpline.design_matrix(x, self.knots, _DEGREE)
        self.transposed = self.basis.T.tocsr()
        rows = np.asarray(self.basis.data, dtype=np.float64).reshape(-1, _WIDTH)
        start = np.asarray(self.basis.indices, dtype=np.int64).reshape(-1, _WIDTH)[:, 0]
        self.gram = _banded_gram(rows, start, self.size)
        self.penalty = _banded_gram(*_third_derivatives(self.knots), self.size)
        self._degrees_of_freedom: dict[float, float] = {}
        self._factors: dict[float, Array] = {}

    def _factor(self, lam: float) -> Array:
        matrix = self.gram + lam * self.penalty
        return scipy.linalg.cholesky_banded(matrix, overwrite_ab=True, check_finite=False)

    def fit(self, z: Array, lam: float, *, keep: bool = False) -> tuple[Array, Array]:
        """Coefficients and residual for one λ; `keep` the factors for other data on this mesh."""
        factor = self._factors.get(lam)
        if factor is None:
            factor = self._factor(lam)
            if keep and self.size <= _KEPT:
                self._factors[lam] = factor
        c = scipy.linalg.cho_solve_banded((factor, False), self.transposed @ z, check_finite=False)
        return c, z - self.basis @ c

    def degrees_of_freedom(self, lam: float) -> float:
        """Trace of the matrix that maps samples to fitted values, exact to about 1e-4 of itself."""
        if lam not in self._degrees_of_freedom:
            d = 0.02  # of log λ, in which the trace is very smooth
            up, down = (np.log(self._factor(lam * np.exp(s))[-1]).sum() for s in (d, -d))
            # log det is twice the sum over the factor's diagonal, over a distance of 2 d.
            self._degrees_of_freedom[lam] = float(self.size - (up - down) / d)
        return self._degrees_of_freedom[lam]


class _Mesh:
    """A time mesh in units of its mean spacing, with knots at all samples and ever fewer."""

    def __init__(self, time: Array) -> None:
        self.h = float(time[-1] - time[0]) / (len(time) - 1)
        self.x = (time - time[0]) / self.h
        self.finest = float(np.diff(self.x).min())
        sites = self.x
        self._sites: list[Array] = []
        while len(sites) >= MIN_SAMPLES:
            self._sites.append(sites)
            sites = _spaced(self.x, self.finest * _THINNING ** len(self._sites))
        self._levels: dict[int, _Level] = {}

    def level(self, k: int) -> _Level:
        """Made when it is needed: a known noise level ends the walk above the finest."""
        if k not in self._levels:
            self._levels[k] = _Level(self.x, self._sites[k])
        return self._levels[k]

    def path(self) -> Iterator[tuple[_Level, float]]:
        """Levels and λ from a parabola to interpolation, equally spaced in log λ."""
        for k in reversed(range(len(self._sites))):
            spacing = self.finest * _THINNING**k
            # The coarsest level has nothing above it and goes on to where a parabola is left.
            heavy = _HEAVY * (2.0 if k == len(self._sites) - 1 else 1.0)
            light = _KEEP if k > 0 else _LIGHT
            count = round(_STEPS * np.log(heavy / light) / np.log(_THINNING))
            for j in range(count):
                yield self.level(k), (spacing * heavy * _THINNING ** (-j / _STEPS)) ** 6


@lru_cache(maxsize=1)
def _mesh(time: bytes) -> _Mesh:
    """Share the equations between the channels of a run, and between runs on the same mesh."""
    return _Mesh(np.frombuffer(time))


def _spaced(x: Array, spacing: float) -> Array:
    """Pick samples at least `spacing` apart, the first and last among them."""
    keep = [0]
    reach = spacing * (1 - 1e-6)
    while (i := int(np.searchsorted(x, x[keep[-1]] + reach))) < len(x):
        keep.append(i)
    if keep[-1] != len(x) - 1:
        if len(keep) > 1 and x[-1] - x[keep[-1]] < reach / 2:
            keep.pop()
        keep.append(len(x) - 1)
    return x[keep]


def _banded_gram(rows: Array, start: IntArray, size: int) -> Array:
    """Upper banded ``RᵀR`` of a matrix whose row i holds ``rows[i]`` from column ``start[i]``."""
    gram = np.zeros((_WIDTH, size))
    for a in range(_WIDTH):
        for b in range(a, _WIDTH):
            products = rows[:, a] * rows[:, b]
            gram[_DEGREE - (b - a)] += np.bincount(start + b, products, minlength=size)
    return gram


def _third_derivatives(knots: Array) -> tuple[Array, IntArray]:
    """Rows R with ``∫ f'''**2 = |R c|²``: Gauss points, exact for the squared parabolas."""
    d = np.ones((len(knots) - _WIDTH, 1))  # coefficients of the derivative from those of f
    inner, degree = knots, _DEGREE
    for _ in range(3):
        n = len(d)
        slope = degree / (inner[degree + 1 : degree + n] - inner[1:n])
        ahead, here = np.pad(d[1:], ((0, 0), (1, 0))), np.pad(d[:-1], ((0, 0), (0, 1)))
        d = slope[:, None] * (ahead - here)
        inner, degree = inner[1:-1], degree - 1
    breaks = knots[_DEGREE:-_DEGREE]
    length = np.diff(breaks)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    points = breaks[:-1, None] + length[:, None] * (nodes + 1) / 2
    design = scipy.interpolate.BSpline.design_matrix(points.ravel(), inner, degree)
    parabolas = design.data.reshape(-1, 3, 3)
    parabolas = parabolas * np.sqrt(length[:, None] * weights / 2)[:, :, None]
    n = len(length)
    rows = np.zeros((n, 3, _WIDTH))
    for r in range(3):
        rows[:, :, r : r + 4] += parabolas[:, :, r, None] * d[r : r + n, None, :]
    return rows.reshape(-1, _WIDTH), np.repeat(np.arange(n), 3)

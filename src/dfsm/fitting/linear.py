"""Linear fit of derivatives and outputs: LTI, and LPV in a scheduling signal (Sec. 3.4).

    f̂_L(I; w) = L(w) (I - Ī) + c = L(w) I + b(w),      I = [u, w, ξ, p]

One pass over the data accumulates the normal equations of every scheduling window, so memory does
not grow with the number of samples. Windows overlap; between their centres the coefficients are
interpolated linearly, so the model is continuous in the schedule and every L(w) is a convex
combination of two fitted ones.

A window's fit leans on that of all windows by what one independent sample weighs. How many samples
make one is learnt in the same pass, from the residuals of each block's own fit: how long they
remember is a property of the time series, not of its sampling rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

import dfsm.core.jax_setup  # noqa: F401
from dfsm.core.host import from_host
from dfsm.core.settings import settings_class
from dfsm.core.types import Array, IntArray
from dfsm.errors import DfsmError, near_matches
from dfsm.models.linear import LinearModel
from dfsm.numerics.least_squares import (
    BLOCK,
    NormalEquations,
    Solution,
    correlation_length,
    merge,
    shared_coefficients,
)
from dfsm.numerics.time_mesh import quantiles_over

# Inputs, targets and weights of some samples.
Block = tuple[Array, Array, Array | None]

# Two input directions whose standardised spread differs by more than this cannot be told apart
# by least squares in 64-bit normal equations with a few digits to spare.
CONDITION_LIMIT = 1e4


@settings_class
class LTI:
    """One linear fit for all samples.

    Attributes
    ----------
    affine
        Fit an offset (centred regression). False is the paper's ``L = Ẋ Iᵀ (I Iᵀ)⁻¹``.
    margin
        If set, eigenvalues of A with a real part above ``-margin`` (1/s) are moved there, see
        `stabilise`: stability with the schedule frozen. Never for a system that is truly unstable.
    known
        Coefficients that physics gives, by state and by input, in the units of the channels:
        ``{"GenSpeed": {"GenTq": -2.997e-5}}`` says that 1 kN m slows the rotor by 2.997e-5 rpm/s.
        They enter the highest derivative of the state and are never changed, not for a margin
        either; what corrects the derivatives does not see these inputs.
    only
        By state, the inputs that least squares gives its highest derivative, where physics says
        so; refinement on rollouts may use the others, too. All others are constant along a
        schedule, for all states.
    """

    kind: Literal["LTI"] = "LTI"
    affine: bool = True
    known: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    only: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    margin: float | None = None


@settings_class
class LPV:
    """Linear fits in overlapping windows of a scheduling signal, interpolated between them.

    Attributes
    ----------
    schedule
        The disturbance (or other input) that the coefficients depend on, e.g. the wind speed.
    points
        Number of windows, at least 2.
    constant
        Inputs whose coefficients are the same at all points, where physics says so: a torque
        changes a speed by one over the inertia, whatever the wind.
    known, only
        As for `LTI`; inputs with such a coefficient are constant for all states.
    affine
        Fit an offset in every window.
    margin
        As for `LTI`, at every schedule point; there, constant coefficients of states may move, too.
    """

    kind: Literal["LPV"] = "LPV"
    schedule: str
    points: int = 5
    constant: tuple[str, ...] = ()
    known: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    only: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    affine: bool = True
    margin: float | None = None


@dataclass(frozen=True)
class LinearFit:
    """A linear model and how well it fits its training samples.

    Attributes
    ----------
    model
        The fitted map.
    residual_rms, target_std
        Per target, over all samples, in the target's unit. The residual of an LPV model is
        that of each window's own fit.
    samples
        Samples per window, shape ``(point,)``.
    windows
        Schedule range of every window, shape ``(point, 2)``; empty for an LTI model.
    condition
        Condition number of the standardised inputs over all windows.
    equations
        The sums behind every schedule point.
    constant
        Input columns whose coefficients are the same at all schedule points by choice.
    warnings
        Sentences that name inputs which do not vary or which the data cannot tell apart.
    notes
        What was done to the fit afterwards, and what it cost.
    moved
        Schedule points at which eigenvalues were moved: no fit of least squares any more.
    """

    model: LinearModel
    residual_rms: Array
    target_std: Array
    samples: IntArray
    windows: Array
    condition: float
    equations: tuple[NormalEquations, ...]
    warnings: tuple[str, ...]
    constant: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    moved: tuple[float, ...] = ()

    @property
    def mean_coefficients(self) -> Array:
        """Coefficients over all samples, ``(target, input)``."""
        share = self.samples / self.samples.sum()
        return np.einsum("p,prc->rc", share, np.asarray(self.model.coefficients))


def schedule_windows(schedule: Array, points: int, weights: Array | None = None) -> Array:
    """Overlapping windows of equal width over the range of a schedule, ends included.

    The first window starts at the 0.5th percentile and the last ends at the 99.5th, so that
    those at the ends are as wide as the others and as well filled as the data allow.

    Parameters
    ----------
    schedule
        Schedule samples of all runs, shape ``(sample,)``.
    points
        Number of windows.
    weights
        Of the samples by the time that they stand for, ``(sample,)``; None takes all alike.

    Returns
    -------
    ndarray
        Lower and upper end of every window, shape ``(point, 2)``; neighbours overlap by half.

    Raises
    ------
    DfsmError
        Fewer than two points, or a schedule that does not vary.
    """
    if points < 2:
        raise DfsmError(f"linear.points is {points}, an LPV fit needs at least 2: raise it, or LTI")
    low, high = quantiles_over(schedule, [0.005, 0.995], weights)
    if not high > low:
        raise DfsmError(
            f"the schedule does not vary (always {low:g}): use an LTI fit or another schedule"
        )
    half = (high - low) / (points + 1)
    centres = low + half * np.arange(1, points + 1)
    return np.stack([centres - half, centres + half], axis=1)


def fit_linear(
    blocks: Iterable[tuple[Array, Array] | Block],
    input_names: Sequence[str],
    settings: LTI | LPV,
    windows: Array | None = None,
    known: Mapping[tuple[int, int], float] | None = None,
) -> LinearFit:
    """Fit targets on inputs in one pass over blocks of samples (Sec. 3.4, Eq. 7).

    Parameters
    ----------
    blocks
        Inputs ``(sample, input)`` and targets ``(sample, target)`` of a run or part of one, in the
        order of time, and weights ``(sample,)`` where samples do not count alike. They are read
        once and not kept.
    input_names
        Names of the input columns, for the schedule and for messages.
    settings
        `LTI` or `LPV`.
    windows
        Schedule windows from `schedule_windows`; needed for an LPV fit.
    known
        Coefficients that are not fitted, by target and input.

    Returns
    -------
    LinearFit
        The model in physical units and its figures of merit.

    Raises
    ------
    DfsmError
        Fewer samples than unknowns, in all or in one window.
    """
    lpv = isinstance(settings, LPV)
    column = list(input_names).index(settings.schedule) if isinstance(settings, LPV) else None
    windows = np.empty((0, 2)) if windows is None or not lpv else windows
    sums: list[NormalEquations] = []
    m, schedule_sums = len(input_names), np.zeros(len(windows))
    for inputs, targets, *rest in blocks:
        weights = rest[0] if rest else None
        if not sums:
            width = m + targets.shape[1]
            first = np.concatenate([inputs[:BLOCK].mean(0), targets[:BLOCK].mean(0)])
            shift = first if settings.affine else np.zeros(width)
            sums = [NormalEquations(shift, m) for _ in range(max(1, len(windows)))]
        if not lpv:
            sums[0].add(inputs, targets, weights=weights)
            continue
        s = inputs[:, column]
        correlation = _correlation(inputs, targets, weights, sums[0].shift, settings)
        for k, (low, high) in enumerate(windows):
            inside = (s >= low) & (s <= high)
            # The end windows also take what lies beyond them: no sample is left out.
            inside |= (s < low) & (k == 0) | (s > high) & (k == len(windows) - 1)
            w = None if weights is None else weights[inside]
            sums[k].add(inputs[inside], targets[inside], correlation, w)
            schedule_sums[k] += s[inside].sum() if w is None else w @ s[inside]
    _check_counts(sums, windows, settings)
    whole = merge(sums).solve(settings.affine)
    known = known or {}
    constant = _constant(settings, input_names, known)
    if constant:
        by_place = {(t, constant.index(i)): value for (t, i), value in known.items()}
        shared = shared_coefficients(sums, constant, settings.affine, by_place)
        whole = merge(sums).holding(whole, constant, shared, settings.affine)
    solutions = [e.solve(settings.affine, whole, constant) for e in sums] if lpv else [whole]
    counts, mass = np.array([e.count for e in sums]), np.array([e.weight for e in sums])
    grid = schedule_sums / mass if lpv else np.zeros(1)
    model = LinearModel(
        grid=from_host(grid),
        coefficients=from_host(np.stack([s.coefficients for s in solutions])),
        offsets=from_host(np.stack([s.offset for s in solutions])),
        schedule=column,
        known=tuple(known),
    )
    shares = mass / mass.sum()
    return LinearFit(
        model=model,
        residual_rms=np.sqrt(
            sum(w * s.residual_variance for w, s in zip(shares, solutions, strict=True))
        ),
        target_std=merge(sums).std[m:],
        samples=counts,
        windows=windows,
        condition=whole.condition,
        equations=tuple(sums),
        warnings=_warnings(whole, input_names),
        constant=constant,
    )


def _correlation(
    inputs: Array, targets: Array, weights: Array | None, shift: Array, settings: LTI | LPV
) -> float:
    """How many samples of a block count as one: all, where it is too short to tell.

    The target whose residual remembers longest decides for all. In a second derivative, vibration
    and rounding cover what a missing force does slowly, and would pass for independent samples.
    """
    if len(inputs) <= 2 * inputs.shape[1]:
        return float(len(inputs))
    own = NormalEquations(shift, inputs.shape[1])
    own.add(inputs, targets, weights=weights)
    fit = own.solve(settings.affine)
    residuals = targets - inputs @ fit.coefficients.T - fit.offset
    if weights is not None:
        # As many samples again, at equal distances in time.
        ends = np.cumsum(weights)
        even = np.linspace(ends[0], ends[-1], len(ends))
        residuals = np.stack([np.interp(even, ends, r) for r in residuals.T], axis=1)
    return float(correlation_length(residuals).max())


def _constant(
    settings: LTI | LPV, names: Sequence[str], known: Iterable[tuple[int, int]]
) -> tuple[int, ...]:
    chosen = settings.constant if isinstance(settings, LPV) else ()
    unknown = [n for n in chosen if n not in names]
    if unknown:
        raise DfsmError(
            f"linear.constant names '{unknown[0]}', which is not an input of the model; "
            + near_matches(unknown[0], names)
        )
    columns = [list(names).index(n) for n in chosen]
    return tuple(dict.fromkeys([*columns, *(column for _, column in known)]))


def _check_counts(sums: Sequence[NormalEquations], windows: Array, settings: LTI | LPV) -> None:
    if not sums or not sum(e.count for e in sums):
        raise DfsmError("no samples to fit: give at least one run")
    unknowns = sums[0].n_inputs + int(settings.affine)
    for k, e in enumerate(sums):
        if e.count < unknowns:
            where = (
                f" in the window {windows[k, 0]:.4g} to {windows[k, 1]:.4g}" if len(windows) else ""
            )
            cure = "use fewer linear.points or more runs" if len(windows) else "give more samples"
            raise DfsmError(
                f"{e.count} samples{where} for {unknowns} unknowns per target of the linear fit: "
                f"{cure}"
            )


def _warnings(solution: Solution, names: Sequence[str]) -> tuple[str, ...]:
    constant = tuple(
        f"input '{name}' has the same value in all samples, so nothing can be learned about its "
        "effect: leave it out, or add runs with other values"
        for name, variance in zip(names, solution.input_variance, strict=True)
        if variance == 0
    )
    if solution.condition <= CONDITION_LIMIT:
        return constant
    which = ", ".join(solution.confounded(list(names)))
    figure = f"{solution.condition:.1e}" if np.isfinite(solution.condition) else "infinite"
    return (
        *constant,
        f"the runs cannot tell these inputs apart: {which} (condition number {figure}); "
        "predictions hold where the inputs stay related as in the training runs, "
        "the separate coefficients mean little",
    )

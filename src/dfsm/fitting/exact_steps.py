"""Rows of the derivative fit over intervals between samples, where inputs are held.

Where inputs jump at samples, states have a kink there, and no spline tells the derivative. What
happens over an interval is known exactly, though:

    (ξ(t₁) - ξ(t₀)) / h = mean of f̂(ξ, u, w, p) over t₀ … t₁ ,

with the held input's own value as its mean. The rate of a state of order 2 that no channel holds
has no values at samples; there a hat over two intervals takes the place of the plain mean, and the
second difference of the state is the mean of its second derivative, exactly (the weak form of the
equation). Means of states follow from their values at the samples and, to fourth order, from their
slopes at the ends of each interval (Hermite's formulas). These slopes are those of the model that
has just been fitted: a few fits after one another settle them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array
from dfsm.data.derivatives import Differentiated, StateSpec
from dfsm.numerics.time_mesh import same_instant

if TYPE_CHECKING:
    from dfsm.fitting.samples import Samples

# Fits after one another at most, and the change of all slopes, relative to their spread, that ends.
_FITS, _SETTLED = 12, 1e-9
# Weights that differ by less than this share are one.
_EQUAL = 1e-3

# f̂ of the linear fit, at inputs ``(row, input)``.
Slopes = Callable[[Array], Array]
# Values over some intervals at their start and end, and slopes there, each ``(interval, channel)``.
_Ends = tuple[Array, Array, Array, Array]


@dataclass(frozen=True)
class Steps:
    """The intervals of one run.

    Attributes
    ----------
    time
        Samples in s, ``(time,)``.
    states
        ξ at samples, ``(time, state)``.
    own
        Which samples tell their derivative themselves, ``(time,)``; intervals between others count.
    begin, end, begin_slope, end_slope
        Controls, disturbances and parameters at the ends of each interval, seen from within, and
        their slopes there, ``(time - 1, exogenous)``.
    specs
        Which states have an order of 2, and which a recorded rate.
    """

    time: Array
    states: Array
    own: NDArray[np.bool_]
    begin: Array
    end: Array
    begin_slope: Array
    end_slope: Array
    specs: tuple[StateSpec, ...]

    @classmethod
    def of(
        cls,
        found: Differentiated,
        rows: NDArray[np.bool_],
        polynomials: Array,
        specs: Sequence[StateSpec],
    ) -> Steps:
        """Take them from a run and what its inputs are between samples.

        Parameters
        ----------
        found
            The whole run.
        rows
            Samples in the time window, one after the other, ``(time,)``.
        polynomials
            Of controls, disturbances and parameters in the whole run, see `polynomials`.
        specs
            The states.
        """
        run = found.trajectory
        time = run.time[rows]
        h = np.diff(time)[:, None]
        d, c, b, a = polynomials[:, rows[:-1] & rows[1:]]
        end, end_slope = a + h * (b + h * (c + h * d)), b + h * (2 * c + 3 * h * d)
        states = run.select(found.names).values[rows]
        return cls(time, states, found.direct[rows], a, end, b, end_slope, tuple(specs))

    @property
    def steps(self) -> Array:
        """Lengths of the intervals in s, ``(interval, 1)``."""
        return np.diff(self.time)[:, None]

    @property
    def open(self) -> NDArray[np.bool_]:
        """Intervals whose ends do not tell their derivative; none of no length."""
        return ~self.own[:-1] & ~same_instant(self.time)

    @property
    def unseen(self) -> list[tuple[int, int]]:
        """Columns of states of order 2 whose rate no channel holds, and of these rates."""
        second = [i for i, s in enumerate(self.specs) if s.order == 2]
        rates = {i: len(self.specs) + k for k, i in enumerate(second)}
        return [(i, k) for i, k in rates.items() if self.specs[i].rate is None]

    @property
    def ends(self) -> tuple[Array, Array]:
        """States at the start and the end of every interval, ``(interval, state)``."""
        return self.states[:-1], self.states[1:]

    def straight(self) -> tuple[Array, Array]:
        """Slopes at the ends of the intervals before there is a model: of lines between samples."""
        first, last = self.ends
        lines = (last - first) / self.steps
        begin, end = lines.copy(), lines.copy()
        for q, rate in self.unseen:
            begin[:, q], end[:, q] = first[:, rate], last[:, rate]
        return begin, end

    def modelled(self, slopes: Slopes, driving: int) -> tuple[Steps, tuple[Array, Array]]:
        """Slopes by a model, and with them better rates of the states that have none recorded.

        Parameters
        ----------
        slopes
            The model.
        driving
            Exogenous columns that stand before the states in I; the others follow.
        """
        n, count = driving, len(self.begin)
        sides = zip((self.begin, self.end), self.ends, strict=True)
        inputs = np.concatenate([np.hstack([v[:, :n], x, v[:, n:]]) for v, x in sides])
        both = np.array(slopes(inputs))
        begin, end = both[:count], both[count:]
        states, h = self.states.copy(), self.steps[:, 0]
        inner = self.open
        for q, rate in self.unseen:
            mean = np.diff(states[:, q]) / h
            # With a second derivative that is linear in between.
            at_begin = mean - h / 6 * (2 * begin[:, rate] + end[:, rate])
            at_end = mean + h / 6 * (begin[:, rate] + 2 * end[:, rate])
            total, sides = np.zeros(len(states)), np.zeros(len(states))
            for at, part in ((at_begin, slice(None, -1)), (at_end, slice(1, None))):
                total[part] += np.where(inner, at, 0.0)
                sides[part] += inner
            better = (sides > 0) & ~self.own
            states[better, rate] = total[better] / sides[better]
        moved = replace(self, states=states)
        for q, rate in self.unseen:
            begin[:, q], end[:, q] = states[:-1, rate], states[1:, rate]
        return moved, (begin, end)

    def rows(self, slopes: tuple[Array, Array], driving: int) -> tuple[Array, ...]:
        """Mean inputs, mean derivatives, the time that each row stands for, and when.

        Parameters
        ----------
        slopes
            Of the states at the ends of the intervals, each ``(interval, state)``.
        driving
            As for `modelled`.
        """
        states = (*self.ends, *slopes)
        exogenous = (self.begin, self.end, self.begin_slope, self.end_slope)
        means, h = _mean(states, self.steps), self.steps
        change = (states[1] - states[0]) / h
        if not self.unseen:
            keep, middle = self.open, self.time[:-1] + h[:, 0] / 2
            x, rates, v, span = means, change, _mean(exogenous, h), h
        else:
            # Two intervals that follow one another, but for instants between.
            order = np.flatnonzero(~same_instant(self.time))
            left, right = order[:-1], order[1:]
            keep, middle = self.open[left] & self.open[right], self.time[right]
            span = (h[left] + h[right]) / 2
            x, v = (_under_hats(ends, h, left, right) / span for ends in (states, exogenous))
            rates = (means[right] - means[left]) / span
            for q, rate in self.unseen:
                x[:, rate] = rates[:, q]
                rates[:, rate] = ((change[right] - change[left]) / span)[:, q]
        n = driving
        inputs = np.hstack([v[:, :n], x, v[:, n:]])
        return inputs[keep], rates[keep], span[keep, 0], middle[keep]


def _mean(ends: _Ends, h: Array) -> Array:
    """Means over intervals, ``(interval, channel)``."""
    first, last, begin, end = ends
    return (first + last) / 2 + h / 12 * (begin - end)


def _under_hats(ends: _Ends, h: Array, left: NDArray[np.int64], right: NDArray[np.int64]) -> Array:
    """Integrals times a hat that rises over some intervals and falls over others."""
    first, last, begin, end = ends
    rising = 3 / 20 * first + 7 / 20 * last + h * (begin / 30 - end / 20)
    falling = 7 / 20 * first + 3 / 20 * last + h * (begin / 20 - end / 30)
    return (h * rising)[left] + (h * falling)[right]


def over_intervals(samples: Samples, fit: Callable[[Samples], Slopes]) -> tuple[Samples, Samples]:
    """Rows that a fit of the derivatives takes, and the samples with what was learnt meanwhile.

    Parameters
    ----------
    samples
        At points in time.
    fit
        Fits rows and returns the linear model of all derivatives.

    Returns
    -------
    tuple of Samples
        Rows over intervals, or at samples where these tell their derivative; and `samples` with
        the rates of the states that have none recorded. Both are `samples` where inputs have no
        jumps, or only few.
    """
    steps = list(samples.steps)
    if not any(s.open.any() for s in steps):
        return samples, samples
    n = len(samples.signals.driving)
    slopes = [s.straight() for s in steps]
    rows = _rows(samples, steps, slopes, n)
    last = np.inf
    for _ in range(_FITS):
        model = fit(rows)
        pairs = [s.modelled(model, n) for s in steps]
        change = max(
            float(np.abs(new - old).max()) / (float(np.ptp(new)) or 1.0)
            for (_, news), olds in zip(pairs, slopes, strict=True)
            for new, old in zip(news, olds, strict=True)
        )
        # Intervals so long that the formulas say nothing more: what there is is best.
        if not change < last:
            break
        steps, slopes = [s for s, _ in pairs], [s for _, s in pairs]
        rows, last = _rows(samples, steps, slopes, n), change
        if change < _SETTLED:
            break
    inputs = samples.inputs.copy()
    inputs[:, samples.signals.state_columns] = np.concatenate([s.states for s in steps])
    return rows, replace(samples, inputs=inputs)


def _rows(
    samples: Samples, steps: Sequence[Steps], slopes: Sequence[tuple[Array, Array]], n: int
) -> Samples:
    """Samples that tell their derivative, and intervals between others, run by run."""
    parts: list[tuple[Array, ...]] = []
    for k, (s, ends) in enumerate(zip(steps, slopes, strict=True)):
        mine = np.flatnonzero(samples.runs == k)[s.own]
        half = np.diff(s.time) / 2
        stands = (np.append(half, 0.0) + np.insert(half, 0, 0.0))[s.own]
        inputs, rates, spans, times = s.rows(ends, n)
        run = (
            np.concatenate([samples.inputs[mine], inputs]),
            np.concatenate([samples.derivatives[mine], rates]),
            np.concatenate([stands, spans]),
            np.concatenate([s.time[s.own], times]),
        )
        order = np.argsort(run[-1], kind="stable")
        parts.append((*(part[order] for part in run), np.full(len(order), k)))
    inputs, derivatives, weights, times, runs = (
        np.concatenate(p) for p in zip(*parts, strict=True)
    )
    alike = np.ptp(weights) <= _EQUAL * weights.mean()
    none = {name: np.empty((0, 0)) for name in ("outputs", "harmonics", "field")}
    return replace(
        samples,
        inputs=inputs,
        derivatives=derivatives,
        time=times,
        psi=np.empty(0),
        runs=runs,
        weights=None if alike else weights / weights.mean(),
        steps=(),
        **none,
    )

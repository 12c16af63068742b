"""What happens over intervals between samples, where inputs jump at these.

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

import numpy as np
from numpy.typing import NDArray

from dfsm.core.types import Array
from dfsm.data.derivatives import Differentiated, StateSpec
from dfsm.numerics.time_mesh import same_instant

# Times that a model is asked for slopes, each time with the better rates of the last.
_TURNS = 5

# f̂ of a model, at inputs ``(row, input)``.
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
    driving
        Exogenous columns that stand before the states in I, controls and disturbances; parameters
        follow.
    """

    time: Array
    states: Array
    own: NDArray[np.bool_]
    begin: Array
    end: Array
    begin_slope: Array
    end_slope: Array
    specs: tuple[StateSpec, ...]
    driving: int

    @classmethod
    def of(
        cls,
        found: Differentiated,
        rows: NDArray[np.bool_],
        polynomials: Array,
        specs: Sequence[StateSpec],
        driving: int,
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
        specs, driving
            See `Steps`.
        """
        run = found.trajectory
        time = run.time[rows]
        h = np.diff(time)[:, None]
        d, c, b, a = polynomials[:, rows[:-1] & rows[1:]]
        end, end_slope = a + h * (b + h * (c + h * d)), b + h * (2 * c + 3 * h * d)
        states = run.select(found.names).values[rows]
        return cls(time, states, found.direct[rows], a, end, b, end_slope, tuple(specs), driving)

    def window(self, inside: NDArray[np.bool_]) -> Steps:
        """Some samples, one after the other, and the intervals between them."""
        pairs = inside[:-1] & inside[1:]
        return replace(
            self,
            time=self.time[inside],
            states=self.states[inside],
            own=self.own[inside],
            begin=self.begin[pairs],
            end=self.end[pairs],
            begin_slope=self.begin_slope[pairs],
            end_slope=self.end_slope[pairs],
        )

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

    def modelled(self, slopes: Slopes) -> tuple[Steps, tuple[Array, Array]]:
        """Slopes by a model, and with them better rates of the states that have none recorded.

        Parameters
        ----------
        slopes
            The model.
        """
        n, count = self.driving, len(self.begin)
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

    def settled(self, slopes: Slopes) -> tuple[Steps, tuple[Array, Array]]:
        """Rates and slopes by a model that is what it is, see `modelled`."""
        steps, ends = self.modelled(slopes)
        for _ in range(_TURNS if self.unseen else 0):
            steps, ends = steps.modelled(slopes)
        return steps, ends

    def between(self, slopes: tuple[Array, Array], time: Array) -> Array:
        """States at other times in s, ``(time, state)``: Hermite's cubics.

        Parameters
        ----------
        slopes
            At the ends of the intervals, by a model. Where its mean is not the change that was
            recorded, the difference is added to both.
        time
            Within the run.
        """
        (first, last), h = self.ends, self.steps
        missed = (last - first) / h - (slopes[0] + slopes[1]) / 2
        k = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(h) - 1)
        s = ((time - self.time[k]) / h[k, 0])[:, None]
        begin, end = ((part + missed)[k] * h[k] for part in slopes)
        change = (last - first)[k]
        return first[k] + s * (
            begin + s * (3 * change - 2 * begin - end + s * (begin + end - 2 * change))
        )

    def rows(self, slopes: tuple[Array, Array]) -> tuple[Array, ...]:
        """Mean inputs, mean derivatives, the time that each row stands for, and when.

        Parameters
        ----------
        slopes
            Of the states at the ends of the intervals, each ``(interval, state)``.
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
        n = self.driving
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

"""What a controller is judged by: named measures of a channel, with their slopes along a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from dfsm.core.settings import require, require_kind, require_number, settings_class
from dfsm.core.types import Array
from dfsm.errors import DfsmError, near_matches
from dfsm.numerics.fatigue_slope import damage_with_slope
from dfsm.numerics.time_mesh import mean_over, std_over, weights_over_time

Kind = Literal["mean", "std", "maximum", "minimum", "overshoot", "travel", "rate", "damage"]
KINDS: tuple[str, ...] = get_args(Kind)
# Of these the worst run counts; of others all with their weights.
EXTREMES = ("maximum", "minimum", "overshoot", "rate")


@settings_class
class Measure:
    """A figure of one channel.

    Attributes
    ----------
    measure
        ``mean`` (of power: energy), ``std``, ``maximum``, ``minimum``, ``overshoot`` (largest
        value over the `reference`, less 1), ``travel`` (mean of the absolute rate, per s), ``rate``
        (largest absolute rate, per s) or ``damage`` (1 Hz damage-equivalent load). Over several
        runs: the largest or smallest of extremes; means of mean and travel, the root of the mean
        square of std, and what does all damage, each run with its weight.
    channel
        State, control or output of the model.
    exponent
        Wöhler exponent of damage.
    reference
        Value that overshoot refers to, in the channel's unit.
    """

    measure: Kind
    channel: str
    exponent: float = 4.0
    reference: float | None = None

    def __post_init__(self) -> None:
        require_kind("measure", self.measure, str, f"one of {', '.join(KINDS)}")
        if self.measure not in KINDS:
            raise DfsmError(
                f"there is no measure '{self.measure}'; {near_matches(self.measure, KINDS)}"
            )
        require_kind("channel", self.channel, str, "the name of a signal of the model")
        require_number("exponent", self.exponent, "at least 1", least=1)
        needs = self.measure == "overshoot"
        require(
            (self.reference is not None) == needs,
            f"reference of {self.label}",
            self.reference,
            "a value that is not 0" if needs else "none: only overshoot has one",
        )
        name, expected = f"reference of {self.label}", "a value that is not 0"
        require_number(name, self.reference, expected, optional=True)
        require(self.reference != 0, name, 0, expected)

    @property
    def label(self) -> str:
        """As it is told: ``damage of TwrBsMyt (m = 4)``."""
        more = f" (m = {self.exponent:g})" if self.measure == "damage" else ""
        return f"{self.measure} of {self.channel}{more}"

    @property
    def extreme(self) -> bool:
        """Whether the worst run counts."""
        return self.measure in EXTREMES

    def unit(self, of_channel: str) -> str:
        """Unit of the measure of a channel in a unit."""
        if self.measure == "overshoot":
            return ""
        return f"{of_channel}/s" if self.measure in ("travel", "rate") else of_channel

    def along(self, time: Array, values: Array, held: float = 0.0) -> tuple[float, Array]:
        """Figure of one run, and its slope with every sample.

        Parameters
        ----------
        time, values
            Shapes ``(time,)``.
        held
            Seconds for which a command is held: a rate is that from one command to the next,
            however short the samples are in between.

        Returns
        -------
        tuple
            The figure, and its derivative with respect to the values, shape ``(time,)``; that of an
            extreme belongs to the sample where it is.
        """
        duration, slope = float(time[-1] - time[0]), np.zeros(len(values))
        if self.measure in ("mean", "std"):
            return self._over_time(time, values)
        if self.measure == "damage":
            return damage_with_slope(values, duration, self.exponent)
        if self.measure in ("travel", "rate"):
            return self._of_rates(time, values, held)
        at = int(np.argmin(values) if self.measure == "minimum" else np.argmax(values))
        slope[at] = 1.0
        if self.reference is not None:
            return float(values[at]) / self.reference - 1, slope / self.reference
        return float(values[at]), slope

    def _over_time(self, time: Array, values: Array) -> tuple[float, Array]:
        weights = weights_over_time([time])
        shares = np.ones(len(values)) if weights is None else weights
        shares, mean = shares / shares.sum(), float(mean_over(values, weights))
        if self.measure == "mean":
            return mean, shares
        size = float(std_over(values, weights))
        return size, shares * (values - mean) / size if size else 0 * shares

    def _of_rates(self, time: Array, values: Array, held: float) -> tuple[float, Array]:
        slope = np.zeros(len(values))
        if self.measure == "travel":
            steps, duration = np.diff(values), float(time[-1] - time[0])
            ways = np.sign(steps) / duration
            slope[1:] += ways
            slope[:-1] -= ways
            return float(np.abs(steps).sum() / duration), slope
        first = np.arange(len(time) - 1)
        after = np.searchsorted(time, time[:-1] + held * (1 - 1e-6))
        after = np.minimum(np.maximum(after, first + 1), len(time) - 1)
        rates = (values[after] - values[first]) / np.maximum(time[after] - time[first], held)
        at = int(np.argmax(np.abs(rates)))
        per_value = np.sign(rates[at]) / max(time[after[at]] - time[at], held)
        slope[after[at]], slope[at] = per_value, -per_value
        return float(abs(rates[at])), slope

    def over(self, figures: Sequence[float], weights: Sequence[float]) -> tuple[float, Array]:
        """Figure of several runs, and its slope with theirs.

        Parameters
        ----------
        figures
            Of the runs.
        weights
            Share of the time that each stands for.

        Returns
        -------
        tuple
            The figure, and its derivative with respect to the runs' figures, shape ``(run,)``.
        """
        values, w = np.asarray(figures, dtype=np.float64), np.asarray(weights) / np.sum(weights)
        if self.extreme:
            at = int(np.argmin(values) if self.measure == "minimum" else np.argmax(values))
            return float(values[at]), np.eye(len(values))[at]
        if self.measure in ("mean", "travel"):
            return float(w @ values), w
        power = 2.0 if self.measure == "std" else self.exponent
        largest = float(np.abs(values).max())
        if not largest:
            return 0.0, np.zeros(len(values))
        shares = values / largest
        total = float(w @ shares**power) ** (1 / power)
        return largest * total, w * shares ** (power - 1) * total ** (1 - power)

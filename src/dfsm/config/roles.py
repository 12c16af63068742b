"""What the channels of any system are: outputs, states and inputs, as the records tell.

Outputs come first, for what follows from others at once is no state, however well its rate
follows from them, too. A state is what its past and the others carry from one time to the next:
over windows of time its first or second difference follows from its own mean and theirs, and not
from its own alone. What is left drives the system.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement

import numpy as np

from dfsm.core.types import Array
from dfsm.core.units import agree, known
from dfsm.data.trajectory import Trajectory
from dfsm.data.windows import Windows, left_of, rest_of, without_dropouts
from dfsm.fitting.causes import gains_from_past

# Share of the variance of what happens over windows that others may leave in a state, and how much
# less it must be than what the channel leaves by itself.
_STATE, _HELPED = 0.4, 0.5
# The same where only products and powers tell, of a channel that the past of others drives.
_BENT_LEFT = 0.7
# A rate of which less is left is taken at that, and a second derivative must leave so much less.
_FIRST, _BETTER = 0.01, 0.25
# Share of the largest gain from the past of others (see `gains_from_past`), or a gain of one, below
# which nothing drives a channel, and the least that the largest must be.
_UNDRIVEN, _DRIVEN = 0.25, 0.1
# Share of its own variance that a channel may leave which follows from the others at once; where
# what is left is white, as noise of a sensor is, that is enough.
_AT_ONCE, _NOISY = 1e-3, 0.05
# The same, relative to its most likely alternative, from which one of two channels that follow from
# each other is the better state.
_CLEARLY = 4.0
# Products and powers are tried for so many channels, of this degree, with so many samples for each;
# those of a rate on so many blocks of the records, as angles go on into what no other run has seen.
_BENT, _DEGREE, _SAMPLES, _BLOCKS = 7, 3, 20, 40
# Spread below which a power rests, relative to its largest value.
_RESTS = 1e-9
# Highest power of one channel alone.
_HIGHEST = 5
# Samples per swing, or windows where noise has to be averaged out, below which a second derivative
# is not to be had: its error goes with their square and, in rollouts, with how little is damped.
_PER_SWING = 40.0
# Without what drives it, a system leaves more than so many times as much.
_NO_MORE = 1.1

# Names of what nature does, and of what a controller is told to reach.
_NATURE = re.compile(r"wave|swell|gust|wind(?!ing|ow|.?mill|.?turb)", re.IGNORECASE)
_WANTED = re.compile(
    r"set.?p(oin)?t|target|desired|reference|(?:^|[_. ])(?:sp|ref|set)(?:[_. ]|$)"
    r"|(?<=[a-z])(?:Ref|Sp|SP|Set)(?:$|[_. A-Z])",
)


@dataclass
class Roles:
    """Roles of channels, in their order, each with a reason.

    Attributes
    ----------
    orders
        Of the states.
    outputs, inputs
        Names.
    left
        RMS that is left of the rate of each channel, relative to its standard deviation, without
        the share of noise.
    coarse
        States of order 2 whose second derivative is not to be had, with their samples per swing
        once noise is averaged out.
    set_points
        Channels that act through another only, with that one.
    reasons
        Of outputs, states and set-points.
    """

    orders: dict[str, int] = field(default_factory=dict)
    outputs: list[str] = field(default_factory=list)
    inputs: list[str] = field(default_factory=list)
    left: dict[str, float] = field(default_factory=dict)
    coarse: dict[str, float] = field(default_factory=dict)
    set_points: dict[str, str] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


def is_nature(name: str) -> bool:
    """Whether a name is that of waves or wind, which no plant answers back."""
    return bool(_NATURE.search(name))


class Judge:
    """Asks the records of a system which channel is what.

    Parameters
    ----------
    runs
        Training runs.
    names
        Channels that vary, without rates of rates.
    rates
        Recorded rates among them, each with its channel.
    held
        Channels that are held between samples: inputs.
    """

    def __init__(
        self,
        runs: Sequence[Trajectory],
        names: Sequence[str],
        rates: Mapping[str, str],
        held: Sequence[str],
    ) -> None:
        self.names, self.rates = list(names), dict(rates)
        self.bases = set(self.rates.values())
        self.held = {n for n in held if n not in self.rates and n not in self.bases}
        self.windows = Windows(runs, names)
        self.runs = runs
        self.gains = gains_from_past(max(runs, key=len), names)
        self._moves: dict[tuple[str, int, tuple[str, ...]], tuple[float, float]] = {}

    # -- what follows from what -----------------------------------------------------------------

    def moves(self, name: str, order: int, among: Sequence[str]) -> tuple[float, float]:
        """Share that is left of a derivative of a channel, by all and by itself alone."""
        asked = name, order, tuple(among)
        if asked not in self._moves:
            self._moves[asked] = self.windows.left(name, order, among)
        return self._moves[asked]

    def at_once(self, name: str, among: Sequence[str]) -> float:
        """Share of its variance that a channel leaves as a function of others at that time."""
        others = [self.names.index(n) for n in among if n != name]
        if not others:
            return 1.0
        values, i = self.windows.values, self.names.index(name)
        straight = left_of(values[:, i], values[:, others])
        if straight <= _AT_ONCE:
            return straight
        # Beside a line in all, powers of one, or products of a few.
        tried = [
            np.column_stack([values[:, others], _powers(values[:, [n]], _HIGHEST)]) for n in others
        ]
        tried += [_powers(values[:, others])] if len(others) < _BENT else []
        return min([straight, *(_left_on_others(values[:, i], part) for part in tried)])

    def is_white(self, name: str, among: Sequence[str]) -> bool:
        """Whether what a channel leaves then is white, and little."""
        i, others = self.names.index(name), [self.names.index(n) for n in among if n != name]
        values = self.windows.neighbours
        left = rest_of(values[:, i], values[:, others])
        power, whole = float(np.var(left)), float(np.var(values[:, i]))
        turns = float(np.mean(np.diff(left) ** 2))
        return 0 < power < _NOISY * whole and turns > power

    def gain(self, name: str) -> float:
        """How much the past of the others tells of a channel; infinite where that is not known."""
        return self.gains.get(name, np.inf)

    # -- roles ----------------------------------------------------------------------------------

    def roles(self) -> Roles:
        """Judge all channels."""
        found = Roles()
        self._find_set_points(found)
        driving = self._find_outputs(found)
        rest = self._rest(found)
        for name in rest:
            if name in self.rates or name in self.held:
                continue
            if name in driving or name in found.set_points.values():
                found.inputs.append(name)
                continue
            order = self._order(name, rest, found)
            if order:
                found.orders[name] = order
            else:
                found.inputs.append(name)
        found.inputs = [n for n in rest if n in self.held or n in found.inputs]
        return found

    def _rest(self, found: Roles) -> list[str]:
        """Channels that are neither outputs nor set-points."""
        return [n for n in self.names if n not in found.outputs and n not in found.set_points]

    def _find_outputs(self, found: Roles) -> list[str]:
        """Take out what follows from the others at once, one after the other.

        What is the last to drive the system answers it in a loop, and drives it all the same: such
        channels are returned.
        """
        bound = {*self.rates, *self.bases, *self.held, *found.set_points.values()}
        free = [n for n in self._rest(found) if n not in bound and not is_nature(n)]
        kept: list[str] = []
        while True:
            rest = self._rest(found)
            redundant = [n for n in free if self._redundant(n, rest)]
            name = self._least_a_state(redundant, rest)
            if name is None:
                return kept
            free.remove(name)
            if self._drives(name, [n for n in rest if n != name]):
                kept.append(name)
            else:
                found.outputs.append(name)
                found.reasons[name] = "output: it follows from the others at once"

    def _drives(self, name: str, others: Sequence[str]) -> bool:
        """Whether nothing would drive the others without a channel, which they do not make move."""
        rest = [n for n in others if n not in self.rates and n not in self.bases]
        if any(n in self.held or not self._state_like(n, others) for n in rest):
            return False
        rates = [n for n in others if n in self.rates]
        moving = rates or rest
        whole = [*others, name]
        return any(self._best(n, others) > _FIRST + _NO_MORE * self._best(n, whole) for n in moving)

    def _redundant(self, name: str, rest: Sequence[str]) -> bool:
        if self.at_once(name, rest) <= _AT_ONCE:
            return True
        return not self._state_like(name, rest) and self.is_white(name, rest)

    def _state_like(self, name: str, among: Sequence[str]) -> bool:
        return self._clearest(name, among) <= _STATE / 4

    def _clearest(self, name: str, among: Sequence[str]) -> float:
        return min(self.moves(name, order, among)[0] for order in (1, 2))

    def _least_a_state(self, redundant: Sequence[str], rest: Sequence[str]) -> str | None:
        """Of channels that follow from each other, the one that is an output sooner than a state.

        Each is looked at without the others, for what one of them does shows in the other.
        """
        if len(redundant) < 2:
            return redundant[0] if redundant else None
        alone = [n for n in rest if n not in redundant]
        left = {n: self._clearest(n, alone) for n in redundant}
        if unlike := [n for n in redundant if left[n] > _STATE]:
            return max(unlike, key=self.gain)
        least, *_, most = sorted(redundant, key=lambda n: left[n])
        clearly = left[most] > _AT_ONCE and left[most] > _CLEARLY * left[least]
        return most if clearly else redundant[-1]

    def _order(self, name: str, rest: Sequence[str], found: Roles) -> int:
        """Order of a state; zero for what is none."""
        among = [n for n in rest if n not in self.rates or self.rates[n] != name]
        first, alone = self.moves(name, 1, among)
        found.left[name] = first**0.5
        if name in self.bases:
            return self._order_with_rate(name, rest, found)
        second, alone_twice = self.moves(name, 2, among)
        order = 2 if first > _FIRST and second < _BETTER * first else 1
        left, own = (second, alone_twice) if order == 2 else (first, alone)
        if _STATE < left < _BENT_LEFT and self.gain(name) >= _STATE * self._most():
            left = _STATE / _BENT_LEFT * self._bent(name, among)
        if is_nature(name) or left > _STATE:
            return 0
        if len(self.names) > 1 and (left > _HELPED * own or self._undriven(name, left, rest)):
            return 0
        if order == 2:
            found.left[name] = second**0.5
            if (per_swing := self.windows.per_swing(name)) < _PER_SWING:
                found.coarse[name] = per_swing
        found.reasons[name] = (
            "state of order 2: its second derivative follows from it and the others"
            if order == 2
            else "state: its rate follows from it and the others"
        )
        return order

    def _undriven(self, name: str, left: float, rest: Sequence[str]) -> bool:
        """Whether the past of the others tells nothing of a channel, and windows not much.

        A slow input is nearly what its response and that one's rate make of it.
        """
        most = self._most()
        # Of smooth records without noise the past of each tells all, and gains tell nothing.
        if most >= _DRIVEN and self.gain(name) >= min(_UNDRIVEN * most, 1.0):
            return False
        free = [n for n in rest if n not in {*self.held, *self.rates, *self.bases}]
        least = [self._clearest(n, rest) for n in free] + [self._best(n, rest) for n in self.rates]
        return left > min(least) + _FIRST

    def _most(self) -> float:
        """The largest gain from the past of others."""
        return max((g for n, g in self.gains.items() if n not in self.held), default=0.0)

    def _bent(self, name: str, among: Sequence[str]) -> float:
        """Share that is left of a rate where products and powers of the channels make it."""
        columns = [self.names.index(n) for n in dict.fromkeys((name, *among))]
        if len(columns) > _BENT:
            return 1.0
        rows = self.windows.rows(1, self.windows.span(columns[0], 1)[0])
        good = without_dropouts(rows.change[:, columns[0]])
        powers = _powers(rows.mean[good][:, columns])
        return _left_on_others(rows.change[good, columns[0]], powers, _BLOCKS)

    def _order_with_rate(self, name: str, rest: Sequence[str], found: Roles) -> int:
        """One where the recorded rate is itself what the others, and the state, make at once."""
        rate = next(r for r, base in self.rates.items() if base == name)
        found.reasons[name] = "state of order 2: its rate is recorded"
        at_once = self.at_once(rate, rest)
        if at_once > _AT_ONCE or at_once > self.moves(rate, 1, rest)[0]:
            return 2
        found.reasons[name] = "state: its recorded rate follows from it and the others at once"
        return 1

    def _find_set_points(self, found: Roles) -> None:
        """Leave out what a controller is told, where its answer is recorded and does the same."""
        free = [n for n in self.names if n not in {*self.held, *self.rates, *self.bases}]
        for wanted in [n for n in self.names if n in self.held and self._is_wanted(n)]:
            rest = self._rest(found)
            without = [n for n in rest if n != wanted]
            moving = [n for n in free if self._state_like(n, without)]
            answers = [n for n in free if n not in moving and self._answers(n, wanted, rest)]
            targets = [*moving, *self.rates]
            if not answers or not targets:
                continue
            if all(self._best(n, without) <= 2 * self._best(n, rest) + _FIRST for n in targets):
                found.set_points[wanted] = answers[0]
                found.reasons[wanted] = f"set-point, left out: it acts through {answers[0]}"
                found.reasons[answers[0]] = f"control: it answers {wanted}"

    def _best(self, name: str, among: Sequence[str]) -> float:
        base = self.rates.get(name)
        return self.moves(name, 1, [n for n in among if self.rates.get(n) != name or n == base])[0]

    def _answers(self, name: str, wanted: str, rest: Sequence[str]) -> bool:
        """Whether a channel is told much better by the others with a set-point than without."""
        values, i = self.windows.values, self.names.index(name)
        others = [self.names.index(n) for n in rest if n not in (name, wanted)]
        every = [*others, self.names.index(wanted)]
        return left_of(values[:, i], values[:, every]) < _HELPED * left_of(
            values[:, i], values[:, others]
        )

    def _is_wanted(self, name: str) -> bool:
        """Whether a channel is called a set-point, or is one of another, in its unit and range."""
        if _WANTED.search(name):
            return True
        channel, values = self.runs[0].channel(name), self.windows.values
        own = values[:, self.names.index(name)]
        for other in self.names:
            unit = self.runs[0].channel(other).unit
            if other != name and known(unit) and known(channel.unit) and agree(unit, channel.unit):
                its = values[:, self.names.index(other)]
                if abs(own.mean() - its.mean()) < own.std() and np.corrcoef(own, its)[0, 1] > 0.5:
                    return True
        return False


def _powers(inputs: Array, highest: int = _DEGREE) -> Array:
    """All products of channels up to a degree, of values of size one."""
    z = (inputs - inputs.mean(axis=0)) / np.maximum(inputs.std(axis=0), np.finfo(float).tiny)
    columns = [
        np.prod(z[:, chosen], axis=1)
        for degree in range(1, highest + 1)
        for chosen in map(list, combinations_with_replacement(range(z.shape[1]), degree))
    ]
    return np.column_stack(columns)


def _left_on_others(target: Array, inputs: Array, blocks: int = 2) -> float:
    """Share of a variance that a fit on every second block leaves in the others, and back."""
    if len(target) < 2 * _SAMPLES * inputs.shape[1] or not np.ptp(target) > 0:
        return 1.0
    size = inputs.std(axis=0)
    # Powers of what has two values rest, but for rounding.
    moves = size > _RESTS * np.abs(inputs).max(axis=0)
    X = np.column_stack([inputs[:, moves] / size[moves], np.ones(len(target))])
    second = np.arange(len(target)) * blocks // len(target) % 2 == 1
    squares = 0.0
    for taught in (second, ~second):
        own = X[taught]
        weights = np.linalg.lstsq(own.T @ own, own.T @ target[taught], rcond=1e-12)[0]
        squares += float(np.sum((target[~taught] - X[~taught] @ weights) ** 2))
    return squares / (len(target) * float(np.var(target)))

"""What a tuning is asked: parameters and their bounds, objective, constraints, over which runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dfsm.controllers.controller import require_texts
from dfsm.core.settings import (
    require,
    require_kind,
    require_list,
    require_number,
    settings_class,
    shown,
)
from dfsm.core.types import Array
from dfsm.errors import DfsmError, missing
from dfsm.loops.load_cases import require_weights
from dfsm.loops.measures import Measure
from dfsm.models.dfsm import DFSM
from dfsm.simulation.loop_cases import ClosedLoopSettings

# Starts, and points of a front: each is an optimization.
_MOST_STARTS = 10_000


@settings_class
class Goal(Measure):
    """A term of the objective: a measure, its weight, and what it is divided by.

    Attributes
    ----------
    measure, channel, exponent, reference
        See `Measure`.
    weight
        Above 0 to make the measure small, below 0 to make it large.
    scale
        What the measure is divided by; None takes its value with the controller as it is.
    """

    weight: float = 1.0
    scale: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        name, expected = f"weight of {self.label}", "a number that is not 0"
        require_number(name, self.weight, expected)
        require(self.weight != 0, name, self.weight, expected)
        require_number(f"scale of {self.label}", self.scale, "more than 0", above=0, optional=True)


@settings_class
class Limit(Measure):
    """A constraint: a measure that may not pass a value; of extremes in every run.

    Attributes
    ----------
    measure, channel, exponent, reference
        See `Measure`.
    at_most, at_least
        One of them, in the unit of the measure.
    """

    at_most: float | None = None
    at_least: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        one = (self.at_most is None) != (self.at_least is None)
        require(one, f"limit of {self.label}", "missing or double", "at_most or at_least")
        for name in ("at_most", "at_least"):
            what = f"{name} of {self.label}"
            require_number(what, getattr(self, name), "a finite number", optional=True)

    @property
    def bound(self) -> float:
        """The value that may not be passed."""
        return float(self.at_most if self.at_most is not None else self.at_least)  # pyright: ignore[reportArgumentType]

    def excess(self, value: float | Array) -> float | Array:
        """How far a value is beyond, as a share of the limit; negative within."""
        size = abs(self.bound) or 1.0
        return (value - self.bound) / size * self.sign

    @property
    def sign(self) -> float:
        """1 for an upper limit, -1 for a lower one."""
        return 1.0 if self.at_most is not None else -1.0


@settings_class
class TuningProblem:
    """What is tuned, and for what.

    Attributes
    ----------
    parameters
        Lowest and highest value by name, see `dfsm.controllers.tunable`.
    objective
        Terms, added up: Σ weight · measure / scale.
    constraints
        What may not be passed.
    weights
        Share of the time that each run stands for, see `weibull_weights`; None for equal shares.

    Raises
    ------
    DfsmError
        No parameters, no objective, bounds the wrong way round, or weights that are not positive.
    """

    parameters: Mapping[str, tuple[float, float]]
    objective: Sequence[Goal]
    constraints: Sequence[Limit] = ()
    weights: Sequence[float] | None = None

    def __post_init__(self) -> None:
        bounds = "bounds by the name of a parameter, {'kp': (0.1, 2.0)}"
        require_kind("parameters", self.parameters, Mapping, bounds)
        require_texts("names of parameters", list(self.parameters))
        require(bool(self.parameters), "parameters", "empty", "at least one, with its bounds")
        for name, terms, kind in (
            ("objective", self.objective, Goal),
            ("constraints", self.constraints, Limit),
        ):
            expected = f"a list of dfsm.{kind.__name__}(…)"
            require_list(name, terms, expected)
            for term in terms:
                require_kind(f"a term of the {name}", term, kind, f"dfsm.{kind.__name__}(…)")
        require(bool(self.objective), "objective", "empty", "at least one term")
        for name, pair in self.parameters.items():
            told, expected = f"bounds of {name}", "two numbers, the lower one first"
            require_list(told, pair, expected)
            require(len(pair) == 2, told, shown(pair), expected)
            for bound in pair:
                require_number(f"one of the {told}", bound, expected)
            low, high = pair
            require(low < high, told, (low, high), expected)
            if name == "ps_percent":
                require(low > 0 and high <= 1, f"bounds of {name}", (low, high), "shares up to 1")
            elif name in ("omega_pc", "zeta_pc", "omega_vs", "zeta_vs"):
                require(low > 0, f"bounds of {name}", (low, high), "numbers above 0")
        if self.weights is not None:
            require_weights(self.weights)

    @property
    def measures(self) -> tuple[Measure, ...]:
        """Of objective and constraints, in this order."""
        return (*self.objective, *self.constraints)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest values of the parameters."""
        low, high = zip(*self.parameters.values(), strict=True)
        return np.array(low, dtype=float), np.array(high, dtype=float)


@settings_class
class TuneSettings:
    """How to tune.

    Attributes
    ----------
    start, stop
        Time window in s that is scored.
    loop
        How loops are closed.
    starts
        Starting points: the controller as it is, and others spread over the bounds.
    seed
        Of these.
    iterations
        Most steps from each start.
    tolerance
        Of the optimizer, in shares of the objective.
    pareto
        Number of weights between two terms of the objective, for their Pareto front; 0 for none.
    """

    start: float | None = None
    stop: float | None = None
    loop: ClosedLoopSettings = ClosedLoopSettings()
    starts: int = 1
    seed: int = 0
    iterations: int = 40
    tolerance: float = 1e-5
    pareto: int = 0

    def __post_init__(self) -> None:
        for name in ("start", "stop"):
            require_number(name, getattr(self, name), "seconds, or None", optional=True)
        require_kind("loop", self.loop, ClosedLoopSettings, "dfsm.ClosedLoopSettings(…)")
        expected = f"a whole number from 1 to {_MOST_STARTS:,}"
        most = _MOST_STARTS
        require_number("starts", self.starts, expected, least=1, most=most, whole=True)
        require_number("seed", self.seed, "a whole number, 0 or more", least=0, whole=True)
        require_number(
            "iterations", self.iterations, "a whole number, at least 1", least=1, whole=True
        )
        require_number("tolerance", self.tolerance, "between 0 and 1", above=0)
        require(self.tolerance < 1, "tolerance", self.tolerance, "between 0 and 1")
        expected = f"0, or a whole number from 2 on, {_MOST_STARTS:,} at most"
        require_number("pareto", self.pareto, expected, least=0, most=most, whole=True)
        require(self.pareto != 1, "pareto", self.pareto, expected)


def check_problem(problem: TuningProblem, model: DFSM, runs: int, settings: TuneSettings) -> None:
    """Refuse a problem that does not fit the model or the runs.

    Raises
    ------
    DfsmError
        A channel that the model does not have, weights that are not one per run, or a Pareto front
        of other than two terms.
    """
    s = model.signals
    known = [c.name for c in (*s.observed, *s.controls, *s.outputs)]
    if lost := list(dict.fromkeys(m.channel for m in problem.measures if m.channel not in known)):
        raise DfsmError(
            f"objective and constraints: the model has {missing(lost, known)} (an output is added "
            "by fitting the model with it)"
        )
    if problem.weights is not None:
        require_weights(problem.weights, runs)
    if settings.pareto:
        count = len(problem.objective)
        require(count == 2, "terms of the objective", count, "two for a Pareto front")

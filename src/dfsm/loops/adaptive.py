"""Optimize on a surrogate, simulate the optimum, learn from it, and again until both agree.

A surrogate is only as good as its data where the optimizer goes, and an optimizer goes where the
surrogate flatters. Simulating its optimum on the true system costs one run, tells how far the
prediction can be trusted, and is the most useful run to fit next.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from dfsm.control.names import End, Signals
from dfsm.control.nlp.shot import Method
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.solution import Ending, Solution
from dfsm.control.solve import optimum
from dfsm.core.drawing import Engine, Shown, draw
from dfsm.core.host import from_host
from dfsm.core.progress import track
from dfsm.core.renamed import renamed
from dfsm.core.settings import require, settings_class
from dfsm.data.conversion import in_units_of
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError, printable
from dfsm.models.dfsm import DFSM

# Share of the cost up to which the price of a miss is taken to be of first order.
_TRUSTED = 0.1


class Agreement(enum.Enum):
    """How an adaptive optimization ended; the value says what it means and what to do."""

    AGREED = "prediction and simulation agree"
    LIMIT = (
        "prediction and simulation still differ after the last round, this is the round in which "
        "they differ least: raise most_rounds, train on more runs around the optimum, or choose a "
        "corrective function that fits them better"
    )
    UNSOLVED = (
        "the last problem was not solved on its surrogate, see the solution's message: train on "
        "more runs around where the optimum is expected, or loosen the problem"
    )


@settings_class
class AdaptiveSettings:
    """When to stop.

    Attributes
    ----------
    tolerance
        Largest difference of predicted and realised cost, as a share of the predicted one.
    most_rounds
        Rounds of fit, solve and simulation.
    method
        How to solve; None as in `solve`.
    """

    tolerance: float = 0.01
    most_rounds: int = 10
    method: Method | None = None

    def __post_init__(self) -> None:
        require(0 < self.tolerance < 1, "tolerance", self.tolerance, "between 0 and 1")
        require(self.most_rounds >= 1, "most_rounds", self.most_rounds, "at least 1")


@dataclass(frozen=True, eq=False)
class Realised:
    """What optimal controls cost on the true system.

    Attributes
    ----------
    cost
        M + ∫ L dt along the simulated run, by the trapezoidal rule on its samples.
    miss
        Simulated minus required final state, by name; 0 inside the range that is required.
    price
        Σ λ miss with the solution's costates λ at the end: to first order, what it would cost to
        end where it was required; negative where the miss made the run dearer.
    at_most
        Σ |λ| |miss|: the same if no part of the miss made up for another.
    """

    cost: float
    miss: dict[str, float]
    price: float
    at_most: float


@dataclass(frozen=True, eq=False)
class Round:
    """One round of fit, solve and simulation.

    Attributes
    ----------
    solution
        On this round's surrogate.
    run
        The true system under its controls; where the problem was not solved, under those of the
        last iterate.
    realised
        What that cost.
    difference
        |realised cost + price − predicted cost| over |predicted cost|. A miss that could cost more
        than a tenth of it is too large for a price of first order: then `at_most` counts instead.
        Infinite where the problem was not solved.
    """

    solution: Solution
    run: Trajectory
    realised: Realised
    difference: float


@dataclass(frozen=True, eq=False)
class AdaptiveResult(Shown):
    """Where `optimize_adaptively` ended, and all rounds on the way.

    Attributes
    ----------
    status
        How it ended.
    solution, model
        Of the best round: the optimum, and its surrogate.
    rounds
        All rounds, in order.
    best
        Index of the best round: the one in which prediction and simulation differ least.
    runs
        All training runs, the added ones last.
    simulations
        True simulations of optimal controls.
    """

    status: Agreement
    solution: Solution
    model: DFSM
    rounds: tuple[Round, ...]
    best: int
    runs: tuple[Trajectory, ...]
    simulations: int

    def __repr__(self) -> str:
        return (
            f"<AdaptiveResult: best of {len(self.rounds)} rounds is number {self.best + 1}, "
            f"objective {self.solution.objective:.5g}; {self.message}>"
        )

    @property
    def message(self) -> str:
        """One sentence on the outcome."""
        return self.status.value

    def plot(self, *, engine: Engine = "plotly") -> Any:
        """Draw the objective of every round, predicted and realised.

        Parameters
        ----------
        engine
            "plotly" for the screen, "matplotlib" for print (needs ``dfsm[figures]``).

        Returns
        -------
        plotly.graph_objects.Figure or matplotlib.figure.Figure
            To show, change or save.
        """
        return draw(self, None, engine)

    def summary(self) -> str:
        """Describe the rounds in a line each."""
        lines = [f"{self.message}; {self.simulations} true simulations of optimal controls"]
        for k, done in enumerate(self.rounds):
            line = f"  round {k + 1}: predicted {done.solution.objective:.6g}"
            if not done.solution.solved:
                line += f", {printable(done.solution.message)}"
            else:
                line += f", realised {done.realised.cost:.6g} and {done.realised.price:.3g} for "
                line += f"what it missed, {done.difference:.2%} apart"
            lines.append(line + (" (best)" if k == self.best else ""))
        return "\n".join(lines)


@renamed(options="settings")
def optimize_adaptively(
    runs: Sequence[Trajectory],
    fit: Callable[[list[Trajectory]], DFSM],
    problem: Callable[[DFSM], OptimalControlProblem],
    simulator: Callable[[Solution], Trajectory],
    settings: AdaptiveSettings | None = None,
) -> AdaptiveResult:
    """Optimize on surrogates until the true system does what the last one predicts.

    Every round fits a surrogate to all runs, optimizes on it from the last optimum, and simulates
    the optimal controls on the true system. That run joins the training runs.

    Parameters
    ----------
    runs
        Training runs to begin with.
    fit
        Runs to a surrogate.
    problem
        A surrogate to the problem to solve on it, of one scenario.
    simulator
        A solution to the true system's run under its controls, over the same time and from the
        same initial state, with the channels that `fit` and the costs need.
    settings
        When to stop.

    Returns
    -------
    AdaptiveResult
        Also where no agreement was reached: look at its `status`, or print its `summary()`.

    Raises
    ------
    DfsmError
        A problem of several scenarios, a run that lacks a channel or lasts another time, or
        whatever `fit` and `solve` refuse.
    """
    settings = settings or AdaptiveSettings()
    runs, rounds, models = list(runs), list[Round](), list[DFSM]()
    guess: Solution | None = None
    for _ in track(range(settings.most_rounds), "adaptive rounds", settings.most_rounds):
        models.append(fit(list(runs)))
        asked = problem(models[-1])
        require(len(asked.scenarios) == 1, "scenarios", len(asked.scenarios), "one")
        # Outside the training data or not: the next model is fitted where this optimum went.
        solution = optimum(asked, settings.method, guess)
        if not solution.solved and guess is not None and solution.ending is not Ending.INTERRUPTED:
            # The last optimum of a poor surrogate can be a worse start than none.
            solution = optimum(asked, settings.method)
        rounds.append(_round(asked, solution, simulator))
        runs.append(rounds[-1].run)
        guess = solution if solution.solved else None
        done = rounds[-1].difference <= settings.tolerance
        if done or solution.ending is Ending.INTERRUPTED:
            break
    return _result(rounds, models, runs, settings)


def _round(
    problem: OptimalControlProblem, solution: Solution, simulator: Callable[[Solution], Trajectory]
) -> Round:
    # Where a surrogate has no feasible point, the last iterate shows the next one what is wrong.
    run = in_units_of(simulator(solution), solution.trajectory.channels)
    costs = realised(problem, solution, run)
    if not solution.solved:
        return Round(solution, run, costs, np.inf)
    size = max(abs(solution.objective), np.finfo(float).tiny)
    gap = costs.cost - solution.objective
    if costs.at_most > _TRUSTED * size:
        return Round(solution, run, costs, (abs(gap) + costs.at_most) / size)
    return Round(solution, run, costs, abs(gap + costs.price) / size)


def _result(
    rounds: list[Round],
    models: list[DFSM],
    runs: list[Trajectory],
    settings: AdaptiveSettings,
) -> AdaptiveResult:
    best = int(np.argmin([r.difference for r in rounds]))
    status = Agreement.LIMIT
    if rounds[best].difference <= settings.tolerance:
        status = Agreement.AGREED
    elif not rounds[-1].solution.solved:
        status = Agreement.UNSOLVED
    return AdaptiveResult(
        status, rounds[best].solution, models[best], tuple(rounds), best, tuple(runs), len(rounds)
    )


def realised(problem: OptimalControlProblem, solution: Solution, run: Trajectory) -> Realised:
    """Cost of a run of the true system, and the price of the final state that it missed.

    Parameters
    ----------
    problem
        Of one scenario.
    solution
        Its solution.
    run
        The true system under the solution's controls: holds the problem's states, controls,
        disturbances and outputs. Parameters are those of the solution.

    Returns
    -------
    Realised

    Raises
    ------
    DfsmError
        The run lacks a channel, or does not last as long as the solution.
    """
    span = solution.trajectory.time
    if np.abs(run.time[[0, -1]] - span[[0, -1]]).max() > 1e-6 * (span[-1] - span[0]):
        raise DfsmError(
            f"{run.where}: lasts from {run.time[0]:g} s to {run.time[-1]:g} s, expected the "
            f"solution's {span[0]:g} s to {span[-1]:g} s"
        )
    names = problem.plant.names("states")
    states = run.select(names).require_finite().values
    cost = _cost(problem, solution, run)
    miss, prices = dict[str, float](), list[float]()
    costates = dict(zip(names, solution.costates[0].select(names).values[-1], strict=True))
    for name, last in zip(names, states[-1], strict=True):
        if name in problem.final:
            low, high = problem.end_limits("final", name)
            miss[name] = float(last - np.clip(last, low, high))
            prices.append(float(costates[name]) * miss[name])
    return Realised(cost, miss, sum(prices), sum(map(abs, prices)))


def _cost(problem: OptimalControlProblem, solution: Solution, run: Trajectory) -> float:
    """M + ∫ L dt along a run."""
    plant = problem.plant
    p = from_host([solution.parameters[n] for n in plant.names("parameters")])
    x, u, w = (
        from_host(run.select(plant.names(group)).values)
        for group in ("states", "controls", "disturbances")
    )
    # Outputs as the true system gave them, and not what the surrogate makes of its states.
    y = from_host(run.select(n for n in plant.names("outputs") if n in run).values)
    total = 0.0
    if problem.cost is not None:
        cost, outputs = problem.cost, tuple(c for c in plant.channels["outputs"] if c.name in run)

        def integrand(t: Any, y: Any, *values: Any) -> Any:
            channels = {**plant.channels, "outputs": outputs}
            true = replace(plant, channels=channels, output=lambda *_: y)
            return cost(Signals(true, t, (*values, p)))

        rates = jax.vmap(integrand)(from_host(run.time), y, x, u, w)
        total += float(np.trapezoid(np.asarray(rates), run.time))
    if problem.final_cost is not None:
        ends = (End(plant, run.time[k], x[k], p) for k in (0, -1))
        total += float(problem.final_cost(*ends))
    return total

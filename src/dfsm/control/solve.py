"""`solve`: from a problem to a solution, inside the training range of a surrogate if asked."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from dfsm.control.assembly import inputs_of, solution_of
from dfsm.control.meshes import Record, solve_meshes
from dfsm.control.names import Signals
from dfsm.control.nlp.shot import Method
from dfsm.control.nlp.transcription import DirectTranscription
from dfsm.control.problem import OptimalControlProblem
from dfsm.control.solution import Solution
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmWarning
from dfsm.models.departures import MUCH_OUTSIDE

# By which factor the bound on the distance from the training data is tightened at most.
_TIGHTER = 4.0


def solve(
    problem: OptimalControlProblem,
    method: Method | None = None,
    guess: Solution | Trajectory | None = None,
    simulate: bool = True,
) -> Solution:
    """Solve an optimal control problem.

    Parameters
    ----------
    problem
        What to minimise, subject to what.
    method
        `DirectTranscription`, `MultipleShooting` or `SingleShooting`; None is the first with its
        defaults.
    guess
        None starts from what a surrogate's training runs did in disturbances like these, or else
        from straight lines between the ends. A run gives the states and controls that it holds; a
        solution, of any mesh or method, gives all and is stayed close to.
    simulate
        Integrate the model with the optimal controls and report how far the states deviate.

    Returns
    -------
    Solution
        Also of a solve that did not succeed: look at its `ending`, or print its `summary()`.

    Raises
    ------
    DfsmError
        A function that names an unknown signal, is not finite at the start, or cannot be followed
        by JAX; bounds or settings that contradict each other.

    Warns
    -----
    DfsmWarning
        An optimum of a surrogate is outside its training data for part of the horizon.
    """
    solution = optimum(problem, method, guess, simulate)
    if solution.solved and (solution.outside or 0.0) > MUCH_OUTSIDE:
        where = "; ".join(solution.departures)
        advice = "" if method and method.stay_inside else "; stay_inside keeps it near the data"
        warnings.warn(
            f"{solution.name}: the optimum is outside the training data for "
            f"{solution.outside:.1%} of the horizon: {where}{advice}",
            DfsmWarning,
            stacklevel=2,
        )
    return solution


def optimum(
    problem: OptimalControlProblem,
    method: Method | None = None,
    guess: Solution | Trajectory | None = None,
    simulate: bool = True,
) -> Solution:
    """As `solve`, for whoever tells by other means that an optimum is outside the training data."""
    method = method or DirectTranscription()
    region = problem.plant.region
    if not method.stay_inside or region is None or not region.whitening.size:
        return solution_of(problem, solve_meshes(problem, method, guess), simulate)
    if isinstance(guess, Solution):
        return solution_of(*_inside(problem, method, guess), simulate)
    # The distance bends the feasible set: from the optimum without it the solver needs tens of
    # iterations, from a guess hundreds.
    first = solve_meshes(problem, method, guess, on_the_way=True)
    free = solution_of(problem, first, simulate=False)
    if not free.solved:
        return solution_of(problem, first, simulate)
    inside, record = _inside(problem, method, free)
    return solution_of(inside, record.after(first), simulate)


def _inside(
    problem: OptimalControlProblem, method: Method, guess: Solution
) -> tuple[OptimalControlProblem, Record]:
    """Solve with a bound on the distance from the training data, tightened step by step.

    From far outside, the last bound at once costs hundreds of iterations or is never met.
    """
    farthest, done = max(_farthest(problem, guess), 1.0), None
    steps = max(1, int(np.ceil(np.log(farthest) / np.log(_TIGHTER))))
    for step in range(1, steps):
        looser = _within(problem, farthest ** (1 - step / steps))
        done = solve_meshes(looser, method, guess, on_the_way=True).after(done)
        if done.outcome.ending == "interrupted":
            return looser, done
        guess = solution_of(looser, done, simulate=False)
    inside = _within(problem, 1.0)
    return inside, solve_meshes(inside, method, guess).after(done)


def _within(problem: OptimalControlProblem, limit: float) -> OptimalControlProblem:
    kept = {"distance from the training data": (_distance, None, limit)}
    return replace(problem, constraints={**problem.constraints, **kept})


def _farthest(problem: OptimalControlProblem, solution: Solution) -> float:
    """Largest distance of a solution's nodes, see `Region.distance_chosen`."""
    region = problem.plant.region
    values = [inputs_of(problem, run) for run in solution.trajectories]
    return max(float(region.distance_chosen(v).max()) for v in values) if region else 0.0


def _distance(signals: Signals) -> Any:
    return signals.distance

"""IPOPT, reached through CasADi, on a `Program` that supplies exact sparse derivatives.

Nothing else in the package knows which solver it is. Wächter and Biegler (2006).
"""

from __future__ import annotations

import signal
import threading
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from dfsm.control.nlp.optimality import optimality
from dfsm.control.nlp.program import Program
from dfsm.control.nlp.watch import Watch
from dfsm.control.solution import Optimality
from dfsm.core.types import Array
from dfsm.errors import DfsmError

# Names that IPOPT gives its outcomes, in groups that ask for the same action.
_SOLVED = ("Solve_Succeeded", "Feasible_Point_Found")
_ACCEPTABLE = ("Solved_To_Acceptable_Level",)
_STALLED = ("Search_Direction_Becomes_Too_Small",)
_INFEASIBLE = ("Infeasible_Problem_Detected", "Not_Enough_Degrees_Of_Freedom")
_LIMIT = ("Maximum_Iterations_Exceeded",)
_TIME = ("Maximum_CpuTime_Exceeded", "Maximum_WallTime_Exceeded")
_UNBOUNDED = ("Diverging_Iterates",)
_STOPPED = ("User_Requested_Stop",)
_NOT_FINITE = ("Invalid_Number_Detected",)
# Endings after which the best iterate is worth more than the last one.
_BEST = ("interrupted", "limit", "time", "not finite", "failed")
# Scaled variables beyond this run away.
_DIVERGED = 1e12


@dataclass(frozen=True)
class Outcome:
    """Where the solver ended, and how.

    Attributes
    ----------
    z
        Scaled variables, shape ``(variable,)``.
    multipliers, bound_multipliers
        Of scaled constraints and of scaled variables.
    ending
        ``"solved"``, ``"acceptable"``, ``"stalled"``, ``"infeasible"``, ``"limit"``, ``"time"``,
        ``"unbounded"``, ``"interrupted"``, ``"not finite"`` or ``"failed"``: what the solver says;
        ``"runaway"`` where variables run away and the objective does not fall.
    optimality
        How well the conditions hold at `z`: what is measured.
    iterations
        Steps taken.
    seconds
        Time it took, evaluations included.
    """

    z: Array
    multipliers: Array
    bound_multipliers: Array
    ending: str
    optimality: Optimality
    iterations: int
    seconds: float


@dataclass(frozen=True)
class SolverSettings:
    """Tolerance, limit, and how much is known about the starting point.

    Attributes
    ----------
    tolerance
        Of the scaled optimality conditions.
    iterations
        Most steps.
    warm
        The start is near a solution: stay close to it, bounds included.
    adaptive
        Let the barrier of a linear-quadratic program adapt: fewer iterations, but no guarantee.
    until
        When to stop, as `time.perf_counter` counts; None for no limit.
    """

    tolerance: float = 1e-8
    iterations: int = 500
    warm: bool = False
    adaptive: bool = True
    until: float | None = None


def solve_nlp(
    program: Program, start: Array, settings: SolverSettings, multipliers: Array | None = None
) -> Outcome:
    """Minimise a program with IPOPT.

    Ctrl-C ends the solve; what comes back then is the best iterate so far.

    Parameters
    ----------
    program
        Functions, derivatives and limits.
    start
        Scaled variables, shape ``(variable,)``.
    settings
        See `SolverSettings`.
    multipliers
        First guess of those of the constraints, with ``settings.warm``.

    Returns
    -------
    Outcome
        Also for problems that were not solved.

    Raises
    ------
    DfsmError
        There are more equality constraints than variables.
    """
    from dfsm.control.nlp.callbacks import make_solver

    _require_freedom(program)
    watch = Watch(program)
    with _interruptible(watch), _quiet():
        solver = make_solver(program, watch, _ipopt(program, settings, multipliers is not None))
        begin = clock.perf_counter()
        limits = {"lbx": program.lower, "ubx": program.upper}
        limits |= {"lbg": program.g_lower, "ubg": program.g_upper}
        first = {} if multipliers is None else {"lam_g0": multipliers}
        last = solver(x0=start, **limits, **first)
    if watch.error is not None:
        raise watch.error
    stats = solver.stats()
    ending = _ending(stats["return_status"])
    z, lam_g, lam_x = (np.array(last[k]).ravel() for k in ("x", "lam_g", "lam_x"))
    point = z, lam_g, lam_x
    measured = optimality(program, *point)
    if ending == "failed" and measured.held(settings.tolerance):
        # It gives up, too, where rounding lets no step improve a point that is a solution.
        ending = "stalled"
    if ending == "unbounded" and not _fell(program, start, z):
        ending = "runaway"
    if ending in _BEST and watch.best is not None:
        point = watch.best
        measured = optimality(program, *point)
    seconds = clock.perf_counter() - begin
    return Outcome(*point, ending, measured, int(stats["iter_count"]), seconds)


def _require_freedom(program: Program) -> None:
    fixed = int((program.lower == program.upper).sum())
    equalities = int((program.g_lower == program.g_upper).sum())
    if equalities > program.n - fixed:
        raise DfsmError(
            f"{equalities} equality constraints for {program.n - fixed} variables leave nothing to "
            "choose: turn a path or boundary equality into limits, free an end, or use more "
            "intervals"
        )


def _fell(program: Program, start: Array, z: Array) -> bool:
    """Whether the objective is lower than at the start by more than its value there."""
    with np.errstate(all="ignore"):  # where variables run away, a function need not be finite
        before, after = program.cost(start), program.cost(z)
    return bool(after < before - abs(before))


def _ending(word: str) -> str:
    for ending, words in (
        ("solved", _SOLVED),
        ("acceptable", _ACCEPTABLE),
        ("stalled", _STALLED),
        ("infeasible", _INFEASIBLE),
        ("limit", _LIMIT),
        ("time", _TIME),
        ("unbounded", _UNBOUNDED),
        ("interrupted", _STOPPED),
        ("not finite", _NOT_FINITE),
    ):
        if word in words:
            return ending
    return "failed"


def _ipopt(program: Program, settings: SolverSettings, multipliers: bool) -> dict[str, Any]:
    chosen: dict[str, Any] = {
        "no_nlp_grad": True,
        "print_time": False,
        "show_eval_warnings": False,
        "calc_lam_x": False,
        "calc_lam_p": False,
        "ipopt.sb": "yes",
        "ipopt.print_level": 0,
        "ipopt.tol": settings.tolerance,
        "ipopt.constr_viol_tol": settings.tolerance,
        "ipopt.max_iter": settings.iterations,
        # Bounds are met exactly: users rely on them, and a square root on x ≥ 0.
        "ipopt.bound_relax_factor": 0.0,
        "ipopt.diverging_iterates_tol": _DIVERGED,
        "ipopt.mu_strategy": (
            "adaptive" if program.linear_quadratic and settings.adaptive else "monotone"
        ),
    }
    if settings.until is not None:
        chosen["ipopt.max_wall_time"] = max(settings.until - clock.perf_counter(), 1e-3)
    if settings.warm:
        chosen |= {
            "ipopt.mu_init": 1e-5,
            "ipopt.bound_push": 1e-7,
            "ipopt.bound_frac": 1e-7,
            "ipopt.slack_bound_push": 1e-7,
            "ipopt.slack_bound_frac": 1e-7,
        }
    if multipliers:
        chosen |= {
            "ipopt.warm_start_init_point": "yes",
            "ipopt.warm_start_bound_push": 1e-7,
            "ipopt.warm_start_bound_frac": 1e-7,
            "ipopt.warm_start_slack_bound_push": 1e-7,
            "ipopt.warm_start_slack_bound_frac": 1e-7,
            "ipopt.warm_start_mult_bound_push": 1e-7,
        }
    if program.linear_quadratic:
        # One evaluation of each derivative serves all iterations.
        names = ("jac_c_constant", "jac_d_constant", "hessian_constant")
        chosen |= {f"ipopt.{name}": "yes" for name in names}
    return chosen


@contextmanager
def _interruptible(watch: Watch) -> Iterator[None]:
    """Let Ctrl-C end the solve at its next iteration; a second one acts as usual."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread receives signals
        return

    def stop(_number: int, _frame: Any) -> None:
        watch.stop = True
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _quiet() -> Iterator[None]:
    """Turn CasADi's own exceptions into a sentence."""
    try:
        yield
    except RuntimeError as error:
        first = str(error).strip().split("\n")[-1]
        raise DfsmError(
            f"the nonlinear program was refused by IPOPT ({first}): check sizes and limits"
        ) from error

"""The turbine problem of `benchmarks.control` written in CasADi expressions, as its users would.

Same model, transcription, scaling and solver options; dynamics and cost are symbolic functions of
one node, mapped over all nodes, and IPOPT gets the exact derivatives that CasADi generates, which
are interpreted or compiled as C code.
"""

from __future__ import annotations

import time as clock
from typing import Any

import casadi as ca
import numpy as np

from dfsm.control import OptimalControlProblem
from dfsm.models.corrective import GaussianUnits
from dfsm.models.dfsm import DFSM


def solve_with_expressions(
    problem: OptimalControlProblem, count: int, compiled: bool = False, repeats: int = 1
) -> dict[str, Any]:
    """Minimise the turbine problem by the trapezoidal rule on equidistant nodes.

    Parameters
    ----------
    problem
        That of `benchmarks.control.turbine`.
    count
        Number of nodes.
    compiled
        Have CasADi write C code of the functions and compile it with gcc, in place of interpreting
        them.
    repeats
        Number of solves, all from the same start.

    Returns
    -------
    dict
        IPOPT's word, objective, iterations, seconds to set up (and compile), and to solve in the
        fastest solve.
    """
    model, first, last = problem.model, problem.start, problem.horizon[1]
    (wind_run,) = problem.scenarios
    if not isinstance(model, DFSM) or isinstance(last, tuple) or wind_run is None:
        raise TypeError("the problem of benchmarks.control was expected")
    begin = clock.perf_counter()
    n = len(model.signals.states)
    names = [c.name for c in (*model.signals.states, *model.signals.controls)]
    time = np.linspace(first, last, count)
    wind = np.interp(time, wind_run.time, wind_run["wind"])
    limits = [problem.limits(name, time) for name in names]
    low, high = (np.stack([limit[k] for limit in limits], axis=1) for k in (0, 1))
    columns = [[c.name for c in model.signals.inputs].index(name) for name in names]
    seen_low, seen_high = (np.asarray(a)[columns] for a in (model.region.low, model.region.high))
    scale = (seen_high - seen_low) / 2

    z = ca.MX.sym("z", len(names), count)
    X, U = (scale[:, None] * z)[:n, :], (scale[:, None] * z)[n:, :]
    slopes = _dynamics(model).map(count)(X, U, wind[None])
    step = (last - first) / (count - 1)
    gaps = X[:, 1:] - X[:, :-1] - step / 2 * (slopes[:, 1:] + slopes[:, :-1])
    costs = _cost(n).map(count)(X, U)
    shares = np.full(count, step)
    shares[[0, -1]] /= 2
    objective = ca.dot(costs, ca.DM(shares[None]))
    options: dict[str, Any] = {
        "ipopt.tol": 1e-7,
        "ipopt.constr_viol_tol": 1e-7,
        "ipopt.bound_relax_factor": 0.0,
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 500,
    }
    if compiled:
        options |= {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O2"]}}
    nlp = {"x": ca.vec(z), "f": objective, "g": ca.vec(gaps / scale[:n, None])}
    solver = ca.nlpsol("turbine", "ipopt", nlp, options)
    ready = clock.perf_counter()
    bounds = {"lbx": (low / scale).ravel(), "ubx": (high / scale).ravel(), "lbg": 0, "ubg": 0}
    middle = np.tile((seen_low + seen_high) / 2, (count, 1))
    first_guess = (np.clip(middle, low, high) / scale).ravel()
    solution, seconds = {}, []
    for _ in range(repeats):
        start = clock.perf_counter()
        solution = solver(x0=first_guess, **bounds)
        seconds.append(clock.perf_counter() - start)
    stats = solver.stats()
    return {
        "ending": stats["return_status"],
        "objective": float(solution["f"]),
        "iterations": int(stats["iter_count"]),
        "seconds_setup": ready - begin,
        "seconds_solve": min(seconds),
    }


def _dynamics(model: DFSM) -> ca.Function:
    """f̂(x, u, w) at one node; the schedule's coefficients are interpolated by hats."""
    s, f, e = model.signals, model.f, model.e
    if not isinstance(e, GaussianUnits):
        raise TypeError("the model of benchmarks.control was expected")
    sizes = (len(s.states), len(s.controls), len(s.disturbances))
    x, u, w = (ca.SX.sym(k, size) for k, size in zip("xuw", sizes, strict=True))
    inputs = ca.vertcat(u, w, x)
    grid, L, b = (np.asarray(a) for a in (f.grid, f.coefficients, f.offsets))
    value = ca.fmin(ca.fmax(w[0], grid[0]), grid[-1])
    out = ca.mtimes(L[0], inputs) + b[0]
    for k in range(len(grid) - 1):
        part = ca.fmin(ca.fmax((value - grid[k]) / (grid[k + 1] - grid[k]), 0), 1)
        out += part * (ca.mtimes(L[k + 1] - L[k], inputs) + b[k + 1] - b[k])
    centres, weights = np.asarray(e.centres), np.asarray(e.weights)
    scaled = (inputs - np.asarray(e.shift)) / np.asarray(e.scale)
    distances = ca.vertcat(*[ca.sumsqr(scaled - c) for c in centres.T])
    correction = ca.mtimes(weights, ca.exp(-distances)) + np.asarray(e.bias)
    rows = list(out.elements())
    for k, row in enumerate(model.corrected):
        rows[row] += correction[k]
    return ca.Function("dynamics", [x, u, w], [ca.vertcat(*rows)])


def _cost(states: int) -> ca.Function:
    x, u = ca.SX.sym("x", states), ca.SX.sym("u", 2)
    return ca.Function("cost", [x, u], [-0.99 * u[0] * x[1] + 1e-5 * u[0] ** 2 + 0.5 * u[1] ** 2])

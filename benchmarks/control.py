"""Optimal control: known problems, orders of convergence, and time per iteration on a turbine.

The turbine is a stand-in of the size of the paper's problem (Sec. 4): a surrogate with 4 states, 2
controls, coefficients scheduled in the wind and 200 Gaussian units in two rows, 600 s, trapezoidal.
"""

from __future__ import annotations

from shutil import which
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.casadi_expressions import solve_with_expressions
from benchmarks.known_problems import PROBLEMS
from dfsm.control import (
    DirectTranscription,
    MultipleShooting,
    OptimalControlProblem,
    Solution,
    solve,
)
from dfsm.control.mesh.schemes import Kind
from dfsm.data.derivatives import DerivativeSettings, StateSpec
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.models.corrective import GaussianUnits
from dfsm.models.dfsm import DFSM
from dfsm.models.linear import LinearModel
from dfsm.models.region import Region
from dfsm.models.signals import SignalTable

# Solves of which the fastest is timed.
REPEATS = 3
POINTS = (250, 500, 1000, 2000, 4000, 8000)
# Schemes with the order that theory gives them on smooth problems.
ORDERS: dict[str, tuple[Kind, int, int]] = {
    "trapezoidal": ("trapezoidal", 1, 2),
    "hermite_simpson": ("hermite_simpson", 1, 4),
    "radau 2": ("radau", 2, 3),
    "radau 3": ("radau", 3, 5),
}
# Of the solver where orders are measured; the default.
TOLERANCE = 1e-8
MESHES = (5, 10, 20, 40, 80, 160)
SMOOTH = ("Hager1", "HagerHouRao1")
SHOT = ("Hager1", "Vanderpol", "Brachistochrone", "HagerHouRao1", "TwoLinkRobot, energy")


def run() -> dict[str, Any]:
    """Measure all four.

    Returns
    -------
    dict
        ``known``: per problem the optimal value, and per method the objective, its relative error
        and the estimate of that, iterations and seconds to solve; ``orders``: per smooth problem
        and scheme the errors on 5 to 160 intervals; ``turbine``: per number of points the
        iterations and milliseconds per iteration; ``expressions``: the same program in CasADi
        expressions, with times and objectives.
    """
    return {
        "known": known(),
        "orders": orders(),
        "turbine": turbine_times(),
        "expressions": against_expressions(),
    }


def known() -> dict[str, Any]:
    """Solve the problems with known answers, from straight lines."""
    results: dict[str, Any] = {}
    for name, make in PROBLEMS.items():
        case = make()
        methods: dict[str, Any] = {
            "hermite_simpson": DirectTranscription(),
            "radau": DirectTranscription(scheme="radau"),
        }
        if name in SHOT:
            methods["multiple_shooting"] = MultipleShooting()
        results[name] = {"value": case.value} | {
            label: _figures(solve(case.problem, method, case.guess, simulate=False), case.value)
            for label, method in methods.items()
        }
    return results


def _figures(solution: Solution, value: float) -> dict[str, Any]:
    return {
        "ending": solution.ending.name,
        "objective": solution.objective,
        "relative_error": abs(solution.objective - value) / abs(value),
        "estimate": solution.errors.get("objective"),
        "iterations": solution.iterations,
        "intervals": solution.grid.intervals,
        "seconds": solution.seconds["solve"],
        "seconds_compile": solution.seconds["compile"],
    }


def orders(meshes: tuple[int, ...] = MESHES) -> dict[str, Any]:
    """Relative errors of the objective on finer and finer meshes, and the order they show."""
    results: dict[str, Any] = {}
    for name in SMOOTH:
        case = PROBLEMS[name]()
        for label, (kind, degree, order) in ORDERS.items():
            errors = []
            for mesh in meshes:
                method = DirectTranscription(
                    scheme=kind, degree=degree, mesh=mesh, refine=None, tolerance=TOLERANCE
                )
                solution = solve(case.problem, method, case.guess, simulate=False)
                errors.append(abs(solution.objective / case.value - 1))
            # The last meshes may have reached the solver's tolerance.
            shown = np.log2(np.array(errors[:-1]) / np.maximum(errors[1:], 1e-15))
            results[f"{name}, {label}"] = {
                "problem": name,
                "scheme": label,
                "theory": order,
                "tolerance": TOLERANCE,
                "intervals": list(meshes),
                "errors": errors,
                "orders": [float(v) for v in shown],
            }
    return results


def against_expressions(points: int = 1000) -> dict[str, Any]:
    """The same nonlinear program by dfsm and in CasADi expressions, one after the other.

    The fastest of three solves each, but for dfsm's first, which is one.

    dfsm a second time: with compiled code, from the start that it chooses itself and from its
    solution. CasADi a second time: with its functions as C code, where there is a compiler.
    """
    problem = turbine()
    method = DirectTranscription(scheme="trapezoidal", mesh=points - 1, refine=None, tolerance=1e-7)
    first = solve(problem, method, simulate=False)
    again = _fastest(problem, method)
    warm = _fastest(problem, method, first)
    other = solve_with_expressions(problem, points, repeats=REPEATS)
    in_c = None
    if which("gcc"):
        in_c = solve_with_expressions(problem, points, compiled=True, repeats=REPEATS)
    ours = again.seconds["solve"] / again.iterations
    theirs = other["seconds_solve"] / other["iterations"]
    return {
        "dfsm": _figures(first, other["objective"]),
        "dfsm, compiled": _figures(again, other["objective"]),
        "dfsm, warm start": _figures(warm, other["objective"]),
        "casadi": other,
        "casadi, compiled": in_c,
        "ms_per_iteration": {"dfsm": 1e3 * ours, "casadi": 1e3 * theirs},
        "casadi_over_dfsm": theirs / ours,
    }


def _fastest(
    problem: OptimalControlProblem, method: DirectTranscription, guess: Solution | None = None
) -> Solution:
    """Of several equal solves: other work on the machine only adds to their time."""
    solutions = [solve(problem, method, guess, simulate=False) for _ in range(REPEATS)]
    return min(solutions, key=lambda solution: solution.seconds["solve"])


def turbine_times(points: tuple[int, ...] = POINTS) -> dict[str, Any]:
    """Milliseconds per iteration of IPOPT, compilation left out, with the number of points."""
    problem, results = turbine(), {}
    for count in points:
        method = DirectTranscription(
            scheme="trapezoidal", mesh=count - 1, refine=None, tolerance=1e-7
        )
        fastest = _fastest(problem, method)
        results[str(count)] = {
            "ending": fastest.ending.name,
            "iterations": fastest.iterations,
            "ms_per_iteration": 1e3 * fastest.seconds["solve"] / fastest.iterations,
        }
    return results


# -- a stand-in for the floating turbine --------------------------------------------------------

# Ranges of torque (MN m), blade pitch (deg), wind (m/s), platform pitch (deg), speed (rpm), rates.
_LOW = np.array([0.0, -2.0, 3.0, -3.0, 1.0, -1.0, -0.5])
_HIGH = np.array([21.0, 25.0, 25.0, 9.0, 9.0, 1.0, 0.5])


def turbine() -> OptimalControlProblem:
    """Most power with little pitching in 600 s of unsteady wind, bounds as in the paper."""
    time = np.arange(0, 600.01, 0.05)
    wind = 12 + 2 * np.sin(0.03 * time) + 1.5 * np.sin(0.11 * time + 1) + 0.7 * np.sin(0.7 * time)
    return OptimalControlProblem(
        model=_turbine_model(),
        horizon=(0.0, 600.0),
        disturbances=Trajectory(time, wind[:, None], (Channel("wind", "m/s"),), name="wind"),
        cost=lambda s: -0.99 * s.u.torque * s.x.speed + 1e-5 * s.u.torque**2 + 0.5 * s.u.blade**2,
        bounds={
            "torque": (1.67, 19.9),
            "blade": (0.0, 22.6),
            "pitch": (0.0, 6.0),
            "speed": (1.9, 7.2),
        },
        name="turbine",
    )


def _turbine_model(units: int = 200) -> DFSM:
    rng = np.random.default_rng(0)
    winds = np.linspace(4, 24, 6)
    coefficients = np.zeros((len(winds), 4, 7))
    coefficients[:, 0, 5] = coefficients[:, 1, 6] = 1
    coefficients[:, 2] = [0.0, -0.01, 0.0, -0.04, -0.002, -0.08, 0.01]
    coefficients[:, 2, 2] = 0.0004 * winds
    coefficients[:, 3] = [-0.02, -0.06, 0.03, 0.001, -0.15, 0.02, -0.9]
    offsets = np.zeros((len(winds), 4))
    offsets[:, 2], offsets[:, 3] = 0.1, 0.03 * winds + 0.6
    middle, half = (_LOW + _HIGH) / 2, (_HIGH - _LOW) / 2
    region = Region(
        low=jnp.asarray(_LOW),
        high=jnp.asarray(_HIGH),
        mean=jnp.asarray(middle),
        std=jnp.asarray(half / 2),
        grid=jnp.asarray(winds),
        operating=jnp.asarray(np.tile(middle, (6, 1))),
    )
    return DFSM(
        f=LinearModel(jnp.asarray(winds), jnp.asarray(coefficients), jnp.asarray(offsets), 2),
        e=GaussianUnits(
            shift=jnp.asarray(middle),
            scale=jnp.asarray(1.5 * half),
            centres=jnp.asarray(rng.uniform(-0.6, 0.6, (7, units))),
            weights=jnp.asarray(2e-4 * rng.standard_normal((2, units))),
            bias=jnp.zeros(2),
        ),
        g=None,
        e_g=None,
        region=region,
        corrected=(2, 3),
        corrected_outputs=(),
        signals=SignalTable(
            states=(
                Channel("pitch", "deg"),
                Channel("speed", "rpm"),
                Channel("pitch_rate", "deg/s"),
                Channel("speed_rate", "rpm/s"),
            ),
            controls=(Channel("torque", "MN m"), Channel("blade", "deg")),
            disturbances=(Channel("wind", "m/s"),),
            parameters=(),
            outputs=(),
            specs=(StateSpec(name="pitch", order=2), StateSpec(name="speed", order=2)),
            derivatives=DerivativeSettings(),
        ),
    )

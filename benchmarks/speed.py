"""Times of fitting, simulating and importing, each as a ratio to a named reference.

Times are the best of several repetitions in one process, compiled code warm: the machine's noise
only ever adds. Ratios are taken between figures of the same run.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import cho_factor, cho_solve

import dfsm
from benchmarks.accuracy import demo
from dfsm.core.types import Array
from dfsm.fitting.linear import fit_linear
from dfsm.models.corrective import GaussianUnits
from dfsm.models.dfsm import DFSM

DATA = Path(__file__).parents[1] / "examples" / "iea15"
UNITS = 200


def run() -> dict[str, Any]:
    """All timings, in s."""
    runs = dfsm.read_all([str(DATA / "iea15_2dof_12mps_s0[1-8].parquet")])
    test = dfsm.read(DATA / "iea15_2dof_12mps_s09.outb")
    model = with_units(runs)
    return {
        "linear_fit": linear_fit(),
        "corrective": corrective(runs),
        "simulate": simulate(model, test),
        "start": start(),
    }


def best(function: Callable[[], Any], repetitions: int = 5) -> float:
    """Shortest of several calls in s, after one that warms up."""
    function()
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return min(times)


def linear_fit() -> dict[str, float]:
    """One million samples of 6 inputs and 4 derivatives, against two ways of NumPy and SciPy."""
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(1_000_000, 6)) * [1, 10, 100, 1, 0.1, 1e3] + [5, 0, 3, 1, 1, 1e3]
    targets = inputs @ rng.normal(size=(6, 4)) + rng.normal(size=(1_000_000, 4))
    names = [f"x{i}" for i in range(6)]
    ours = best(lambda: fit_linear([(inputs, targets)], names, dfsm.LTI()))
    # Theirs need a column of ones, which is not counted.
    affine = np.column_stack([inputs, np.ones(len(inputs))])
    theirs = best(lambda: np.linalg.lstsq(affine, targets, rcond=None), 3)
    normal = best(lambda: normal_equations(affine, targets))
    L = np.asarray(fit_linear([(inputs, targets)], names, dfsm.LTI()).model.coefficients[0])
    reference = np.linalg.lstsq(affine, targets, rcond=None)[0][:6].T
    scale = inputs.std(axis=0)
    largest = np.abs(reference * scale).max()
    return {
        "dfsm_s": ours,
        "lstsq_s": theirs,
        "times_faster": theirs / ours,
        "normal_equations_s": normal,
        "times_faster_than_normal_equations": normal / ours,
        "difference": float(np.abs((L - reference) * scale).max() / largest),
    }


def normal_equations(inputs: Array, targets: Array) -> Array:
    """Coefficients ``(input, target)`` by Cholesky's factors of the normal equations.

    Faster than orthogonal factors, and with half their digits.
    """
    return cho_solve(cho_factor(inputs.T @ inputs), inputs.T @ targets)


def corrective(runs: list[dfsm.Trajectory]) -> dict[str, float]:
    """Subsample and train both corrective functions of one region: 8 runs, 200 units each."""

    def build() -> float:
        # With the gate at zero no row is spared.
        choices = replace(_settings(), gate=0.0, nonlinear_only=False)
        seconds = dfsm.fit(runs, choices).seconds
        return seconds["corrective functions"] + seconds["outputs"]

    build()
    return {"units": UNITS, "both_functions_s": min(build() for _ in range(3)), "paper_s": 65.0}


def simulate(model: DFSM, run: dfsm.Trajectory) -> dict[str, float]:
    """600 s at 0.05 s with outputs: one run, the same by solve_ivp, and a hundred at once."""
    ours = best(lambda: dfsm.simulate(model, run, start=100.0))
    theirs = best(lambda: _solve_ivp(model, run), 1)
    many = [replace(run, name=str(i)) for i in range(100)]
    batch = best(lambda: dfsm.simulate(model, many, start=100.0), 3)
    simulator = dfsm.read(DATA / "iea15_2dof_12mps_s08.parquet").window(100.0).wall_time
    return {
        "one_run_s": ours,
        "solve_ivp_s": theirs,
        "times_faster_than_solve_ivp": theirs / ours,
        "hundred_runs_s": batch,
        "openfast_s": simulator or float("nan"),
        "times_faster_than_openfast": (simulator or float("nan")) / ours,
    }


def start() -> dict[str, float]:
    """Importing the package and printing the help of the command, in new processes."""

    def python(code: str) -> Callable[[], Any]:
        return lambda: subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)

    bare = best(python("pass"))
    help_code = "import sys; sys.argv = ['dfsm', '--help']; import dfsm.cli; dfsm.cli.main()"
    return {
        "import_s": best(python("import dfsm")) - bare,
        "import_and_model_s": best(python("import dfsm; dfsm.DFSM")) - bare,
        "help_s": best(python(help_code)),
    }


def _settings() -> dfsm.FitSettings:
    # The paper's network: one width for all inputs.
    recipe = dfsm.RBF(samples=UNITS, directions="equal")
    return replace(demo().settings(5), corrective=recipe)


def with_units(runs: list[dfsm.Trajectory]) -> DFSM:
    """An LPV model with corrective functions of 200 units for every fitted row.

    The fit may decide that a row needs none; here all are wanted. Their weights are made so small
    that the rollout stays that of the stable linear fit.
    """
    fitted = dfsm.fit(runs, _settings())
    if fitted.nonlinear is None:
        raise RuntimeError("the settings ask for the nonlinear-only model")

    def small(units: object, rows: list[int]) -> GaussianUnits:
        if not isinstance(units, GaussianUnits):
            raise TypeError(f"expected Gaussian units, got {type(units).__name__}")
        kept = units.select(rows)
        return replace(kept, weights=1e-6 * kept.weights, bias=jnp.zeros(len(rows)))

    return replace(
        fitted.model,
        e=small(fitted.nonlinear.e, [2, 3]),
        corrected=(2, 3),
        e_g=small(fitted.nonlinear.e_g, [0, 1, 2]),
        corrected_outputs=(0, 1, 2),
    )


def _solve_ivp(model: DFSM, run: dfsm.Trajectory) -> None:
    """The same right-hand side, compiled, under SciPy's RK45 with the same largest step."""
    driven = run.window(100.0)
    u = driven.select(model.signals.names("controls")).values
    w = driven.select(model.signals.names("disturbances")).values
    slope = jax.jit(lambda x, u, w: model.derivative(x, u, w))
    x0 = np.asarray(dfsm.simulate(model, run, start=100.0, stop=101.0).trajectory.values[0, :4])

    def f(t: float, x: np.ndarray) -> np.ndarray:
        row = (t - driven.time[0]) / 0.05
        i = min(int(row), len(u) - 2)
        a = row - i
        v = [(1 - a) * s[i] + a * s[i + 1] for s in (u, w)]
        return np.asarray(slope(x, *v))

    span = (float(driven.time[0]), float(driven.time[-1]))
    solve_ivp(f, span, x0, max_step=0.05, t_eval=driven.time)

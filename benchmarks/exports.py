"""What one Runge-Kutta step of an exported model costs: two masses, 200 Gaussian units at most."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi
import numpy as np

import dfsm

_STEPS = 2000
_LOOP = """#include "chain.h"
void many(int n, double h, double *x, const double *u) {
  while (n-- > 0) chain_step(h, x, u, 0, u, 0, 0, x);
}
"""


def run() -> dict[str, Any]:
    """Microseconds per step of RK4, the same steps everywhere, and the largest difference."""
    chain = dfsm.mass_chain(2)
    times = np.arange(0, 60.05, 0.1)
    inputs = np.stack([np.sin(a * times) for a in (0.7, 1.9)], axis=1)
    run = chain.simulate(times, [0.0] * 4, inputs)
    names = [c.name for c in chain.states]
    settings = dfsm.FitSettings(
        states=tuple(dfsm.StateSpec(name=n) for n in names),
        controls=("u1", "u2"),
        corrective=dfsm.RBF(samples=200),
        nonlinear_only=False,
    )
    model = dfsm.fit([run], settings).model
    held = dfsm.Trajectory(
        0.01 * np.arange(_STEPS + 1), np.full((_STEPS + 1, 2), 0.1), chain.controls, name="held"
    )
    start = np.array([0.1, -0.1, 0.0, 0.0])
    path, seconds = _timed(lambda: dfsm.simulate(model, held, initial=start))
    figures: dict[str, Any] = {"JAX, dfsm.simulate": 1e6 * seconds / _STEPS}
    reference = path.trajectory.select(names).values[-1]
    apart = dict[str, float]()

    def told(name: str, call: Callable[[], Any]) -> None:
        last, seconds = _timed(call)
        figures[name] = 1e6 * seconds / _STEPS
        apart[name] = float(np.abs(np.asarray(last).ravel() - reference).max())

    f = dfsm.to_casadi(model).f
    told("CasADi, mapaccum", _casadi(f, start))
    with tempfile.TemporaryDirectory() as folder:
        dfsm.write_python(model, Path(folder) / "light")
        space: dict[str, Any] = {"__name__": "run_model"}
        exec((Path(folder) / "light" / "run_model.py").read_text(), space)
        light = space["Model"](Path(folder) / "light" / "model.npz")
        rows = held.values
        told(
            "NumPy, run_model.py",
            lambda: light.simulate(held.time, start, rows, np.zeros((len(rows), 0)))[0][-1],
        )
        if shutil.which("cc"):
            told("C, -O2", _c(model, Path(folder), start))
    return {"microseconds per step": figures, "difference after 20 s": apart}


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """The result, and the shortest of three calls after one that warms up."""
    result, seconds = call(), list[float]()
    for _ in range(3):
        begin = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begin)
    return result, min(seconds)


def _casadi(f: Any, start: np.ndarray) -> Callable[[], Any]:
    x, u, h = casadi.MX.sym("x", 4), casadi.MX.sym("u", 2), 0.01
    none = casadi.MX(0, 1)
    k1 = f(x, u, none, none)
    k2 = f(x + h / 2 * k1, u, none, none)
    k3 = f(x + h / 2 * k2, u, none, none)
    k4 = f(x + h * k3, u, none, none)
    step = casadi.Function("step", [x, u], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    whole, inputs = step.mapaccum(_STEPS), casadi.DM.ones(2, _STEPS) * 0.1
    return lambda: whole(start, inputs)[:, -1].full()


def _c(model: dfsm.DFSM, folder: Path, start: np.ndarray) -> Callable[[], Any]:
    dfsm.write_c(model, folder / "chain")
    (folder / "chain" / "loop.c").write_text(_LOOP)
    command = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", "chain.so", "chain.c", "loop.c"]
    subprocess.run([*command, "-lm"], cwd=folder / "chain", check=True)
    library, controls = ctypes.CDLL(str(folder / "chain" / "chain.so")), np.full(2, 0.1)

    def call() -> np.ndarray:
        x = start.copy()
        pointers = (x.ctypes.data_as(ctypes.c_void_p), controls.ctypes.data_as(ctypes.c_void_p))
        library.many(_STEPS, ctypes.c_double(0.01), *pointers)
        return x

    return call

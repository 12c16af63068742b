"""An optimal control problem on a surrogate, solved by dfsm and by dymos with the same model.

A hardening spring is moved from 1 m to rest at 0 m in 4 s at the least ∫ (q² + u²/10) dt, with a
bounded force. dymos takes `DFSMComp`, so both optimize the same function with exact derivatives.
OpenMDAO and dymos are used where they are installed; else they and dfsm are installed into an
environment of their own.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
import venv
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import dfsm

ROOT = Path(__file__).parents[1]
ENVIRONMENT = ROOT / "build" / "dymos"
REQUIREMENTS = ("openmdao>=3.39", "dymos>=1.14")
HORIZON, LIMIT, SEGMENTS = 4.0, 0.8, 20


def run() -> dict[str, Any]:
    """Both optima: objective, time to solve, largest difference of the force between them."""
    if find_spec("dymos") is None:
        return elsewhere()
    model = surrogate()
    ours, seconds = by_dfsm(model)
    theirs = by_dymos(model)
    mesh = np.linspace(0, HORIZON, 81)
    forces = [
        np.interp(mesh, ours.trajectory.time, ours.trajectory["u"]),
        np.interp(mesh, theirs["time"], theirs["u"]),
    ]
    return {
        "dfsm": {"objective": ours.objective, "solve_s": seconds, "solved": ours.solved},
        "dymos": {key: theirs[key] for key in ("objective", "solve_s", "solved")},
        "relative_difference": theirs["objective"] / ours.objective - 1,
        "largest_difference_of_the_force": float(np.abs(forces[0] - forces[1]).max()),
        "dymos_force_between_nodes": float(np.abs(theirs["u"]).max()),
    }


def surrogate() -> dfsm.DFSM:
    """Fitted to eight runs of the spring, with a correction for what is not linear."""

    def f(x: Any, u: Any, w: Any, p: Any) -> Any:  # noqa: ARG001
        return jnp.array([x[1], u[0] - x[0] - x[0] ** 3 - 0.3 * x[1]])

    spring = dfsm.ODESystem(
        f,
        states=(dfsm.Channel("q", "m"), dfsm.Channel("v", "m/s")),
        controls=(dfsm.Channel("u", "N"),),
    )
    mesh = np.arange(0, 20.01, 0.05)
    rng = np.random.default_rng(0)
    runs = []
    for _ in range(8):
        tones, phases = rng.uniform(0.3, 3, 4), rng.uniform(0, 6, 4)
        force = np.sum([np.sin(w * mesh + a) for w, a in zip(tones, phases, strict=True)], axis=0)
        runs.append(spring.simulate(mesh, rng.uniform(-1, 1, 2), force[:, None]))
    settings = dfsm.FitSettings(
        states=(dfsm.StateSpec(name="q", order=2, rate="v"),),
        controls=("u",),
        corrective=dfsm.RBF(samples=100),
        nonlinear_only=False,
    )
    return dfsm.fit(runs, settings).model


def by_dfsm(model: dfsm.DFSM) -> tuple[dfsm.Solution, float]:
    """Radau collocation, with refinement."""
    states = [c.name for c in model.signals.states]
    problem = dfsm.OptimalControlProblem(
        model=model,
        horizon=(0.0, HORIZON),
        cost=lambda s: s.x.q**2 + s.u.u**2 / 10,
        bounds={"u": (-LIMIT, LIMIT)},
        initial=dict(zip(states, (1.0, 0.0), strict=True)),
        final=dict(zip(states, (0.0, 0.0), strict=True)),
        name="spring",
    )
    begin = time.perf_counter()
    solution = dfsm.solve(problem, dfsm.DirectTranscription(scheme="radau"))
    return solution, time.perf_counter() - begin


def by_dymos(model: dfsm.DFSM) -> dict[str, Any]:
    """Radau transcription and SLSQP, with exact partial derivatives."""
    import dymos  # pyright: ignore[reportMissingImports]
    import openmdao.api as om  # pyright: ignore[reportMissingImports]

    from dfsm.exports.openmdao_component import DFSMComp, variables_of

    q, v = (c.name for c in model.signals.states)
    named = variables_of(model)

    class Equations(om.Group):
        """The model, and what the cost integrates."""

        def initialize(self) -> None:
            self.options.declare("num_nodes", types=int)

        def setup(self) -> None:
            nodes = self.options["num_nodes"]
            plant = DFSMComp(model=model, num_nodes=nodes)
            self.add_subsystem("plant", plant, promotes=["*"])
            shape = {"shape": (nodes,)}
            cost = om.ExecComp(
                "L = q**2 + u**2 / 10", L=shape, q=shape, u=shape, has_diag_partials=True
            )
            inputs = [("q", named[q]), ("u", named["u"])]
            self.add_subsystem("cost", cost, promotes_inputs=inputs, promotes_outputs=["L"])
            self.set_input_defaults(named[q], val=np.zeros(nodes), units="m")
            self.set_input_defaults(named["u"], val=np.zeros(nodes), units="N")

    phase = dymos.Phase(ode_class=Equations, transcription=dymos.Radau(num_segments=SEGMENTS))
    phase.set_time_options(fix_initial=True, fix_duration=True, units="s")
    for name, unit in ((q, "m"), (v, "m/s")):
        rate, target = named[f"d {name}/dt"], named[name]
        phase.add_state(target, rate_source=rate, targets=[target], units=unit,
                        fix_initial=True, fix_final=True)  # fmt: skip
    phase.add_state("J", rate_source="L", units=None, fix_initial=True)
    # The optimum leaves its bound with a kink, which dymos would forbid between segments.
    phase.add_control(named["u"], targets=[named["u"]], units="N", lower=-LIMIT, upper=LIMIT,
                      rate_continuity=False)  # fmt: skip
    phase.add_objective("J", loc="final")
    problem = om.Problem(reports=False)
    trajectory = dymos.Trajectory()
    trajectory.add_phase("move", phase)
    problem.model.add_subsystem("all", trajectory)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=1e-9, maxiter=400, disp=False)
    problem.driver.declare_coloring(show_summary=False)
    problem.setup()
    phase.set_time_val(initial=0.0, duration=HORIZON)
    phase.set_state_val(named[q], [1.0, 0.0])
    phase.set_state_val(named[v], [0.0, 0.0])
    phase.set_state_val("J", [0.0, 0.5])
    phase.set_control_val(named["u"], [0.0, 0.0])
    begin = time.perf_counter()
    failed = dymos.run_problem(problem, run_driver=True, simulate=False, make_plots=False)
    at = "all.move.timeseries."
    return {
        "objective": float(problem.get_val(at + "J")[-1, 0]),
        "solve_s": time.perf_counter() - begin,
        "solved": bool(getattr(failed, "success", not failed)),
        "time": problem.get_val(at + "time").ravel(),
        "u": problem.get_val(at + named["u"]).ravel(),
    }


def elsewhere() -> dict[str, Any]:
    """Run this in an environment of its own, which is made if it is not there."""
    python = ENVIRONMENT / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    if not python.exists():
        venv.create(ENVIRONMENT, with_pip=True)
    # Standard output is for the figures.
    install = [python, "-m", "pip", "install", "--quiet", *REQUIREMENTS, str(ROOT)]
    subprocess.run(install, check=True, stdout=sys.stderr)
    code = f"import sys, json; sys.path.insert(0, {str(ROOT)!r}); "
    code += "from benchmarks import dymos_peer; print(json.dumps(dymos_peer.run()))"
    with tempfile.TemporaryDirectory() as folder:  # OpenMDAO leaves folders where it runs
        command = [python, "-c", code]
        done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])

"""A cart that is pushed by a force and by wind: the problem of the tests of optimal control."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from dfsm.control import DirectTranscription, OptimalControlProblem, Solution, solve
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.simulators import ODESystem

# A cart with drag, pushed by a force and by wind, with its mass as a parameter.
CART = ODESystem(
    f=lambda x, u, w, p: jnp.stack([x[1], (u[0] + w[0] - 0.3 * x[1]) / p[0]]),
    states=(Channel("place", "m"), Channel("speed", "m/s")),
    controls=(Channel("force", "N"),),
    disturbances=(Channel("wind", "N"),),
    parameters=(Channel("mass", "kg"),),
    outputs=(Channel("power", "W"),),
    g=lambda x, u, w, p: jnp.stack([u[0] * x[1]]),
    name="cart",
)
TIME = np.linspace(0, 10, 101)


def wind(size: float = 0.2, stop: float = 10.0, name: str = "wind") -> Trajectory:
    time = np.linspace(0, stop, 101)
    return Trajectory(time, size * np.sin(time)[:, None], (Channel("wind", "N"),), name=name)


def effort(s):
    return s.u.force**2


def problem(**changes) -> OptimalControlProblem:
    """Move the cart by 4 m in 5 s with little force."""
    fields = {
        "model": CART,
        "horizon": (0.0, 5.0),
        "initial": {"place": 0.0, "speed": 0.0},
        "final": {"place": 4.0, "speed": 0.0},
        "cost": effort,
        "parameters": {"mass": 2.0},
        "disturbances": wind(),
        "name": "cart",
    }
    return OptimalControlProblem(**(fields | changes))


QUICK = DirectTranscription(mesh=20, refine=None)


def solved(problem: OptimalControlProblem, method=QUICK, **options) -> Solution:
    solution = solve(problem, method, simulate=options.pop("simulate", False), **options)
    assert solution.solved, solution.message
    return solution

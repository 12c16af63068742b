"""Twelve optimal control problems with known answers, to measure accuracy and convergence.

The optimal values of the first eight are analytic; the others are what two fine Radau meshes
agree on, to the last digit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from dfsm.control import OptimalControlProblem
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.simulators import ODESystem, two_link_robot


@dataclass(frozen=True)
class Known:
    """A problem and its optimal value.

    Attributes
    ----------
    problem
        What to solve.
    value
        The optimal objective.
    guess
        Straight lines between two samples, where the ends do not give them.
    """

    problem: OptimalControlProblem
    value: float
    guess: Trajectory | None = None


def system(name: str, f: Callable[..., Any], states: int, controls: int = 1) -> ODESystem:
    """An autonomous system f(x, u) with channels x1, x2, …, u1, …, without units."""
    return ODESystem(
        f=lambda x, u, _w, _p: jnp.stack(f(x, u)),
        states=channels("x", states),
        controls=channels("u", controls),
        name=name,
    )


def channels(letter: str, count: int) -> tuple[Channel, ...]:
    """Channels x1, x2, … without a unit."""
    return tuple(Channel(f"{letter}{i + 1}", "-") for i in range(count))


def ends(values: Sequence[float | None]) -> dict[str, float]:
    """Values of x1, x2, … at one end of the horizon; None leaves a state free."""
    return {f"x{i + 1}": v for i, v in enumerate(values) if v is not None}


def hager_hou_rao_1() -> Known:
    """A nonlinear problem with a singular-looking denominator."""
    model = system(
        "HagerHouRao1",
        lambda x, u: [
            x[0] + u[0] / x[1] + x[0] * x[1] * u[1],
            -x[1] * (0.5 + x[1] * u[1]),
        ],
        2,
        2,
    )
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 1.0),
        initial=ends([1.0, 1.0]),
        cost=lambda s: (
            2 * (s.x.x1 * s.x.x2) ** 2 + 1.25 / s.x.x2**2 + s.u.u2 / s.x.x2 + s.u.u1**2 + s.u.u2**2
        ),
        name=model.name,
    )
    return Known(problem, 2.489923151493991)


def nonlinear_1d() -> Known:
    """A square root in the dynamics, and a boundary layer at either end."""
    model = system("Nonlinear1D", lambda x, u: [2 * x[0] + 2 * u[0] * jnp.sqrt(x[0])], 1)
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 5.0),
        initial={"x1": 2.0},
        final={"x1": 1.0},
        bounds={"x1": (0.0, None)},
        cost=lambda s: (s.u.u1**2 + s.x.x1) / 2,
        name=model.name,
    )
    return Known(problem, 2.617926098738792)


def bryson_ho_59() -> Known:
    """Steering for the largest final speed."""
    model = system("BrysonHo59", lambda x, u: [jnp.cos(u[0]), jnp.sin(u[0]), x[0], x[1]], 4)
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 2.05),
        initial=ends([0.0, 0.0, 0.0, 0.0]),
        final=ends([None, 0.0, None, 1.0]),
        bounds={"x4": (0.0, None), "u1": (-np.pi, np.pi)},
        final_cost=lambda _start, end: -end.x.x1,
        name=model.name,
    )
    return Known(problem, -0.8047832094009657)


def bryson_ho_64() -> Known:
    """A soap film between two rings."""
    model = system("BrysonHo64", lambda _x, u: [u[0]], 1)
    problem = OptimalControlProblem(
        model=model,
        horizon=(-0.45, 0.45),
        initial={"x1": 1.0},
        final={"x1": 1.0},
        bounds={"x1": (0.0, None)},
        cost=lambda s: 2 * jnp.pi * s.x.x1 * jnp.sqrt(1 + s.u.u1**2),
        name=model.name,
    )
    return Known(problem, 5.447546440401256)


def brachistochrone() -> Known:
    """The curve of fastest descent, with a free final time."""
    model = system(
        "Brachistochrone",
        lambda x, u: [x[2] * jnp.sin(u[0]), x[2] * jnp.cos(u[0]), 10 * jnp.cos(u[0])],
        3,
    )
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, (0.01, 200.0)),
        initial=ends([0.0, 0.0, 0.0]),
        final=ends([2.0, 2.0]),
        final_cost=lambda _start, end: end.t,
        name=model.name,
    )
    # The ends do not tell the straight line of the speed; at rest the angle would have no effect.
    line = Trajectory(
        np.array([0.0, 1.0]),
        np.array([[0, 0, 0, 0.5], [2, 2, 5, 0.5]]),
        (*channels("x", 3), *channels("u", 1)),
    )
    return Known(problem, 0.8164698961603185, guess=line)


def neuenhofen_kerrigan() -> Known:
    """A state constraint and a control bound that are active one after the other."""
    model = system(
        "NeuenhofenKerriganX2", lambda x, u: [u[0] / (2 * x[0]), 4 * x[0] ** 4 + u[0] ** 2], 2
    )
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 1.0),
        initial=ends([1.0, 0.0]),
        bounds={"u1": (-1.0, None), "x1": (float(np.sqrt(0.4)), None)},
        final_cost=lambda _start, end: end.x.x2,
        name=model.name,
    )
    return Known(problem, 2.0578660)


def bryson_denham() -> Known:
    """A state constraint of second order."""
    model = system("BrysonDenham", lambda x, u: [x[1], u[0]], 2)
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 1.0),
        initial=ends([0.0, 1.0]),
        final=ends([0.0, -1.0]),
        bounds={"x1": (None, 1 / 9)},
        cost=lambda s: s.u.u1**2 / 2,
        name=model.name,
    )
    return Known(problem, 4.0)


def hager_1() -> Known:
    """Linear-quadratic."""
    model = system("Hager1", lambda x, u: [x[0] / 2 + u[0]], 1)
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 1.0),
        initial={"x1": 1.0},
        cost=lambda s: s.u.u1**2 + s.x.x1 * s.u.u1 + 1.25 * s.x.x1**2,
        name=model.name,
    )
    return Known(problem, float(np.tanh(1.0)))


def vanderpol() -> Known:
    """An oscillator with a bounded force."""
    model = system("Vanderpol", lambda x, u: [x[1], -x[0] + x[1] - x[0] ** 2 * x[1] + u[0]], 2)
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 5.0),
        initial=ends([1.0, 0.0]),
        bounds={"u1": (-0.3, 1.0)},
        cost=lambda s: s.x.x1**2 + s.x.x2**2 + s.u.u1**2,
        name=model.name,
    )
    return Known(problem, 2.867261)


_ROBOT_START = {"omega1": 0.0, "omega2": 0.0, "theta2": 0.5, "theta1": 0.0}
_ROBOT_END = _ROBOT_START | {"theta1": 0.522}
_ROBOT_BOUNDS = {"tau1": (-1.0, 1.0), "tau2": (-1.0, 1.0)}


def robot_energy() -> Known:
    """The two-link robot with the least effort."""
    problem = OptimalControlProblem(
        model=two_link_robot(),
        horizon=(0.0, 3.0),
        initial=_ROBOT_START,
        final=_ROBOT_END,
        bounds=_ROBOT_BOUNDS,
        cost=lambda s: s.u.tau1**2 + s.u.tau2**2,
        name="TwoLinkRobot, energy",
    )
    return Known(problem, 5.2337355)


def robot_time() -> Known:
    """The two-link robot in the shortest time; the torques switch between their bounds."""
    problem = OptimalControlProblem(
        model=two_link_robot(),
        horizon=(0.0, (1.0, 10.0)),
        initial=_ROBOT_START,
        final=_ROBOT_END,
        bounds=_ROBOT_BOUNDS,
        final_cost=lambda _start, end: end.t,
        name="TwoLinkRobot, time",
    )
    return Known(problem, 2.98228)


def container_crane() -> Known:
    """Moving a container without swinging, speeds and forces bounded."""

    def f(x: Any, u: Any) -> list[Any]:
        swing = u[0] + 27.0756 * x[2] + 2 * x[4] * x[5]
        return [x[3], x[4], x[5], u[0] + 17.2656 * x[2], u[1], -swing / x[1]]

    model = system("ContainerCrane", f, 6, 2)
    problem = OptimalControlProblem(
        model=model,
        horizon=(0.0, 9.0),
        initial=ends([0.0, 22.0, 0.0, 0.0, -1.0, 0.0]),
        final=ends([10.0, 14.0, 0.0, 2.5, 0.0, 0.0]),
        bounds={
            "x4": (-2.5, 2.5),
            "x5": (-1.0, 1.0),
            "u1": (-2.8337, 2.8337),
            "u2": (-0.80865, 0.71265),
        },
        cost=lambda s: 0.5 * (s.x.x3**2 + s.x.x6**2 + 0.01 * (s.u.u1**2 + s.u.u2**2)),
        name=model.name,
    )
    return Known(problem, 0.03751946)


PROBLEMS: dict[str, Callable[[], Known]] = {
    "HagerHouRao1": hager_hou_rao_1,
    "Nonlinear1D": nonlinear_1d,
    "BrysonHo59": bryson_ho_59,
    "BrysonHo64": bryson_ho_64,
    "Brachistochrone": brachistochrone,
    "NeuenhofenKerriganX2": neuenhofen_kerrigan,
    "BrysonDenham": bryson_denham,
    "Hager1": hager_1,
    "Vanderpol": vanderpol,
    "TwoLinkRobot, energy": robot_energy,
    "TwoLinkRobot, time": robot_time,
    "ContainerCrane": container_crane,
}

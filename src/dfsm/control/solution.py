"""Solution: optimal trajectories, what they cost, how the solver ended, and what to do then."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dfsm.control.mesh.grid import Grid
from dfsm.core.drawing import Drawn, Engine, draw
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import printable

# Before the name of a control in `Solution.bounds`: bounds of its rate.
RATE = "rate of "
# Scaled optimality conditions that hold to this count as held, or to the tolerance if that is more.
HELD = 1e-6
# What helps whatever keeps errors above those asked for.
_LOOSEN = "loosen refine"


class Ending(enum.Enum):
    """How a solve ended; the value says what it means and what to do.

    What to do about `COARSE` depends on why no finer mesh helped: `Solution.message` says it.
    """

    SOLVED = "solved"
    ACCEPTABLE = (
        "solved to a looser tolerance than asked, because no step improved it: check the scaling "
        "of bounds and costs, or loosen tolerance"
    )
    STALLED = (
        "solved as far as the steps went, which became too small: check the scaling of bounds and "
        "costs, or loosen tolerance"
    )
    INACCURATE = (
        "not solved, and no step improved it: replace kinks in costs and constraints by smooth "
        "functions, check the scaling of bounds and costs, or start from another guess"
    )
    COARSE = (
        "the optimality conditions hold on the last mesh, whose errors between the nodes are still "
        "above what was asked"
    )
    CHATTERING = (
        "not solved, a control jumps to and fro from node to node where the cost cannot tell it "
        "from its mean (a singular arc): use scheme radau, or add a small cost on the control"
    )
    INFEASIBLE = (
        "no feasible point was found: the constraints named here conflict, widen one of them or "
        "start from another guess"
    )
    LIMIT = (
        "the iteration limit was reached, this is the best iterate: raise most_iterations, or "
        "start from a better guess"
    )
    TIME = (
        "the time limit was reached, this is the best iterate: raise most_seconds, or solve again "
        "with it as guess"
    )
    UNBOUNDED = (
        "the objective falls without limit: bound the variables named here, or correct the sign of "
        "the cost"
    )
    INTERRUPTED = "interrupted, this is the best iterate so far: solve again with it as guess"
    NOT_FINITE = (
        "a function became NaN or infinite and the solver could not avoid it: bound the variables "
        "so that the function is defined wherever they may go"
    )
    FAILED = (
        "the solver gave up: start from a better guess, scale costs to the order of one, or try "
        "another scheme"
    )

    @property
    def solved(self) -> bool:
        """Whether the optimality conditions hold, and all errors meet what was asked.

        `COARSE` is none: errors between the nodes are above `refine`. `ACCEPTABLE` and `STALLED`
        are only told where the conditions were measured and hold to 1e-6, or to the tolerance if
        that is looser; else the ending is `INACCURATE`.
        """
        return self in (Ending.SOLVED, Ending.ACCEPTABLE, Ending.STALLED)


@dataclass(frozen=True)
class Optimality:
    """How well the optimality conditions of the scaled nonlinear program hold; 0 is exactly.

    Attributes
    ----------
    stationarity
        Largest slope of the Lagrangian, relative to that of the objective where it is above 1.
    violation
        Largest violation of a constraint or bound, relative to its size.
    complementarity
        Largest product of a multiplier and the distance to its limit, relative as the slope.
    """

    stationarity: float
    violation: float
    complementarity: float

    @property
    def worst(self) -> float:
        """The largest of the three; NaN where one is."""
        return float(np.max([self.stationarity, self.violation, self.complementarity]))

    def held(self, tolerance: float) -> bool:
        """Whether all three hold to 1e-6, or to the tolerance if that is looser."""
        return self.worst <= max(HELD, tolerance)


@dataclass(frozen=True)
class Replay:
    """The optimal controls in an adaptive integrator, from the optimal initial state.

    Attributes
    ----------
    trajectory
        States at the nodes.
    deviation
        Largest difference to the solution's states, by name, in their units.
    relative
        The largest of them relative to the largest value of its state.
    """

    trajectory: Trajectory
    deviation: Mapping[str, float]
    relative: float


@dataclass(frozen=True, eq=False)
class Solution(Drawn):
    """Optimal trajectories, or the best that a solve came to.

    Attributes
    ----------
    name
        Of the problem.
    ending
        How the solver ended.
    reason
        For a solve that did not succeed: the worst constraint by name and time, and the bounds
        that hold it; for one that ended before its tolerance was met: how well the conditions
        hold; else "".
    objective, final_cost, integral_cost
        M + ∫ L dt and its two parts, weighted over the scenarios.
    trajectories
        Per scenario: states, controls, disturbances, parameters and outputs at the nodes, with
        units and roles. The last time is the optimal one.
    costates
        Per scenario: multipliers of the dynamics, ∂J/∂ξ, in the objective's unit per unit of each
        state. Direct transcription has none for latent states that disturbances alone drive.
    multipliers
        Of path and boundary constraints by name, shape ``(scenario × time,)``, in the
        objective's unit per unit of the constraint.
    parameters
        All plant parameters, optimized or not.
    grid
        The mesh and its scheme.
    error
        Largest relative local error of the dynamics of an interval, as in `errors`.
    meshes
        Per mesh tried: ``intervals``, ``objective``, ``error``, ``errors``, ``iterations``.
    iterations
        Of the solver, on all meshes together.
    seconds
        ``compile`` and ``solve``.
    linear_quadratic
        Whether the problem was recognised as linear-quadratic and solved as such.
    violation
        Largest violation of a constraint at the nodes, relative to its size.
    outside
        Share of the horizon with any input outside the training range; None without a surrogate.
    departures
        Per scenario that leaves it, which signals do, how far, when first and how long.
    replays
        Per scenario, see `Replay`; empty where it was not asked for.
    bounds
        By name of the states, controls and outputs that have any: lower and upper bounds at the
        nodes, shape ``(2, time)``, infinite where there is none; those of a control's rate as
        ``"rate of …"``.
    solver_state
        Scaled multipliers, to start the same mesh warm.
    optimality
        How well the optimality conditions hold at the result; None for a solution saved by a
        version that did not measure it.
    errors
        Estimated errors between the nodes by name, all relative: ``dynamics``, the worst interval's
        ∫ |ẋ − f| dt over the size of a state; ``cost``, what the quadrature misses of ∫ L dt, over
        ∫ |L| dt + |M|; ``constraints``, the largest excess over a limit, over its size (that
        of a limit on controls, which may jump, is integrated over normalised time); ``objective``,
        how far the objective is from the optimum, which these three make, over the same as the
        cost (NaN for shooting, whose controls stay linear between the nodes of a mesh that nothing
        refines for their sake). Empty for a solution of an earlier version, whose shooting has NaN.
    """

    name: str
    ending: Ending
    reason: str
    objective: float
    final_cost: float
    integral_cost: float
    trajectories: tuple[Trajectory, ...]
    costates: tuple[Trajectory, ...]
    multipliers: Mapping[str, Array]
    parameters: Mapping[str, float]
    grid: Grid
    error: float
    meshes: tuple[Mapping[str, Any], ...]
    iterations: int
    seconds: Mapping[str, float]
    linear_quadratic: bool
    violation: float
    outside: float | None
    replays: tuple[Replay, ...] = ()
    bounds: Mapping[str, Array] = field(default_factory=dict)
    solver_state: Array = field(default_factory=lambda: np.empty(0))
    optimality: Optimality | None = None
    errors: Mapping[str, float] = field(default_factory=dict)
    departures: tuple[str, ...] = ()

    def __repr__(self) -> str:
        t = self.trajectory
        return (
            f"<Solution of {printable(self.name)}: {self.ending.name.lower().replace('_', ' ')}, "
            f"objective {self.objective:.8g}, {t.time[0]:g} to {t.time[-1]:g} s, "
            f"{self.grid.intervals} intervals, {self.iterations} iterations>"
        )

    @property
    def trajectory(self) -> Trajectory:
        """The first scenario's trajectory."""
        return self.trajectories[0]

    @property
    def solved(self) -> bool:
        """Whether the optimality conditions hold, and all errors meet what was asked."""
        return self.ending.solved

    @property
    def message(self) -> str:
        """One sentence on the outcome."""
        text = f"{self.reason}; {self.ending.value}" if self.reason else self.ending.value
        # The reason says what to do where more meshes would not have helped.
        more = self.ending is Ending.COARSE and _LOOSEN not in self.reason
        return f"{text}: raise most_refinements, or {_LOOSEN}" if more else text

    def at(self, tau: Array, scenario: int = 0) -> tuple[Array, Array]:
        """States and controls between the nodes, by the scheme's polynomials.

        Parameters
        ----------
        tau
            Normalised times from 0 to 1, shape ``(time,)``.
        scenario
            Which one.

        Returns
        -------
        tuple of ndarray
            Shapes ``(time, state)`` and ``(time, control)``.
        """
        run = self.trajectories[scenario]
        X, U = (
            run.select(c.name for c in run.channels if c.role == role).values
            for role in ("state", "control")
        )
        return self.grid.states(X, tau), self.grid.controls(U, tau)

    def plot(
        self,
        channels: Sequence[str] | None = None,
        *,
        scenario: int = 0,
        engine: Engine = "plotly",
    ) -> Any:
        """Draw one scenario: disturbances, controls, states, outputs and their bounds.

        Parameters
        ----------
        channels
            Names to draw, in this order; None takes all but the parameters.
        scenario
            Which one.
        engine
            "plotly" for the screen, "matplotlib" for print (needs ``dfsm[figures]``).

        Returns
        -------
        plotly.graph_objects.Figure or matplotlib.figure.Figure
            To show, change or save.

        Raises
        ------
        DfsmError
            There is no such channel, scenario or engine, or Matplotlib is not installed.
        """
        return draw(self, channels, engine, scenario=scenario)

    def summary(self) -> str:
        """Describe the outcome in a few lines."""
        span = self.trajectory
        lines = [
            f"{self.name}: {self.message}",
            f"objective {self.objective:.10g} (final cost {self.final_cost:.6g}, integral "
            f"{self.integral_cost:.6g}), {span.time[0]:g} to {span.time[-1]:.8g} s",
            f"{self.grid.kind}, {self.grid.intervals} intervals, local error {self.error:.2g}, "
            f"largest violation {self.violation:.2g}",
            *self._between(),
            f"{self.iterations} iterations, {self.seconds['compile']:.2f} s to compile, "
            f"{self.seconds['solve']:.2f} s to solve"
            + (", linear-quadratic" if self.linear_quadratic else ""),
        ]
        if self.optimality is not None:
            held = self.optimality
            lines.append(
                f"optimality conditions hold to {held.worst:.2g}: stationarity "
                f"{held.stationarity:.2g}, violation {held.violation:.2g}, complementarity "
                f"{held.complementarity:.2g}"
            )
        for mesh in self.meshes if len(self.meshes) > 1 else ():
            lines.append(
                f"  {mesh['intervals']} intervals: objective {mesh['objective']:.10g}, local error "
                f"{mesh['error']:.2g}, {mesh['iterations']} iterations"
            )
        if self.parameters:
            lines.append("parameters: " + _listed(self.parameters))
        for k, replay in enumerate(self.replays):
            where = f" of scenario {k + 1}" if len(self.replays) > 1 else ""
            lines.append(
                f"simulated{where}, the states differ by at most {_listed(replay.deviation)}"
            )
        lines += self.outside_told()
        return "\n".join(lines)

    def outside_told(self) -> list[str]:
        """How long the optimum is outside the training range, and where; empty without a surrogate.

        Outside, the model may promise what the system does not do.
        """
        if self.outside is None:
            return []
        lines = [f"{self.outside:.1%} of the horizon outside the training range"]
        if self.departures:
            lines += [f"  {text}" for text in self.departures]
            lines.append(
                "  there the model may promise what the system does not do; stay_inside keeps "
                "controls and states near the training data"
            )
        return lines

    def _between(self) -> list[str]:
        """What is known of the errors between the nodes."""
        told = {k: v for k, v in self.errors.items() if np.isfinite(v)}
        return [f"errors between the nodes: {_listed(told)}"] if told else []


def _listed(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())

"""Direct transcription: states and controls at the nodes of a mesh are the variables of an NLP.

    minimise M + T Σ bᵢ L(τᵢ)     subject to     D X − T A F(X, U) = 0  in every interval

and path constraints at the nodes, boundary constraints and rates of controls (Sec. 4; Betts 2010,
Ch. 4). Which scheme it is only enters through the matrices of the `Grid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.mesh.grid import Grid, grid_of
from dfsm.control.mesh.schemes import Kind
from dfsm.control.nlp import constraints
from dfsm.control.nlp.estimate import Estimate, estimate_of
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.layout import Layout
from dfsm.control.nlp.nodes import local_rows, node_data
from dfsm.control.nlp.program import Block, Program
from dfsm.control.nlp.shot import Shot, check_limits, quoted
from dfsm.control.nlp.terms import common_of, functions_of
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Trajectory


@settings_class
class DirectTranscription:
    """How to transcribe a problem, and how accurately.

    Attributes
    ----------
    scheme
        ``"hermite_simpson"`` (order 4), ``"radau"`` (order 2 `degree` − 1) or ``"trapezoidal"``
        (order 2).
    degree
        Of Radau's polynomials.
    mesh
        Number of equal intervals, or edges as fractions of the horizon, from 0 to 1.
    refine
        Cut intervals until the errors of dynamics, cost and constraints between the nodes are all
        below this, see `Solution.errors`; None keeps the mesh as it is.
    most_refinements
        Meshes tried after the first.
    stay_inside
        Keep measured states, controls and free parameters inside a surrogate's training range, and
        their combinations near what occurred there, see `Region.distance_chosen`.
    tolerance
        Of the scaled optimality conditions.
    most_iterations
        Of the solver, on each mesh.
    most_seconds
        For all meshes together, None for no limit.
    """

    scheme: Kind = "hermite_simpson"
    degree: int = 3
    mesh: int | Sequence[float] = 20
    refine: float | None = 1e-6
    most_refinements: int = 8
    stay_inside: bool = False
    tolerance: float = 1e-8
    most_iterations: int = 500
    most_seconds: float | None = None

    def __post_init__(self) -> None:
        require(1 <= self.degree <= 12, "degree", self.degree, "1 to 12")
        check_limits(self)
        self.grid()

    def grid(self) -> Grid:
        """The first mesh."""
        return grid_of(self.scheme, self.degree, self.mesh)

    @property
    def most_intervals(self) -> int:
        """Meshes are not refined beyond so many."""
        return 5000

    def refined(
        self, grid: Grid, errors: Array, tolerance: float, knots: Array | None = None
    ) -> Grid:
        """The mesh with its intervals cut where errors are above a tolerance."""
        return grid.refined(errors, tolerance, knots)

    def shot(self, problem: OptimalControlProblem, grid: Grid, start: Start) -> Transcription:
        """The problem on a mesh; the start gives the sizes of variables without bounds."""
        return Transcription(problem, grid, start, self.stay_inside)


class Transcription(Shot):
    """A problem on one mesh, as a nonlinear program.

    Parameters
    ----------
    problem, grid
        What, and where.
    start
        Gives the sizes of variables that have no bounds.
    stay_inside
        See `DirectTranscription`.
    """

    def __init__(
        self, problem: OptimalControlProblem, grid: Grid, start: Start, stay_inside: bool = False
    ) -> None:
        self.problem, self.grid = problem, grid
        self.functions = functions_of(problem)
        nodes = np.arange(len(grid.tau))
        places = grid.tau, nodes, grid.control_node
        layout = Layout(problem, self.functions, *places, start, stay_inside)
        self.layout = replace(layout, known=problem.latent_paths(layout.time))
        self.common = common_of(problem)
        self.program = self._program()

    def _program(self) -> Program:
        layout, functions = self.layout, self.functions
        low, high = layout.limits()
        scale = layout.scale(low, high)
        outputs = 1 + functions.nx + sum(functions.path_sizes.values())
        end_outputs = 1 + sum(functions.boundary_sizes.values())
        # Constraints hold where there are equations; they come after the cost and the slopes.
        at = np.arange(layout.scenarios)[:, None] * layout.nodes + self.grid.own
        parts = [
            constraints.defects(layout, self.grid, scale, outputs),
            constraints.path(layout, self.grid.own, at * outputs + 1 + functions.nx),
            constraints.boundary(layout, end_outputs),
            *constraints.rates(layout, scale),
        ]
        self._first_path = len(parts[0].low)
        weights = self.problem.scenario_weights
        c = np.zeros((layout.scenarios, layout.nodes, outputs))
        c[..., 0] = weights[:, None] * self.grid.weights
        x, u, _ = layout.columns
        local = np.concatenate([x, u, layout.shared], axis=2)
        nodes = Block(
            functions.node,
            local.reshape(-1, local.shape[2]),
            node_data(self.problem, layout.tau, layout.time),
            self.common,
            constraints.stacked(parts, "node", c.size),
            c.ravel(),
        )
        program = constraints.program_of(layout, parts, nodes, self.common, (low, high, scale))
        z = np.ones(layout.count)
        program.linear_quadratic = all(
            b.term.is_quadratic(z[b.columns], b.data, b.common) for b in program.blocks
        )
        return program

    # -- values at the nodes --------------------------------------------------------------------

    def unscaled(self, z: Array) -> Start:
        """Values at the nodes; a control that is not a variable is extrapolated within bounds."""
        start = self.layout.unpack(self.program.physical(z))
        if self.grid.scheme.starts:
            return start
        low, high = self.layout.limits()
        u = self.layout.columns[1][:, 0]
        first = np.stack([self.grid.controls(U, self.grid.tau[:1])[0] for U in start.U])
        start.U[:, 0] = np.clip(first, low[u], high[u])
        return start

    def costates(self, multipliers: Array) -> tuple[Trajectory, ...]:
        """∂J/∂ξ from the multipliers of the defects, per scenario.

        Radau's belong to its collocation points (Garg et al. 2011), the others' to the middles of
        the intervals. States that are known beforehand have none.
        """
        return self.layout.costates(*self.costate_values(multipliers))

    def costate_values(self, multipliers: Array) -> tuple[Array, Array]:
        """Normalised times, and `costates` at these, ``(scenario, time, solved state)``."""
        layout, grid = self.layout, self.grid
        defects, states = len(grid.scheme.D), len(layout.solved)
        shape = (layout.scenarios, grid.intervals, defects, states)
        values = -multipliers[: int(np.prod(shape))].reshape(shape)
        if grid.kind == "radau":
            values = values / grid.scheme.weights[1:, None]
            tau = grid.tau[1:]
        else:
            values, tau = values[:, :, -1:], grid.edges[:-1] + grid.lengths / 2
        return tau, values.reshape(layout.scenarios, -1, states)

    def in_controls(
        self, X: Array, U: Array, start: Start, tau: Array, weights: Array
    ) -> tuple[Array, Array]:
        """First and second derivatives of weighted outputs with every control, see `at`.

        `weights` has the shape of what `at` returns, what comes back that of `U`.
        """
        local, data = local_rows(self.problem, X, U, start, tau)
        node, common = self.functions.node, self.common
        flat = weights.reshape(len(local), -1)
        own = np.arange(X.shape[2], X.shape[2] + U.shape[2])
        slope = np.einsum("ro,roc->rc", flat, node.jacobian(local, data, common, own))
        curve = np.diagonal(node.hessian(local, data, common, flat, own), axis1=1, axis2=2)
        return slope.reshape(U.shape), curve.reshape(U.shape)

    def estimate(self, outcome: Outcome, start: Start) -> Estimate:
        """Errors between the nodes, see `nlp.estimate`."""
        return estimate_of(self, outcome, start)

    def path_rows(self) -> IntArray:
        """Path constraints, see `Shot`."""
        width = sum(self.functions.path_sizes.values())
        shape = (self.layout.scenarios, len(self.grid.own), width)
        return self._first_path + np.arange(np.prod(shape)).reshape(shape)

    @property
    def otherwise(self) -> str:
        """What follows jumps and kinks better."""
        if self.grid.kind != "radau":
            return "use scheme radau"
        return "replace kinks in costs and constraints by smooth functions"

    def row_nodes(self) -> IntArray:
        """All of them."""
        return np.arange(self.layout.nodes)

    def row_names(self) -> list[str]:
        """The cost, the derivatives of the states, and the path constraints."""
        states = self.functions.plant.names("states")
        slopes = [f"the derivative of '{n}'" for n in states]
        return ["the cost", *slopes, *quoted(self.functions.path_sizes)]

"""Single and multiple shooting: controls and few states are variables, an integrator does the rest.

The horizon is cut into segments. In each the model is integrated from a variable initial state by
RK4, under controls that are linear between their nodes; the end of one segment is the start of the
next. One segment alone is single shooting. Derivatives go through the integrator and are exact.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.mesh.grid import Grid
from dfsm.control.nlp import constraints
from dfsm.control.nlp.estimate import Estimate
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.layout import Layout
from dfsm.control.nlp.program import Block, Program, Rows
from dfsm.control.nlp.shot import Shot, check_limits, quoted
from dfsm.control.nlp.simulated import estimate_simulated, segment_data, segment_term
from dfsm.control.nlp.terms import common_of, functions_of
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Trajectory


@settings_class
class MultipleShooting:
    """How to shoot.

    Attributes
    ----------
    segments
        Number of segments, each with an initial state of its own.
    pieces
        Linear pieces of the controls in every segment. Path constraints and bounds hold at their
        ends.
    steps
        RK4 steps in every piece.
    refine
        Cut segments until the errors of dynamics, cost and constraints between the ends of the
        pieces are all below this, see `Solution.errors`; None keeps the mesh as it is.
    most_refinements
        Meshes tried after the first.
    stay_inside
        Keep measured states, controls and free parameters inside a surrogate's training range, and
        their combinations near what occurred there, see `Region.distance_chosen`.
    tolerance
        Of the scaled optimality conditions.
    most_iterations
        Of the solver.
    most_seconds
        For the solve, None for no limit.
    """

    segments: int = 20
    pieces: int = 2
    steps: int = 4
    refine: float | None = 1e-6
    most_refinements: int = 8
    stay_inside: bool = False
    tolerance: float = 1e-8
    most_iterations: int = 500
    most_seconds: float | None = None

    def __post_init__(self) -> None:
        _check(self)

    @property
    def most_intervals(self) -> int:
        """Meshes are not refined beyond so many."""
        return 5000

    def grid(self) -> Grid:
        """The mesh of the controls, which are linear on it."""
        return Grid("trapezoidal", 1, np.linspace(0, 1, self.segments * self.pieces + 1))

    def refined(
        self, grid: Grid, errors: Array, tolerance: float, knots: Array | None = None
    ) -> Grid:
        """The mesh with its segments cut where errors are above a tolerance."""
        segments = replace(grid, edges=grid.edges[:: self.pieces])
        worst = errors.reshape(-1, self.pieces).max(axis=1)
        return segments.refined(worst, tolerance, knots).finer(self.pieces)

    def pieces_of(self, _grid: Grid) -> int:
        """Pieces in every segment of a mesh."""
        return self.pieces

    def shot(self, problem: OptimalControlProblem, grid: Grid, start: Start) -> Shooting:
        """The problem in segments; the start gives the sizes of variables without bounds."""
        return Shooting(problem, self, grid, start)


@settings_class
class SingleShooting:
    """How to shoot in one segment: few variables, for short horizons and stable models.

    Attributes
    ----------
    pieces
        Linear pieces of the controls over the horizon. Path constraints and bounds hold at their
        ends.
    steps
        RK4 steps in every piece.
    refine, most_refinements
        See `MultipleShooting`. Here pieces are cut, and every other number of them is compiled
        anew. Derivatives through all pieces cost the square of their number: more than 200 are not
        cut.
    stay_inside, tolerance, most_iterations, most_seconds
        See `MultipleShooting`.
    """

    pieces: int = 20
    steps: int = 4
    refine: float | None = 1e-6
    most_refinements: int = 8
    stay_inside: bool = False
    tolerance: float = 1e-8
    most_iterations: int = 500
    most_seconds: float | None = None

    def __post_init__(self) -> None:
        _check(self)

    @property
    def most_intervals(self) -> int:
        """Meshes are not refined beyond so many."""
        return 200

    def grid(self) -> Grid:
        """The mesh of the controls, which are linear on it."""
        return Grid("trapezoidal", 1, np.linspace(0, 1, self.pieces + 1))

    def refined(
        self, grid: Grid, errors: Array, tolerance: float, knots: Array | None = None
    ) -> Grid:
        """The mesh with its pieces cut where errors are above a tolerance."""
        return grid.refined(errors, tolerance, knots)

    def pieces_of(self, grid: Grid) -> int:
        """All pieces of a mesh."""
        return grid.intervals

    def shot(self, problem: OptimalControlProblem, grid: Grid, start: Start) -> Shooting:
        """The problem in segments; the start gives the sizes of variables without bounds."""
        return Shooting(problem, self, grid, start)


def _check(method: MultipleShooting | SingleShooting) -> None:
    for name in ("segments", "pieces", "steps"):
        value = getattr(method, name, 1)
        require(value >= 1, name, value, "at least 1")
    check_limits(method)


class Shooting(Shot):
    """A problem in segments, as a nonlinear program.

    Parameters
    ----------
    problem, method, grid
        What, how, and the nodes of the controls.
    start
        Gives the sizes of variables that have no bounds.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        method: MultipleShooting | SingleShooting,
        grid: Grid,
        start: Start,
    ) -> None:
        self.problem, self.method, self.grid = problem, method, grid
        self.functions = functions_of(problem)
        nodes = np.arange(len(self.grid.tau))
        self.pieces = method.pieces_of(grid)
        self.segments = grid.intervals // self.pieces
        ends = nodes[:: self.pieces]
        self.layout = Layout(
            problem, self.functions, self.grid.tau, ends, nodes, start, method.stay_inside
        )
        self.common = common_of(problem)
        self.term = segment_term(self.functions, self.pieces, method.steps)
        self.program = self._program()

    def unscaled(self, z: Array) -> Start:
        """Values at the nodes; states inside the segments are the integrator's."""
        start = self.layout.unpack(self.program.physical(z))
        nx, shape = self.functions.nx, (self.layout.scenarios, self.segments)
        outputs = self.program.outputs(z)[0].reshape(*shape, -1)
        inner = outputs[..., 1 + nx : 1 + nx * self.pieces]
        at = np.arange(len(self.grid.tau) - 1).reshape(self.segments, -1)[:, 1:]
        start.X[:, at] = inner.reshape(*shape, -1, nx)
        return start

    def estimate(self, outcome: Outcome, start: Start) -> Estimate:
        """Errors between the nodes, see `nlp.simulated`."""
        return estimate_simulated(self, outcome, start)

    def costates(self, multipliers: Array) -> tuple[Trajectory, ...]:
        """∂J/∂ξ at the ends of the segments, per scenario."""
        shape = (self.layout.scenarios, self.segments, self.functions.nx)
        values = -multipliers[: int(np.prod(shape))].reshape(shape)
        tau = self.grid.edges[self.pieces :: self.pieces]
        return self.layout.costates(tau, values)

    @property
    def otherwise(self) -> str:
        """What places its nodes where they are wanted, with controls that need not be lines."""
        return "use DirectTranscription"

    def path_rows(self) -> IntArray:
        """Path constraints, see `Shot`."""
        width = sum(self.functions.path_sizes.values())
        shape = (self.layout.scenarios, self.layout.nodes, width)
        return self._first_path + np.arange(np.prod(shape)).reshape(shape)

    def row_nodes(self) -> IntArray:
        """The starts of the segments."""
        return self.layout.state_nodes[:-1]

    def row_names(self) -> list[str]:
        """The cost, the states after every piece, and the path constraints around the pieces."""
        states, pieces = self.functions.plant.names("states"), self.pieces
        simulated = [f"the simulated '{n}'" for n in states * pieces]
        return ["the cost", *simulated, *quoted(self.functions.path_sizes) * (pieces + 1)]

    # -- program --------------------------------------------------------------------------------

    @property
    def _outputs(self) -> int:
        """Outputs of a segment: cost, end state, inner states, path constraints."""
        width = sum(self.functions.path_sizes.values())
        return 1 + self.functions.nx * self.pieces + (self.pieces + 1) * width

    def _program(self) -> Program:
        layout, pieces = self.layout, self.pieces
        low, high = layout.limits()
        scale = layout.scale(low, high)
        shape = (layout.scenarios, self.segments)
        first = np.arange(int(np.prod(shape)), dtype=np.int64).reshape(shape)
        first *= self._outputs
        parts = [
            self._joints(first, scale),
            self._inner_bounds(first, scale),
            constraints.path(layout, np.arange(layout.nodes), self._path_source(first)),
            constraints.boundary(layout, 1 + sum(self.functions.boundary_sizes.values())),
            *constraints.rates(layout, scale),
        ]
        self._first_path = len(parts[0].low) + len(parts[1].low)
        c = np.zeros((*shape, self._outputs))
        c[..., 0] = self.problem.scenario_weights[:, None]
        x, u, _ = layout.columns
        starts = layout.state_nodes[:-1]
        at = starts[:, None] + np.arange(pieces + 1)
        controls = u[:, at].reshape(*shape, -1)
        local = np.concatenate([x[:, starts], controls, layout.shared[:, starts]], axis=2)
        segments = Block(
            self.term,
            local.reshape(-1, local.shape[2]),
            self._data(),
            self.common,
            constraints.stacked(parts, "node", c.size),
            c.ravel(),
        )
        return constraints.program_of(layout, parts, segments, self.common, (low, high, scale))

    def _data(self) -> dict[str, Any]:
        """Times and disturbances at the ends and middles of all steps of every segment."""
        per = 2 * self.method.steps
        inside = self.grid.edges[:-1, None] + self.grid.lengths[:, None] * np.arange(per) / per
        first = inside.reshape(self.segments, -1)
        last = self.grid.edges[self.pieces :: self.pieces]
        tau = np.concatenate([first, last[:, None]], axis=1)
        return segment_data(self.problem, tau, float(self.layout.time[-1]))

    def _joints(self, first: IntArray, scale: Array) -> constraints.Part:
        """The end of a segment is the start of the next."""
        x = self.layout.columns[0][:, self.layout.state_nodes]
        nx = self.functions.nx
        index = np.arange(x[:, 1:].size).reshape(x[:, 1:].shape)
        times = np.tile(self.layout.time[self.layout.state_nodes][1:], self.layout.scenarios)
        rows = [
            Rows(f"dynamics of {name}", index[:, :, i].ravel(), times)
            for i, name in enumerate(self.problem.plant.names("states"))
        ]
        linear = constraints.entries(index, x[:, 1:], 1.0)
        node = constraints.entries(index, first[..., None] + 1 + np.arange(nx), -1.0)
        zeros, size = np.zeros(index.size), scale[x[:, 1:]].ravel()
        return constraints.Part(zeros, zeros, size, rows, linear, node)

    def _inner_bounds(self, first: IntArray, scale: Array) -> constraints.Part:
        """Bounds of states at nodes inside the segments."""
        layout, nx, pieces = self.layout, self.functions.nx, self.pieces
        x = layout.columns[0]
        inner = np.setdiff1d(np.arange(layout.nodes), layout.state_nodes)
        low, high, size, source, rows, count = [], [], [], [], [], 0
        for i, name in enumerate(self.problem.plant.names("states")):
            below, above = layout.channel_limits(name, layout.time[inner])
            if not (np.isfinite(below).any() or np.isfinite(above).any()):
                continue
            at = first[:, :, None] + 1 + nx * (1 + np.arange(pieces - 1)) + i
            source.append(at.ravel())
            low.append(np.tile(below, layout.scenarios))
            high.append(np.tile(above, layout.scenarios))
            size.append(np.full(at.size, scale[x[0, 0, i]]))
            times = np.tile(layout.time[inner], layout.scenarios)
            rows.append(Rows(name, count + np.arange(at.size), times))
            count += at.size

        def joined(parts: list[Array]) -> Array:
            return np.concatenate([np.empty(0), *parts])

        columns = joined(source).astype(np.int64)
        node = constraints.entries(np.arange(count), columns, np.ones(count))
        return constraints.Part(joined(low), joined(high), joined(size), rows, node=node)

    def _path_source(self, first: IntArray) -> IntArray:
        """First path output of every node: of the segment that it ends, or begins at the start."""
        pieces = self.pieces
        width = sum(self.functions.path_sizes.values())
        offset = 1 + self.functions.nx * pieces
        ends = first[:, :, None] + offset + width * np.arange(1, pieces + 1)
        return np.concatenate([first[:, :1] + offset, ends.reshape(len(first), -1)], axis=1)

"""Single and multiple shooting: controls and few states are variables, an integrator does the rest.

The horizon is cut into segments. In each the model is integrated from a variable initial state by
RK4, under controls that are linear between their nodes; the end of one segment is the start of the
next. One segment alone is single shooting. Derivatives go through the integrator and are exact.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.control.guess import Start
from dfsm.control.mesh.grid import Grid
from dfsm.control.nlp import constraints
from dfsm.control.nlp.estimate import Estimate
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.layout import Layout
from dfsm.control.nlp.nodes import node_data
from dfsm.control.nlp.program import Block, Program, Rows
from dfsm.control.nlp.shot import Shot, check_seconds, quoted
from dfsm.control.nlp.terms import Functions, Term, common_of, functions_of
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Trajectory


class _OneMesh:
    """A mesh that stays as it is: nothing estimates its error."""

    @property
    def refine(self) -> None:
        """No error to refine to."""

    @property
    def most_refinements(self) -> int:
        """Zero."""
        return 0


@settings_class
class MultipleShooting(_OneMesh):
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
    steps: int = 2
    stay_inside: bool = False
    tolerance: float = 1e-8
    most_iterations: int = 500
    most_seconds: float | None = None

    def __post_init__(self) -> None:
        _check(self)

    def grid(self) -> Grid:
        """The mesh of the controls, which are linear on it."""
        return Grid("trapezoidal", 1, np.linspace(0, 1, self.segments * self.pieces + 1))

    def shot(self, problem: OptimalControlProblem, grid: Grid, start: Start) -> Shooting:
        """The problem in segments; the start gives the sizes of variables without bounds."""
        return Shooting(problem, self, grid, start)


@settings_class
class SingleShooting(_OneMesh):
    """How to shoot in one segment: few variables, for short horizons and stable models.

    Attributes
    ----------
    pieces
        Linear pieces of the controls over the horizon. Path constraints and bounds hold at their
        ends.
    steps
        RK4 steps in every piece.
    stay_inside, tolerance, most_iterations, most_seconds
        See `MultipleShooting`.
    """

    pieces: int = 20
    steps: int = 4
    stay_inside: bool = False
    tolerance: float = 1e-8
    most_iterations: int = 500
    most_seconds: float | None = None

    def __post_init__(self) -> None:
        _check(self)

    @property
    def segments(self) -> int:
        """One."""
        return 1

    def grid(self) -> Grid:
        """The mesh of the controls, which are linear on it."""
        return Grid("trapezoidal", 1, np.linspace(0, 1, self.pieces + 1))

    def shot(self, problem: OptimalControlProblem, grid: Grid, start: Start) -> Shooting:
        """The problem in segments; the start gives the sizes of variables without bounds."""
        return Shooting(problem, self, grid, start)


def _check(method: MultipleShooting | SingleShooting) -> None:
    for name in ("segments", "pieces", "steps", "most_iterations"):
        require(getattr(method, name) >= 1, name, getattr(method, name), "at least 1")
    require(method.tolerance > 0, "tolerance", method.tolerance, "more than 0")
    check_seconds(method.most_seconds)


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
        ends = nodes[:: method.pieces]
        self.layout = Layout(
            problem, self.functions, self.grid.tau, ends, nodes, start, method.stay_inside
        )
        self.common = common_of(problem)
        key = (method.pieces, method.steps)
        if key not in self.functions.segments:
            self.functions.segments[key] = Term(partial(_segment, self.functions, *key))
        self.term = self.functions.segments[key]
        self.program = self._program()

    def unscaled(self, z: Array) -> Start:
        """Values at the nodes; states inside the segments are the integrator's."""
        start = self.layout.unpack(self.program.physical(z))
        nx, shape = self.functions.nx, (self.layout.scenarios, self.method.segments)
        outputs = self.program.outputs(z)[0].reshape(*shape, -1)
        inner = outputs[..., 1 + nx : 1 + nx * self.method.pieces]
        at = np.arange(len(self.grid.tau) - 1).reshape(self.method.segments, -1)[:, 1:]
        start.X[:, at] = inner.reshape(*shape, -1, nx)
        return start

    def estimate(self, outcome: Outcome, start: Start) -> Estimate:
        """None: the replay tells how good the steps are."""
        del outcome, start
        return Estimate.unknown(self.method.segments)

    def costates(self, multipliers: Array) -> tuple[Trajectory, ...]:
        """∂J/∂ξ at the ends of the segments, per scenario."""
        shape = (self.layout.scenarios, self.method.segments, self.functions.nx)
        values = -multipliers[: int(np.prod(shape))].reshape(shape)
        tau = np.linspace(0, 1, self.method.segments + 1)[1:]
        return self.layout.costates(tau, values)

    def row_nodes(self) -> IntArray:
        """The starts of the segments."""
        return self.layout.state_nodes[:-1]

    def row_names(self) -> list[str]:
        """The cost, the states after every piece, and the path constraints around the pieces."""
        states, pieces = self.functions.plant.names("states"), self.method.pieces
        simulated = [f"the simulated '{n}'" for n in states * pieces]
        return ["the cost", *simulated, *quoted(self.functions.path_sizes) * (pieces + 1)]

    # -- program --------------------------------------------------------------------------------

    @property
    def _outputs(self) -> int:
        """Outputs of a segment: cost, end state, inner states, path constraints."""
        width = sum(self.functions.path_sizes.values())
        return 1 + self.functions.nx * self.method.pieces + (self.method.pieces + 1) * width

    def _program(self) -> Program:
        layout, pieces = self.layout, self.method.pieces
        low, high = layout.limits()
        scale = layout.scale(low, high)
        shape = (layout.scenarios, self.method.segments)
        first = np.arange(int(np.prod(shape)), dtype=np.int64).reshape(shape)
        first *= self._outputs
        parts = [
            self._joints(first, scale),
            self._inner_bounds(first, scale),
            constraints.path(layout, np.arange(layout.nodes), self._path_source(first)),
            constraints.boundary(layout, 1 + sum(self.functions.boundary_sizes.values())),
            *constraints.rates(layout, scale),
        ]
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
        per = 2 * self.method.pieces * self.method.steps
        count, scenarios = self.method.segments, self.layout.scenarios
        tau = np.linspace(0, 1, count * per + 1)
        span = self.layout.time[-1] - self.layout.time[0]
        every = node_data(self.problem, tau, self.problem.start + tau * span)
        at = per * np.arange(count)[:, None] + np.arange(per + 1)
        w = every["w"].reshape(scenarios, len(tau), every["w"].shape[1])[:, at]
        return {
            "tau": np.tile(tau[at], (scenarios, 1)),
            "w": w.reshape(scenarios * count, per + 1, w.shape[-1]),
            "scenario": np.repeat(np.arange(scenarios), count),
        }

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
        layout, nx, pieces = self.layout, self.functions.nx, self.method.pieces
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
        pieces = self.method.pieces
        width = sum(self.functions.path_sizes.values())
        offset = 1 + self.functions.nx * pieces
        ends = first[:, :, None] + offset + width * np.arange(1, pieces + 1)
        return np.concatenate([first[:, :1] + offset, ends.reshape(len(first), -1)], axis=1)


def _segment(
    functions: Functions, pieces: int, steps: int, z: jax.Array, data: Any, common: Any
) -> jax.Array:
    """Integrate one segment by RK4: [∫ T L dτ, end state, inner states, path constraints]."""
    nx, nu = functions.nx, functions.nu
    x0, U, q = jnp.split(z, [nx, nx + (pieces + 1) * nu])
    U = U.reshape(pieces + 1, nu)
    # Controls at the ends and middles of all steps.
    place = jnp.arange(2 * pieces * steps + 1) / (2 * steps)
    k = jnp.minimum(place.astype(int), pieces - 1)
    part = (place - k)[:, None]
    u = (1 - part) * U[k] + part * U[k + 1]

    def signals(x: jax.Array, u: jax.Array, tau: jax.Array, w: jax.Array) -> Any:
        here = {"tau": tau, "w": w, "scenario": data["scenario"]}
        return functions.signals(jnp.concatenate([x, u, q]), here, common)

    def stage(carry: tuple[jax.Array, ...], at: tuple[jax.Array, ...]) -> tuple[Any, jax.Array]:
        base, k, total = carry
        (a, b, last, h), inputs = at[:4], at[4:]
        state = base + a * h * k
        s, duration = signals(state[:-1], *inputs)
        k = jnp.concatenate([s.derivative, functions.integrand(s)])
        k = k * duration
        total = total + b * h * k
        base = jnp.where(last, total, base)
        return (base, k, total), base

    # One loop over the four stages of all steps, where `rk4_step` has them one after another: the
    # plant with its second derivatives is compiled once and not four times.
    count = pieces * steps
    middle = 2 * jnp.repeat(jnp.arange(count), 4) + jnp.tile(jnp.array([0, 1, 1, 2]), count)
    a, b = jnp.array([0, 0.5, 0.5, 1]), jnp.array([1, 2, 2, 1]) / 6
    last = jnp.array([False, False, False, True])
    h = jnp.repeat(jnp.diff(data["tau"][::2]), 4)
    over = (*(jnp.tile(v, count) for v in (a, b, last)), h)
    over = (*over, u[middle], data["tau"][middle], data["w"][middle])
    begin = jnp.append(x0, 0.0)
    (final, _, _), states = jax.lax.scan(stage, (begin, jnp.zeros_like(begin), begin), over)
    at_pieces = jnp.concatenate([x0[None], states[4 * steps - 1 :: 4 * steps, :-1]])
    every = 2 * steps

    def path(x: jax.Array, u: jax.Array, tau: jax.Array, w: jax.Array) -> jax.Array:
        return functions.path(signals(x, u, tau, w)[0])

    paths = jax.vmap(path)(at_pieces, u[::every], data["tau"][::every], data["w"][::every])
    return jnp.concatenate([final[-1:], final[:-1], at_pieces[1:-1].ravel(), paths.ravel()])

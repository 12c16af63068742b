"""Where states, controls, free parameters and the last time stand among the variables of an NLP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.nlp.nodes import values_along
from dfsm.control.nlp.program import Rows
from dfsm.control.nlp.terms import Functions, common_of
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

# Limits from here on mean that there is none.
_NONE = 1e15
# Values that are smaller than this share of how far the same thing moves are what rounding left of
# a 0, and say nothing of its size: a start at sin π, or a state at which a simulation came to rest.
ROUNDING = 1e-8


@dataclass(frozen=True, eq=False)
class Layout:
    """Variables of a problem on a mesh: node by node, scenario by scenario, shared ones last.

    Attributes
    ----------
    problem, functions
        What is solved.
    tau
        Normalised times of the nodes, shape ``(node,)``.
    state_nodes
        Nodes whose states are variables, shape ``(state node,)``, both ends included.
    control_node
        Node whose control holds at every node, shape ``(node,)``.
    start
        Where the solve starts; gives the sizes of variables without bounds.
    stay_inside
        Whether the training range of a surrogate bounds controls, measured states and parameters.
    known
        States that are known at all nodes, by name, shapes ``(scenario, node)``: variables that
        cannot move.
    """

    problem: OptimalControlProblem
    functions: Functions
    tau: Array
    state_nodes: IntArray
    control_node: IntArray
    start: Start
    stay_inside: bool
    known: Mapping[str, Array] = field(default_factory=dict)

    @property
    def scenarios(self) -> int:
        """Number of scenarios."""
        return len(self.problem.scenarios)

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return len(self.tau)

    @property
    def control_nodes(self) -> IntArray:
        """Nodes with a control of their own."""
        return np.unique(self.control_node)

    @cached_property
    def time(self) -> Array:
        """Times of the nodes in s; for a free last time those of the start."""
        # There all limits are constant, so that any times serve.
        return self.problem.start + self.tau * (self.start.stop - self.problem.start)

    @cached_property
    def along(self) -> Array:
        """Outputs of the nodes' term along the start, see `values_along`; 0 where not finite."""
        with np.errstate(all="ignore"):  # what is not finite is told when the solve begins
            values = values_along(
                self.problem, self.functions, self.start.X, self.start.U, self.start, self.tau
            )
        return np.where(np.isfinite(values), values, 0.0)

    @cached_property
    def ends_along(self) -> Array:
        """Outputs of the ends' term at the start, ``(scenario, output)``; 0 where not finite."""
        X, shared = self.start.X, [*self.start.p, *([self.start.stop] if self.free_time else [])]
        local = np.concatenate([X[:, 0], X[:, -1], np.tile(shared, (len(X), 1))], axis=1)
        with np.errstate(all="ignore"):
            values = self.functions.ends.values(
                local, {"scenario": np.arange(len(X))}, common_of(self.problem)
            )
        return np.where(np.isfinite(values), values, 0.0)

    @cached_property
    def solved(self) -> IntArray:
        """Which of the states are solved for."""
        names = self.problem.plant.names("states")
        return np.array([i for i, n in enumerate(names) if n not in self.known], dtype=int)

    @property
    def free_time(self) -> bool:
        """Whether the last time is a variable."""
        return self.problem.free_time is not None

    @cached_property
    def columns(self) -> tuple[IntArray, IntArray, IntArray]:
        """Variables of states and controls ``(scenario, node, n)``, and those that all share.

        States that are no variables have column -1.
        """
        nx, nu = self.functions.nx, self.functions.nu
        has_state = np.isin(np.arange(self.nodes), self.state_nodes)
        has_control = self.control_node == np.arange(self.nodes)
        width = nx * has_state + nu * has_control
        first = np.concatenate([[0], np.cumsum(np.tile(width, self.scenarios))])
        begins = first[:-1].reshape(self.scenarios, self.nodes)
        x = np.where(has_state[:, None], begins[..., None] + np.arange(nx), -1)
        after = (begins + nx * has_state)[:, self.control_node]
        u = after[..., None] + np.arange(nu)
        extra = len(self.problem.free_parameters) + self.free_time
        return x, u, first[-1] + np.arange(extra)

    @property
    def count(self) -> int:
        """Number of variables."""
        x, u, q = self.columns
        return int(max(a.max(initial=-1) for a in (x, u, q))) + 1

    @property
    def shared(self) -> IntArray:
        """Variables that all nodes share, once per scenario and node."""
        q = self.columns[2]
        return np.broadcast_to(q, (self.scenarios, self.nodes, len(q)))

    # -- values ---------------------------------------------------------------------------------

    def pack(self, start: Start) -> Array:
        """Variables, in physical units, of states, controls, parameters and last time."""
        x, u, q = self.columns
        z = np.zeros(self.count)
        at, own = self.state_nodes, self.control_nodes
        z[x[:, at]], z[u[:, own]] = start.X[:, at], start.U[:, own]
        z[q] = [*start.p, *([start.stop] if self.free_time else [])]
        return z

    def unpack(self, z: Array) -> Start:
        """The reverse of `pack`; states that are no variables are NaN."""
        x, u, q = self.columns
        p = z[q[: len(self.problem.free_parameters)]]
        stop = float(z[q[-1]]) if self.free_time else self.problem.last_time
        return Start(np.where(x < 0, np.nan, z[x]), z[u], p, stop)

    def limits(self) -> tuple[Array, Array]:
        """Bounds of all variables in physical units, infinite where there is none.

        Raises
        ------
        DfsmError
            The bounds and the training range have nothing in common.
        """
        x, u, q = self.columns
        low, high = np.full(self.count, -np.inf), np.full(self.count, np.inf)
        plant = self.problem.plant
        for group, columns, nodes in (
            ("states", x, self.state_nodes),
            ("controls", u, self.control_nodes),
        ):
            for i, name in enumerate(plant.names(group)):
                below, above = self.channel_limits(name, self.time[nodes])
                low[columns[:, nodes, i]], high[columns[:, nodes, i]] = below, above
        for i, name in enumerate(plant.names("states")):
            for which, node in (("initial", 0), ("final", -1)):
                below, above = self.problem.end_limits(which, name)
                at = x[:, node, i]
                # A fixed end may touch a bound from outside by rounding.
                low[at] = np.minimum(np.maximum(low[at], below), above)
                high[at] = np.maximum(np.minimum(high[at], above), low[at])
        for name, values in self.problem.latent_starts.items():
            for at, value in zip(x[:, 0, plant.names("states").index(name)], values, strict=True):
                if value is not None:
                    low[at] = high[at] = value
        for name, values in self.known.items():
            at = x[:, :, plant.names("states").index(name)]
            low[at] = high[at] = values
        for at, name in zip(q, self.problem.free_parameters, strict=False):
            pair = self.problem.parameters[name]
            below, above = self._inside(name, *map(np.atleast_1d, pair))  # pyright: ignore
            low[at], high[at] = below[0], above[0]
        if self.problem.free_time is not None:
            low[q[-1]], high[q[-1]] = self.problem.free_time
        return np.where(low <= -_NONE, -np.inf, low), np.where(high >= _NONE, np.inf, high)

    def costates(self, tau: Array, values: Array) -> tuple[Trajectory, ...]:
        """Values at normalised times as trajectories, from ``(scenario, time, solved state)``."""
        if len(tau) == 1:  # a trajectory has two samples
            tau, values = np.array([0.0, 1.0]), np.repeat(values, 2, axis=1)
        time = self.problem.start + tau * (self.start.stop - self.problem.start)
        names = np.array(self.problem.plant.names("states"))[self.solved]
        channels = tuple(map(Channel, names.tolist()))
        return tuple(Trajectory(time, v, channels, name="costates") for v in values)

    def channel_limits(self, name: str, time: Array) -> tuple[Array, Array]:
        """Bounds of a state or control at times in s, the training range included if asked."""
        return self._inside(name, *self.problem.limits(name, time))

    def _inside(self, name: str, low: Array, high: Array) -> tuple[Array, Array]:
        region = self.problem.plant.region
        # Latent states follow from the inputs; where disturbances drive them there is no choice.
        if not self.stay_inside or region is None or name in self.problem.latents:
            return low, high
        i = self.problem.plant.order.column(name)
        low = np.maximum(low, float(region.low[i]))
        high = np.minimum(high, float(region.high[i]))
        if (low > high).any():
            raise DfsmError(
                f"{self.problem.name}: the bounds of '{name}' and the model's training range, "
                f"{float(region.low[i]):.5g} to {float(region.high[i]):.5g}, have nothing in "
                "common: widen the bounds, or do not stay inside"
            )
        return low, high

    def scale(self, low: Array, high: Array) -> Array:
        """Sizes of all variables: half the range of the bounds, of the training, or the start's.

        What the start says of a state counts unless it is rounding beside how far the slopes along
        the start would take that state: then the state gets the smaller of that way and 1, and 1
        where there is neither.
        """
        x, u, q = self.columns
        scale = np.ones(self.count)
        plant = self.problem.plant
        least = self.start.sizes or (np.zeros(x.shape[2]), np.zeros(u.shape[2]))
        for group, columns, values, nodes, sizes in (
            ("states", x, self.start.X, self.state_nodes, least[0]),
            ("controls", u, self.start.U, self.control_nodes, least[1]),
        ):
            for i, name in enumerate(plant.names(group)):
                at = columns[:, nodes, i]
                # The ends may be fixed: look at the whole course.
                half = (high[at].max() - low[at].min()) / 2
                told = self._told(name, half)
                if told == 0:
                    # The solver starts within the limits, so that one side alone may tell.
                    seen = values[..., i], np.clip(values[:, nodes, i], low[at], high[at])
                    most = max(*(float(np.abs(v).max()) for v in seen), float(sizes[i]))
                    way = self._way(i) if group == "states" and most > 0 else 0.0
                    told = min(way, 1.0) if most < ROUNDING * way else most or 1.0
                scale[at] = told
        for at, name, value in zip(q, self.problem.free_parameters, self.start.p, strict=False):
            scale[at] = self._told(name, float(high[at] - low[at]) / 2) or abs(value) or 1.0
        if self.free_time:
            scale[q[-1]] = self.start.stop - self.problem.start
        return scale

    def _told(self, name: str, half: float) -> float:
        """Size that limits or the training range give, 0 for none."""
        if 0 < half < np.inf:
            return float(half)
        region = self.problem.plant.region
        if region is not None:
            i = self.problem.plant.order.column(name)
            return max(float(region.high[i] - region.low[i]) / 2, 0.0)
        return 0.0

    def _way(self, i: int) -> float:
        """How far the slopes along the start take a state, ∫ |ẋ| dt."""
        return float(np.trapezoid(np.abs(self.along[..., 1 + i]), self.tau, axis=1).max())

    def sizes(self, scale: Array) -> tuple[Array, Array]:
        """Of states and controls, ``(n,)``, from those of all variables."""
        x, u, _ = self.columns
        return scale[x[0, 0]], scale[u[0, 0]]

    def names(self) -> list[Rows]:
        """What every variable is called, and when it is."""
        x, u, q = self.columns
        rows = []
        for group, columns, nodes in (
            ("states", x, self.state_nodes),
            ("controls", u, self.control_nodes),
        ):
            for i, name in enumerate(self.problem.plant.names(group)):
                times = np.tile(self.time[nodes], self.scenarios)
                rows.append(Rows(name, columns[:, nodes, i].ravel(), times))
        shared = [*self.problem.free_parameters, *(["the last time"] if self.free_time else [])]
        for at, name in zip(q, shared, strict=True):
            rows.append(Rows(name, np.array([at]), np.array([np.nan])))
        return rows

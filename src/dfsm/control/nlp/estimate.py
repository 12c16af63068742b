"""What a mesh does not show: errors between its nodes, estimated apart and by name.

Nodes see the equations, the cost and the limits where they are. Here all three are evaluated on a
dense grid between them, along the scheme's polynomials x̃ and ũ:

- dynamics: ∫ |x̃′ − f| over an interval, relative to each state's size (Betts 2010, Sec. 4.7);
- cost: |∫ L(x̃, ũ) − Σ bᵢ Lᵢ|, summed over the intervals, relative to ∫ |L| + |M|;
- constraints: how far limits are exceeded, relative to their size. What depends on states alone
  counts by its largest excess. A control may jump, and a polynomial overshoots a jump by a share of
  it on any mesh: what depends on controls counts by its excess, integrated over normalised time;
- objective: how far it is from the optimum, to first order: ∫ L − Σ b L + ∫ λ·(f − x̃′) with the
  costates λ, multipliers times excesses, and, where limits become active inside an interval, what
  the best control would gain there, H(x̃, ũ, λ) − min H (after Becker and Rannacher 2001).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.levels import level
from dfsm.control.nlp.constraints import sizes_of
from dfsm.control.nlp.dense import Dense, costates_at, dense_of, switching
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.program import Program
from dfsm.core.types import Array

if TYPE_CHECKING:
    from dfsm.control.nlp.shot import Shot
    from dfsm.control.nlp.transcription import Transcription

# Objectives smaller than this are not told from 0: see the largest scale of `meshes`.
_LEAST = 1e-4
# Scaled distance to a limit up to which it holds.
_HELD = 1e-2


@dataclass(frozen=True, eq=False)
class Estimate:
    """Errors between the nodes of a mesh.

    Attributes
    ----------
    dynamics, cost, constraints
        Of every interval, shape ``(interval,)``, see the module.
    objective
        Relative error of the objective; NaN where nothing estimates it (shooting).
    exceeded
        Which limit is exceeded most between the nodes, by how much, and when; "" for none.
    """

    dynamics: Array
    cost: Array
    constraints: Array
    objective: float
    exceeded: str = ""

    @property
    def errors(self) -> dict[str, float]:
        """Dynamics and constraints by their worst interval, the cost by the sum of all."""
        return {
            "dynamics": float(self.dynamics.max()),
            "cost": float(self.cost.sum()),
            "constraints": float(self.constraints.max()),
            "objective": self.objective,
        }

    @property
    def largest(self) -> tuple[str, float]:
        """Which of the three that drive refinement is largest, and how large."""
        errors = self.errors
        kind = max(("dynamics", "cost", "constraints"), key=errors.__getitem__)
        return kind, errors[kind]

    def local(self, tolerance: float) -> Array:
        """Of every interval what is to fall below the tolerance."""
        cost = self.cost * (len(self.cost) if self.errors["cost"] > tolerance else 0.0)
        return np.maximum(np.maximum(self.dynamics, cost), self.constraints)


@dataclass(frozen=True, eq=False)
class Limited:
    """Something with limits, between the nodes.

    Attributes
    ----------
    name, size
        What it is called, and what excesses are relative to.
    excess
        Beyond its limits in its unit, ``(scenario, interval, point)``.
    jumps
        Whether it depends on controls, which may jump.
    multipliers
        Of its limits at the nodes, ``(scenario, node)``.
    """

    name: str
    size: float
    excess: Array
    jumps: bool
    multipliers: Array


def estimate_of(shot: Transcription, outcome: Outcome, start: Start) -> Estimate:
    """Estimate what the nodes do not show.

    Parameters
    ----------
    shot
        A problem on a mesh.
    outcome, start
        Where the solver ended, and the same as values at the nodes.
    """
    z = outcome.z
    with np.errstate(all="ignore"):  # a function may not be defined between the nodes
        dense = dense_of(shot, z, start)
        gaps = finite(dense.slopes - dense.slope)[..., shot.layout.solved]
        size = state_sizes(shot, start)
        missing = dense.integral(np.abs(np.moveaxis(gaps, -1, 0)))
        dynamics = (missing / size[shot.layout.solved, None, None]).max(axis=(0, 1), initial=0.0)
        cost = _cost_gaps(shot, z, dense)
        whole = objective_size(shot, z, dense)
        limited = list(limited_of(shot, outcome, dense))
        constraints, exceeded = worst_of(dense, limited)
        objective = _objective(shot, outcome, start, dense, (gaps, cost), limited)
    return Estimate(dynamics, np.abs(cost) / whole, constraints, objective / whole, exceeded)


def state_sizes(shot: Shot, start: Start) -> Array:
    """What errors of states are relative to, shape ``(state,)``."""
    scale = shot.layout.sizes(shot.program.scale)[0]
    return np.maximum(np.abs(start.X).max(axis=(0, 1)), 1e-3 * scale)


def finite(values: Array) -> Array:
    """Values, infinite where they are not numbers."""
    return np.where(np.isnan(values), np.inf, values)


def _cost_gaps(shot: Transcription, z: Array, dense: Dense) -> Array:
    """Integral of the cost less its quadrature, of every interval."""
    grid, weights = shot.grid, shot.problem.scenario_weights
    nodes = shot.program.outputs(z)[0].reshape(len(weights), len(grid.tau), -1)[..., 0]
    seen = (nodes[:, grid.local] @ grid.scheme.weights) * grid.lengths
    return weights @ (dense.integral(finite(dense.cost)) - seen)


def objective_size(shot: Shot, z: Array, dense: Dense) -> float:
    """∫ |L| + |M|, which cancellation does not make small."""
    final = abs(float(shot.program.blocks[1].c @ shot.program.outputs(z)[1].ravel()))
    parts = shot.problem.scenario_weights @ dense.integral(np.abs(dense.cost))
    total = float(np.nansum(parts)) + final
    return max(total if np.isfinite(total) else 0.0, _LEAST)


def limited_of(shot: Shot, outcome: Outcome, dense: Dense) -> Iterator[Limited]:
    """All that has limits."""
    layout, program, problem = shot.layout, shot.program, shot.problem
    x, u, _ = layout.columns
    time = dense.time.ravel()
    bound = outcome.bound_multipliers / program.scale
    for group, columns, values in (("states", x, dense.X), ("controls", u, dense.U)):
        for i, name in enumerate(problem.plant.names(group)):
            if name in layout.known:
                continue
            pair = layout.channel_limits(name, time)
            at = columns[:, :, i]
            jumps = group == "controls"
            # States inside the segments of shooting are no variables.
            own = at >= 0
            size = float(program.scale[at[own]].max())
            held = np.where(own & (program.lower[at] < program.upper[at]), bound[at], 0.0)
            yield from _beyond(name, size, values[..., i], pair, jumps, held)
    column = 0
    rows = shot.path_rows() if layout.functions.path_sizes else np.empty((0, 0, 0), dtype=int)
    for name, count in layout.functions.path_sizes.items():
        low, high = problem.bounds.get(name, (None, None))
        if name in problem.constraints:
            _, low, high = problem.constraints[name]
        pair = level(low, name, time, -np.inf), level(high, name, time, np.inf)
        for k in range(count):
            label = name if count == 1 else f"{name}[{k}]"
            held = np.zeros((layout.scenarios, layout.nodes))
            at = rows[:, :, column]
            held[:, shot.grid.own] = outcome.multipliers[at] / program.row_scale[at]
            # Limits may be larger between the nodes; those at the nodes know what is rounding.
            size = max(float(sizes_of(*pair, (0,))), float(program.row_scale[at].max()))
            jumps = bool(layout.functions.path_jumps[column])
            yield from _beyond(label, size, dense.path[..., column], pair, jumps, held)
            column += 1


def _beyond(
    name: str, size: float, values: Array, pair: tuple[Array, Array], jumps: bool, held: Array
) -> Iterator[Limited]:
    low, high = (limit.reshape(values.shape[1:]) for limit in pair)
    if np.isfinite(low).any() or np.isfinite(high).any():
        excess = np.maximum(np.maximum(low - values, values - high), 0.0)
        yield Limited(name, size, finite(excess), jumps, held)


def worst_of(dense: Dense, limited: list[Limited]) -> tuple[Array, str]:
    """The largest relative excess of every interval, and the worst limit in words."""
    intervals = dense.grid.intervals
    most, exceeded, total = 0.0, "", np.zeros(intervals)
    for one in limited:
        seen = dense.integral(one.excess) if one.jumps else one.excess.max(axis=-1)
        local = seen.max(axis=0) / one.size
        total = np.maximum(total, local)
        if local.max() > most:
            most = float(local.max())
            k = int(local.argmax())
            s, j = np.unravel_index(one.excess[:, k].argmax(), one.excess[:, k].shape)
            amount, when = one.excess[s, k, j], dense.time[k, j]
            exceeded = f"{one.name} exceeds its limit by {amount:.3g} at {when:.4g} s"
    return total, exceeded


# -- the objective ------------------------------------------------------------------------------


def _objective(
    shot: Transcription,
    outcome: Outcome,
    start: Start,
    dense: Dense,
    gaps: tuple[Array, Array],
    limited: list[Limited],
) -> float:
    """Distance of the objective from the optimum, in its unit."""
    costates = costates_at(shot, outcome.multipliers / shot.program.row_scale)
    slopes, cost = gaps
    seen = cost.sum() + dense.integral((costates * slopes).sum(axis=-1)).sum()
    local = shot.grid.local
    bought = 0.0
    for one in limited:
        if not one.jumps:
            held = np.abs(one.multipliers)[:, local].sum(axis=-1)
            bought += float((held * (one.excess @ shot.grid.checked[1])).sum())
    gain = _gain(shot, outcome, start, dense, costates)
    # They may cancel, but not reliably.
    return abs(float(seen)) + bought + abs(gain) + _distance(shot.program, outcome)


def _distance(program: Program, outcome: Outcome) -> float:
    """What the solver's barrier costs: multipliers times distances, of limits that hold."""
    total = 0.0
    for multipliers, values, low, high in (
        (outcome.bound_multipliers, outcome.z, program.lower, program.upper),
        (outcome.multipliers, program.constraints(outcome.z), program.g_lower, program.g_upper),
    ):
        gap = np.where(multipliers > 0, high - values, values - low)
        held = (low < high) & (gap > 0) & (gap < _HELD)
        total += float(np.abs(multipliers[held]) @ gap[held])
    return total


def _gain(
    shot: Transcription, outcome: Outcome, start: Start, dense: Dense, costates: Array
) -> float:
    """∫ H(x̃, ũ, λ) − min H over the intervals where limits become active; after one Newton step.

    Where rates or path constraints limit controls, or these are held, the best control is not that
    of one time: 0.
    """
    functions, nu = shot.functions, shot.functions.nu
    holds = shot.grid.held is not None
    if shot.problem.rates or functions.path_jumps.any() or holds or not nu:
        return 0.0
    at = switching(shot, outcome.z)
    if not at.size:
        return 0.0
    points = len(shot.grid.checked[0])
    tau = dense.tau[at].ravel()
    X, U = (V[:, at].reshape(len(V), tau.size, -1) for V in (dense.X, dense.U))
    weights = np.zeros((*X.shape[:2], dense.values.shape[-1]))
    weights[..., 0] = shot.problem.scenario_weights[:, None]
    adjoint = costates[:, at].reshape(*X.shape[:2], -1)
    weights[..., 1 + shot.layout.solved] = adjoint
    low, high = (np.empty_like(U[0]) for _ in range(2))
    for i, name in enumerate(shot.problem.plant.names("controls")):
        low[:, i], high[:, i] = shot.layout.channel_limits(name, dense.time[at].ravel())
    slope, curve = shot.in_controls(X, U, start, tau, weights)
    step = -slope / np.where(curve > 0, curve, 1e-12 * (1 + np.abs(slope).max()))
    step = np.where(np.isfinite(low) & np.isfinite(high) | (curve > 0), step, 0.0)

    def hamiltonian(controls: Array) -> Array:
        return (weights * shot.at(X, controls, start, tau)).sum(axis=-1)

    inside = np.clip(U, low, high)
    best = np.minimum(hamiltonian(inside), hamiltonian(np.clip(inside + step, low, high)))
    gain = (hamiltonian(U) - best).reshape(len(X), len(at), points)
    gain = (gain @ shot.grid.checked[1]) * shot.grid.lengths[at]
    return float(np.where(np.isfinite(gain), gain, 0.0).sum())

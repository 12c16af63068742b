"""The constraints of a transcribed problem as sparse matrices, limits, sizes and names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from dfsm.control.levels import level
from dfsm.control.mesh.grid import Grid
from dfsm.control.nlp.layout import ROUNDING, Layout
from dfsm.control.nlp.program import Block, Program, Rows
from dfsm.core.types import Array, IntArray

# Row, column and value of matrix elements.
Entries = tuple[IntArray, IntArray, Array]


@dataclass(frozen=True, eq=False)
class Part:
    """Some of the constraints: linear in the variables and in the terms' outputs.

    Attributes
    ----------
    low, high
        Limits in physical units, shape ``(row,)``.
    size
        What the solver's numbers are divided by, ``(row,)``.
    rows
        Names, with indices that count from the part's first row.
    linear
        Elements of G₀.
    node, ends
        Elements of G for the outputs of the nodes and of the ends.
    """

    low: Array
    high: Array
    size: Array
    rows: Sequence[Rows]
    linear: Entries | None = None
    node: Entries | None = None
    ends: Entries | None = None


def entries(rows: ArrayLike, columns: ArrayLike, values: ArrayLike) -> Entries:
    """Elements from arrays that broadcast against each other."""
    r, c, v = np.broadcast_arrays(rows, columns, np.asarray(values, dtype=np.float64))
    return r.ravel(), c.ravel(), v.ravel()


def stacked(parts: Sequence[Part], which: str, width: int) -> sparse.csr_matrix:
    """One matrix of all parts, ``(row, width)``."""
    rows, columns, values, first = [], [], [], 0
    for part in parts:
        elements: Entries | None = getattr(part, which)
        if elements is not None:
            rows.append(elements[0] + first)
            columns.append(elements[1])
            values.append(elements[2])
        first += len(part.low)
    if not rows:
        return sparse.csr_matrix((first, width))
    where = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix((np.concatenate(values), where), shape=(first, width))


def named(parts: Sequence[Part]) -> list[Rows]:
    """Names of the rows of all parts, counted from the first of all."""
    rows, first = [], 0
    for part in parts:
        rows += [replace(r, index=r.index + first) for r in part.rows]
        first += len(part.low)
    return rows


def program_of(
    layout: Layout,
    parts: Sequence[Part],
    nodes: Block,
    common: Any,
    sizes: tuple[Array, Array, Array],
) -> Program:
    """Put constraints, the block of the nodes and that of the ends together.

    Parameters
    ----------
    layout, parts, nodes
        Variables, constraints, and the terms at the nodes.
    common
        What the functions of the ends share.
    sizes
        Lower and upper limits and sizes of the variables.
    """
    outputs = 1 + sum(layout.functions.boundary_sizes.values())
    c = np.zeros((layout.scenarios, outputs))
    c[:, 0] = layout.problem.scenario_weights
    x = layout.columns[0]
    ends = Block(
        layout.functions.ends,
        np.concatenate([x[:, 0], x[:, -1], layout.shared[:, 0]], axis=1),
        {"scenario": np.arange(layout.scenarios)},
        common,
        stacked(parts, "ends", c.size),
        c.ravel(),
    )
    low, high, scale = sizes
    limits = (np.concatenate([getattr(p, k) for p in parts]) for k in ("low", "high"))
    return Program(
        (nodes, ends),
        stacked(parts, "linear", layout.count),
        (low, high, *limits),  # pyright: ignore[reportArgumentType]
        scale,
        np.concatenate([p.size for p in parts]),
        named(parts),
        layout.names(),
    )


def defects(layout: Layout, grid: Grid, scale: Array, outputs: int) -> Part:
    """D X − T A F = 0; the outputs of a node are [T L, T ẋ, …]."""
    state = layout.solved
    x = layout.columns[0][:, :, state]
    D, A = grid.defects
    scenario, nx = np.arange(layout.scenarios)[:, None, None], len(state)
    shape = (layout.scenarios, D.shape[0], nx)
    # Axes: scenario, element of the matrix, state.
    place = np.arange(nx)
    to = (scenario * D.shape[0] + D.row[None, :, None]) * nx + place
    linear = entries(to, x[:, D.column, :], D.value[:, None])
    to = (scenario * D.shape[0] + A.row[None, :, None]) * nx + place
    source = (scenario * layout.nodes + A.column[None, :, None]) * outputs + 1 + state
    index = np.arange(np.prod(shape)).reshape(shape)
    middle = grid.edges[:-1] + grid.lengths / 2
    times = np.interp(np.repeat(middle, shape[1] // grid.intervals), layout.tau, layout.time)
    names = layout.problem.plant.names("states")
    rows = [
        Rows(f"dynamics of {names[k]}", index[:, :, i].ravel(), np.tile(times, layout.scenarios))
        for i, k in enumerate(state)
    ]
    zeros = np.zeros(index.size)
    size = np.broadcast_to(scale[x[:, :1, :]], shape).ravel()
    return Part(zeros, zeros, size, rows, linear, entries(to, source, -A.value[:, None]))


def path(layout: Layout, nodes: IntArray, source: IntArray) -> Part:
    """Path constraints and bounded outputs at some nodes, from the outputs `source`.

    `source` has shape ``(scenario, node)`` and names the first output of each node.
    """
    problem, sizes = layout.problem, layout.functions.path_sizes
    width, time = sum(sizes.values()), layout.time[nodes]
    shape = (layout.scenarios, len(nodes), width)
    index = np.arange(np.prod(shape)).reshape(shape)
    low, high = np.zeros(shape), np.zeros(shape)
    rows, column = [], 0
    for name, count in sizes.items():
        below, above = problem.bounds.get(name, (None, None))
        if name in problem.constraints:
            _, below, above = problem.constraints[name]
        for k in range(count):
            low[:, :, column] = level(below, name, time, -np.inf)
            high[:, :, column] = level(above, name, time, np.inf)
            label = name if count == 1 else f"{name}[{k}]"
            times = np.tile(time, layout.scenarios)
            rows.append(Rows(label, index[:, :, column].ravel(), times))
            column += 1
    seen = np.abs(layout.along[..., 1 + layout.functions.nx :])
    size = np.broadcast_to(sizes_of(low, high, (0, 1), seen.max(axis=(0, 1))), shape).ravel()
    node = entries(index, source[:, :, None] + np.arange(width), 1.0)
    return Part(low.ravel(), high.ravel(), size, rows, node=node)


def boundary(layout: Layout, outputs: int) -> Part:
    """Constraints on both ends."""
    sizes, none = layout.functions.boundary_sizes, np.array([np.nan])
    shape = (layout.scenarios, sum(sizes.values()))
    index = np.arange(np.prod(shape)).reshape(shape)
    low, high, rows, column = np.zeros(shape), np.zeros(shape), [], 0
    for name, count in sizes.items():
        _, below, above = layout.problem.boundary[name]
        at = slice(column, column + count)
        low[:, at], high[:, at] = (
            level(below, name, none, -np.inf),
            level(above, name, none, np.inf),
        )
        at_rows = index[:, at].ravel()
        rows.append(Rows(name, at_rows, np.full(len(at_rows), np.nan)))
        column += count
    source = np.arange(layout.scenarios)[:, None] * outputs + 1 + np.arange(shape[1])
    seen = np.abs(layout.ends_along[:, 1:]).max(axis=0)
    size = np.broadcast_to(sizes_of(low, high, (0,), seen), shape).ravel()
    return Part(low.ravel(), high.ravel(), size, rows, ends=entries(index, source, 1.0))


def rates(layout: Layout, scale: Array) -> list[Part]:
    """Rates of controls between neighbouring nodes that have controls of their own."""
    _, u, q = layout.columns
    nodes, problem = layout.control_nodes, layout.problem
    gaps = np.diff(layout.tau[nodes])
    middle = (layout.time[nodes][1:] + layout.time[nodes][:-1]) / 2
    row, parts = np.arange(len(gaps)), []
    for name, (below, above) in problem.rates.items():
        i = problem.plant.names("controls").index(name)
        low, high = level(below, name, middle, -np.inf), level(above, name, middle, np.inf)
        span = layout.start.stop if layout.free_time else problem.last_time
        names = [Rows(f"rate of {name}", row, middle, gaps * (span - problem.start))]
        for s in range(layout.scenarios):
            columns = u[s, nodes, i]
            step = [entries(row, columns[1:], 1.0), entries(row, columns[:-1], -1.0)]
            size = np.full(len(gaps), scale[columns[0]] * gaps.mean())
            if not layout.free_time:
                span = gaps * (problem.last_time - problem.start)
                parts.append(Part(low * span, high * span, size, names, _joined(step)))
                continue
            # u₁ − u₀ − r Δτ t_f is limited on one side by −r Δτ t_0.
            none = np.full(len(gaps), np.inf)
            for r, lower in ((low, True), (high, False)):
                if np.isfinite(r).all():
                    linear = _joined([*step, entries(row, q[-1], -r * gaps)])
                    limit = -r * gaps * problem.start
                    pair = (limit, none) if lower else (-none, limit)
                    parts.append(Part(*pair, size, names, linear))
    return parts


def sizes_of(low: Array, high: Array, axes: tuple[int, ...], seen: Array | float = 0.0) -> Array:
    """Sizes of constraints: the largest finite limit over some axes, 1 where that is 0.

    `seen` are the largest values along the start: a limit that is rounding beside them is a 0.
    """
    largest = np.maximum(_finite(low), _finite(high)).max(axis=axes, initial=0.0)
    return np.where(largest > ROUNDING * seen, largest, 1.0)


def _finite(limits: Array) -> Array:
    return np.where(np.isfinite(limits), np.abs(limits), 0.0)


def _joined(parts: Sequence[Entries]) -> Entries:
    r, c, v = (np.concatenate(a) for a in zip(*parts, strict=True))
    return r, c, v

"""What `solve` needs of a way to a nonlinear program, whichever it is.

A `Method` holds its settings; a `Shot` is a problem on one mesh, as that method makes it.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Protocol

import numpy as np

from dfsm.control.guess import Start
from dfsm.control.mesh.grid import Grid
from dfsm.control.nlp.estimate import Estimate
from dfsm.control.nlp.ipopt import Outcome
from dfsm.control.nlp.layout import Layout
from dfsm.control.nlp.nodes import values_along
from dfsm.control.nlp.program import Program
from dfsm.control.nlp.terms import Functions
from dfsm.control.problem import OptimalControlProblem
from dfsm.core.settings import require
from dfsm.core.types import Array, IntArray
from dfsm.data.trajectory import Trajectory


class Shot(Protocol):
    """A problem on one mesh, as a nonlinear program.

    Attributes
    ----------
    problem, functions, layout, program
        What is solved, its compiled functions, its variables, and the program of these.
    grid
        Nodes of the controls, and the polynomials between them.
    """

    problem: OptimalControlProblem
    functions: Functions
    layout: Layout
    program: Program
    grid: Grid

    def scaled(self, start: Start) -> Array:
        """The solver's variables of a start, moved within their bounds."""
        return self.program.scaled(self.layout.pack(start))

    @abstractmethod
    def unscaled(self, z: Array) -> Start:
        """Values at all nodes from the solver's variables."""
        ...

    def at(self, X: Array, U: Array, start: Start, tau: Array) -> Array:
        """Outputs of the nodes' term anywhere, see `values_along`."""
        return values_along(self.problem, self.functions, X, U, start, tau)

    @abstractmethod
    def estimate(self, outcome: Outcome, start: Start) -> Estimate:
        """Errors between the nodes, NaN where nothing estimates them."""
        ...

    @abstractmethod
    def costates(self, multipliers: Array) -> tuple[Trajectory, ...]:
        """∂J/∂ξ per scenario, from the multipliers of the constraints in physical units."""
        ...

    @abstractmethod
    def row_nodes(self) -> IntArray:
        """Nodes at which the rows of the first block begin, of one scenario."""
        ...

    @abstractmethod
    def row_names(self) -> list[str]:
        """What the outputs of a row of the first block are called."""
        ...

    def row_times(self) -> Array:
        """Time in s of every row of the first block, of all scenarios."""
        return np.tile(self.layout.time[self.row_nodes()], self.layout.scenarios)

    def output_names(self) -> tuple[list[str], list[str]]:
        """What the outputs of the blocks of the nodes and of the ends are called."""
        return self.row_names(), ["the final cost", *quoted(self.functions.boundary_sizes)]


class Method(Protocol):
    """Settings of a way to a nonlinear program.

    Attributes
    ----------
    stay_inside
        Keep to the training range of a surrogate.
    tolerance, most_iterations
        Of the solver.
    most_seconds
        For all meshes together, None for no limit.
    refine, most_refinements
        Error to which meshes are refined, None where they are not, and how often.
    """

    @property
    def stay_inside(self) -> bool: ...  # noqa: D102
    @property
    def tolerance(self) -> float: ...  # noqa: D102
    @property
    def most_iterations(self) -> int: ...  # noqa: D102
    @property
    def most_seconds(self) -> float | None: ...  # noqa: D102
    @property
    def refine(self) -> float | None: ...  # noqa: D102
    @property
    def most_refinements(self) -> int: ...  # noqa: D102

    def grid(self) -> Grid:
        """The first mesh."""
        ...

    def shot(self, problem: OptimalControlProblem, grid: Grid, start: Start) -> Shot:
        """The problem on a mesh; the start gives the sizes of variables without bounds."""
        ...


def quoted(sizes: dict[str, int]) -> list[str]:
    """Names of constraints in quotes, as often as they have values."""
    return [f"'{name}'" for name, count in sizes.items() for _ in range(count)]


def check_seconds(limit: float | None) -> None:
    """Refuse a time limit that is none."""
    require(limit is None or limit > 0, "most_seconds", limit, "more than 0, or None")

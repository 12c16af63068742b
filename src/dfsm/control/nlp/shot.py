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
        """Errors between the nodes."""
        ...

    @abstractmethod
    def costates(self, multipliers: Array) -> tuple[Trajectory, ...]:
        """∂J/∂ξ per scenario, from the multipliers of the constraints in physical units."""
        ...

    @property
    @abstractmethod
    def otherwise(self) -> str:
        """What to do where finer meshes do not lower the errors."""
        ...

    @abstractmethod
    def path_rows(self) -> IntArray:
        """Constraints that are path constraints, shape ``(scenario, own node, value)``."""
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
    most_intervals
        Meshes are not refined beyond so many.
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
    @property
    def most_intervals(self) -> int: ...  # noqa: D102

    def grid(self) -> Grid:
        """The first mesh."""
        ...

    def refined(
        self, grid: Grid, errors: Array, tolerance: float, knots: Array | None = None
    ) -> Grid:
        """A mesh that is finer where errors are above a tolerance, see `Grid.refined`."""
        ...

    def shot(self, problem: OptimalControlProblem, grid: Grid, start: Start) -> Shot:
        """The problem on a mesh; the start gives the sizes of variables without bounds."""
        ...


def quoted(sizes: dict[str, int]) -> list[str]:
    """Names of constraints in quotes, as often as they have values."""
    return [f"'{name}'" for name, count in sizes.items() for _ in range(count)]


def check_limits(method: Method) -> None:
    """Refuse tolerances and limits that are none."""
    refine, seconds = method.refine, method.most_seconds
    require(refine is None or refine > 0, "refine", refine, "more than 0")
    require(method.tolerance > 0, "tolerance", method.tolerance, "more than 0")
    require(method.most_iterations >= 1, "most_iterations", method.most_iterations, "at least 1")
    require(method.most_refinements >= 0, "most_refinements", method.most_refinements, "0 or more")
    require(seconds is None or seconds > 0, "most_seconds", seconds, "more than 0, or None")

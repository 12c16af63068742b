"""A solution as a folder: arrays in safetensors, everything else in a readable JSON manifest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, TypeAdapter

from dfsm.control.mesh.grid import Grid
from dfsm.control.solution import RATE, Ending, Optimality, Replay, Solution
from dfsm.core.bundle import MANIFEST, Bundle
from dfsm.core.exchange import recover
from dfsm.core.files import check_folder, visible
from dfsm.core.types import Array
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError

FORMAT = 1
TENSORS = "solution.safetensors"
# A page about the solution, which `dfsm optimize` puts beside them.
PAGE = "solution.html"
_BUNDLE = Bundle(TENSORS, FORMAT, "solve again")
# What the manifest holds as it is.
_PLAIN = (
    "name",
    "reason",
    "objective",
    "final_cost",
    "integral_cost",
    "parameters",
    "error",
    "meshes",
    "iterations",
    "seconds",
    "linear_quadratic",
    "violation",
    "outside",
)


def save_solution(
    solution: Solution,
    path: str | Path,
    page: Callable[[Solution, Path], object] | None = None,
) -> None:
    """Write a solution folder; an existing solution folder there is replaced in one step.

    Parameters
    ----------
    solution
        From `solve`.
    path
        Folder to make.
    page
        Writes a page about the solution to a file, which becomes part of the folder.

    Raises
    ------
    DfsmError
        `path` holds something else, or cannot be written.
    """
    tensors: dict[str, Array] = {
        "edges": solution.grid.edges,
        "solver_state": solution.solver_state,
    }
    if solution.grid.held is not None:
        tensors["held"] = solution.grid.held
    for group in ("multipliers", "bounds"):
        arrays = getattr(solution, group)
        tensors |= {f"{group}/{n}": np.asarray(v) for n, v in arrays.items()}
    content = {key: getattr(solution, key) for key in _PLAIN}
    content |= {
        "ending": solution.ending.name,
        "scheme": {"kind": solution.grid.kind, "degree": solution.grid.degree},
        "trajectories": _apart("trajectories", solution.trajectories, tensors),
        "costates": _apart("costates", solution.costates, tensors),
        "replays": _apart("replays", [r.trajectory for r in solution.replays], tensors),
        "deviations": [[dict(r.deviation), r.relative] for r in solution.replays],
    }
    if solution.departures:
        content["departures"] = list(solution.departures)
    if solution.errors:
        content["errors"] = dict(solution.errors)
    if solution.optimality is not None:
        content["optimality"] = asdict(solution.optimality)
    pages = {} if page is None else {PAGE: lambda file: page(solution, file)}
    _BUNDLE.write(path, tensors, content, _is_solution, pages)


def check_solution_target(path: str | Path) -> None:
    """Fail where `save_solution` would refuse: call it before long work, not after."""
    check_folder(path, is_ours=_is_solution)


def load_solution(path: str | Path) -> Solution:
    """Read a solution folder; the solution can be looked at, and be the guess of another solve.

    Parameters
    ----------
    path
        Folder that `save_solution` made.

    Raises
    ------
    DfsmError
        The folder is missing, no solution, damaged, or written by a newer version.
    """
    path = Path(path)
    recover(path)
    if not path.is_dir() or not _is_solution(path):
        raise DfsmError(f"{path} is no folder of a solution as save_solution makes it")
    manifest = _BUNDLE.read_manifest(path)
    tensors = _BUNDLE.read_tensors(path, manifest)
    try:
        plain = {key: manifest[key] for key in _PLAIN}
        plain |= _Figures.model_validate(plain).model_dump()
        replays = [
            Replay(run, deviation, relative)
            for run, (deviation, relative) in zip(
                _together("replays", manifest, tensors), _deviations(manifest), strict=True
            )
        ]
        solution = Solution(
            **plain,
            ending=Ending[manifest["ending"]],
            grid=Grid(**manifest["scheme"], edges=tensors["edges"], held=tensors.get("held")),
            trajectories=tuple(_together("trajectories", manifest, tensors)),
            costates=tuple(_together("costates", manifest, tensors)),
            multipliers=_group("multipliers/", tensors),
            bounds=_group("bounds/", tensors),
            replays=tuple(replays),
            solver_state=tensors["solver_state"],
            optimality=_optimality(manifest),
            errors=_numbers(manifest.get("errors", {})),
            departures=TypeAdapter(tuple[str, ...]).validate_python(manifest.get("departures", ())),
        )
        _check(solution)
    except (*_GARBLED, DfsmError) as error:
        raise _BUNDLE.damaged(
            path, f"its {MANIFEST} lacks or garbles {error}".split("\n")[0]
        ) from None
    return solution


# What Python and pydantic say of parts that do not fit together.
_GARBLED = (KeyError, TypeError, AttributeError, ValueError, IndexError, OverflowError)
# JSON has no NaN: a shooting method has no local error, a solve that failed may have no objective.
_Number = Annotated[float, BeforeValidator(lambda v: np.nan if v is None else v)]


class _Mesh(BaseModel):
    model_config = ConfigDict(extra="allow")
    intervals: int
    objective: _Number
    error: _Number
    iterations: int


class _Seconds(BaseModel):
    model_config = ConfigDict(extra="allow")
    compile: float
    solve: float


class _Figures(BaseModel):
    """Types of what the manifest holds as it is."""

    name: str
    reason: str
    objective: _Number
    final_cost: _Number
    integral_cost: _Number
    parameters: dict[str, float]
    error: _Number
    meshes: list[_Mesh]
    iterations: int
    seconds: _Seconds
    linear_quadratic: bool
    violation: _Number
    outside: float | None


def _deviations(manifest: Mapping[str, Any]) -> list[tuple[dict[str, float], float]]:
    kind = TypeAdapter(list[tuple[dict[str, _Number], _Number]])
    return kind.validate_python(manifest["deviations"])


def _check(solution: Solution) -> None:
    """Refuse a mesh that is not that of the trajectories, before its matrices are made.

    Raises
    ------
    ValueError
        Says which part.
    """
    grid, runs = solution.grid, solution.trajectories
    steps = {"trapezoidal": 1, "hermite_simpson": 2, "radau": grid.degree}
    if grid.kind not in steps or type(grid.degree) is not int or grid.degree < 1:
        raise ValueError("scheme")
    edges = grid.edges
    if edges.ndim != 1 or len(edges) < 2 or not (np.diff(edges) > 0).all():
        raise ValueError("edges, expected at least two that increase")
    held = edges if grid.held is None else grid.held
    ends = held.ndim == 1 and len(held) > 1 and (held[0], held[-1]) == (edges[0], edges[-1])
    if not ends or not np.isin(held, edges).all() or not (np.diff(held) > 0).all():
        raise ValueError("held, expected some of the edges")
    nodes = steps[grid.kind] * (len(edges) - 1) + 1
    if not runs or any(len(run) != nodes for run in runs):
        raise ValueError(f"scheme, whose {nodes} nodes are not those of the trajectories")
    if any(len(group) not in (0, len(runs)) for group in (solution.costates, solution.replays)):
        raise ValueError("costates or replays, which are not one per scenario")
    for name, limits in solution.bounds.items():
        if limits.shape != (2, nodes) or name.removeprefix(RATE) not in runs[0]:
            raise ValueError(f"bounds of {name}")
    arrays = (edges, solution.solver_state, *solution.multipliers.values())
    if any(a.dtype != np.float64 for a in (*arrays, *solution.bounds.values())):
        raise ValueError("an array, expected 64-bit numbers")


def _apart(
    group: str, runs: Sequence[Trajectory], tensors: dict[str, Array]
) -> list[dict[str, Any]]:
    """Put the arrays of runs under ``group/…`` into `tensors`; return the rest."""
    for k, run in enumerate(runs):
        tensors[f"{group}/{k}/time"], tensors[f"{group}/{k}/values"] = run.time, run.values
    return [{"name": run.name, "channels": [asdict(c) for c in run.channels]} for run in runs]


def _together(
    group: str, manifest: Mapping[str, Any], tensors: Mapping[str, Array]
) -> list[Trajectory]:
    read = TypeAdapter(tuple[Channel, ...]).validate_python
    return [
        Trajectory(
            tensors[f"{group}/{k}/time"],
            tensors[f"{group}/{k}/values"],
            read(told["channels"]),
            name=told["name"],
        )
        for k, told in enumerate(manifest[group])
    ]


def _optimality(manifest: Mapping[str, Any]) -> Optimality | None:
    """What was measured; folders of version 0.1 hold none."""
    measured = manifest.get("optimality")
    if measured is None:
        return None
    return Optimality(**_numbers(measured))


def _numbers(values: Mapping[str, float | None]) -> dict[str, float]:
    """What JSON holds for numbers that may be NaN."""
    return {k: np.nan if v is None else float(v) for k, v in values.items()}


def _group(prefix: str, tensors: Mapping[str, Array]) -> dict[str, Array]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _is_solution(path: Path) -> bool:
    return visible(path) - {PAGE} == {MANIFEST, TENSORS}

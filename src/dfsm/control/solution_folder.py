"""A solution as a folder: arrays in safetensors, everything else in a readable JSON manifest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from dfsm.control.mesh.grid import Grid
from dfsm.control.solution import Ending, Optimality, Replay, Solution
from dfsm.core.bundle import MANIFEST, Bundle
from dfsm.core.files import check_folder
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


def save_solution(solution: Solution, path: str | Path) -> None:
    """Write a solution folder; an existing solution folder there is replaced in one step.

    Parameters
    ----------
    solution
        From `solve`.
    path
        Folder to make.

    Raises
    ------
    DfsmError
        `path` holds something else, or cannot be written.
    """
    tensors: dict[str, Array] = {
        "edges": solution.grid.edges,
        "solver_state": solution.solver_state,
    }
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
    if solution.errors:
        content["errors"] = dict(solution.errors)
    if solution.optimality is not None:
        content["optimality"] = asdict(solution.optimality)
    _BUNDLE.write(path, tensors, content, _is_solution)


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
    if not path.is_dir() or not _is_solution(path):
        raise DfsmError(f"{path} is no folder of a solution as save_solution makes it")
    manifest = _BUNDLE.read_manifest(path)
    tensors = _BUNDLE.read_tensors(path, manifest)
    try:
        plain = {key: manifest[key] for key in _PLAIN}
        # JSON has no NaN: a shooting method has no local error.
        plain["error"] = np.nan if plain["error"] is None else plain["error"]
        replays = [
            Replay(run, deviation, relative)
            for run, (deviation, relative) in zip(
                _together("replays", manifest, tensors), manifest["deviations"], strict=True
            )
        ]
        return Solution(
            **plain,
            ending=Ending[manifest["ending"]],
            grid=Grid(**manifest["scheme"], edges=tensors["edges"]),
            trajectories=tuple(_together("trajectories", manifest, tensors)),
            costates=tuple(_together("costates", manifest, tensors)),
            multipliers=_group("multipliers/", tensors),
            bounds=_group("bounds/", tensors),
            replays=tuple(replays),
            solver_state=tensors["solver_state"],
            optimality=_optimality(manifest),
            errors=_numbers(manifest.get("errors", {})),
        )
    except (KeyError, TypeError, ValueError, ValidationError) as error:
        raise _BUNDLE.damaged(
            path, f"its {MANIFEST} lacks or garbles {error}".split("\n")[0]
        ) from None


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
    return {p.name for p in path.iterdir()} - {PAGE} == {MANIFEST, TENSORS}

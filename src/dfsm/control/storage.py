"""A solution as a folder: arrays in safetensors, everything else in a readable JSON manifest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

import dfsm
from dfsm.control.grid import Grid
from dfsm.control.solution import Ending, Replay, Solution
from dfsm.errors import DfsmError
from dfsm.files import json_bytes, write_folder
from dfsm.trajectory import Channel, Trajectory
from dfsm.types import Array

FORMAT = 1
MANIFEST, TENSORS = "manifest.json", "solution.safetensors"
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
    tensors |= {f"multipliers/{n}": np.asarray(v) for n, v in solution.multipliers.items()}
    for name, pair in solution.limits.items():
        tensors[f"limits/{name}"] = np.stack(pair)
    manifest: dict[str, Any] = {"format": FORMAT, "dfsm": dfsm.__version__}
    manifest |= {key: getattr(solution, key) for key in _PLAIN}
    manifest |= {
        "ending": solution.ending.name,
        "scheme": {"kind": solution.grid.kind, "degree": solution.grid.degree},
        "trajectories": _apart("trajectories", solution.trajectories, tensors),
        "costates": _apart("costates", solution.costates, tensors),
        "replays": _apart("replays", [r.trajectory for r in solution.replays], tensors),
        "deviations": [[dict(r.deviation), r.relative] for r in solution.replays],
    }
    with write_folder(path, is_ours=_is_solution) as folder:
        save_file({k: np.ascontiguousarray(v) for k, v in tensors.items()}, folder / TENSORS)
        manifest["sha256"] = hashlib.sha256((folder / TENSORS).read_bytes()).hexdigest()
        (folder / MANIFEST).write_bytes(json_bytes(manifest))


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
    manifest, tensors = _read(path)
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
        multipliers, limits = (_below(group, tensors) for group in ("multipliers/", "limits/"))
        return Solution(
            **plain,
            ending=Ending[manifest["ending"]],
            grid=Grid(**manifest["scheme"], edges=tensors["edges"]),
            trajectories=tuple(_together("trajectories", manifest, tensors)),
            costates=tuple(_together("costates", manifest, tensors)),
            multipliers=multipliers,
            replays=tuple(replays),
            limits={name: (pair[0], pair[1]) for name, pair in limits.items()},
            solver_state=tensors["solver_state"],
        )
    except (KeyError, TypeError, ValueError, ValidationError) as error:
        raise _damaged(path, f"its {MANIFEST} lacks or garbles {error}".split("\n")[0]) from None


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


def _below(group: str, tensors: Mapping[str, Array]) -> dict[str, Array]:
    """Arrays whose name begins with `group`, by the rest of it."""
    return {k.removeprefix(group): v for k, v in tensors.items() if k.startswith(group)}


def _is_solution(path: Path) -> bool:
    return {p.name for p in path.iterdir()} == {MANIFEST, TENSORS}


def _damaged(path: Path, what: str) -> DfsmError:
    return DfsmError(f"{path} is damaged: {what}; solve again or restore the folder")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    if not path.is_dir() or not _is_solution(path):
        raise DfsmError(f"{path} is no folder of a solution as save_solution makes it")
    try:
        manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        digest = hashlib.sha256((path / TENSORS).read_bytes()).hexdigest()
    except (OSError, ValueError, RecursionError) as error:
        raise _damaged(path, f"it cannot be read ({error})") from None
    version = manifest.get("format") if isinstance(manifest, dict) else None
    if not isinstance(version, int):
        raise _damaged(path, f"{MANIFEST} states no format number")
    if version > FORMAT:
        raise DfsmError(
            f"{path} has format {version}, this dfsm {dfsm.__version__} reads up to {FORMAT}: "
            "upgrade with pip install -U dfsm"
        )
    if digest != manifest.get("sha256"):
        raise _damaged(path, f"{TENSORS} is not the file that {MANIFEST} was written for")
    try:
        return manifest, load_file(path / TENSORS)
    except SafetensorError as error:
        raise _damaged(path, f"{TENSORS} cannot be read ({error})") from None

"""A model that runs with NumPy alone: a file of Python and one of numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from dfsm.core.files import check_folder, json_value, visible, write_folder
from dfsm.exports.functions import description, programs
from dfsm.exports.program import Program
from dfsm.models.dfsm import DFSM

SCRIPT, NUMBERS = "run_model.py", "model.npz"


def write_python(model: DFSM, path: str | Path) -> dict[str, Any]:
    """Write ``run_model.py`` and ``model.npz`` into a folder; they need NumPy and no dfsm.

    Parameters
    ----------
    model
        Any model; terms may be functions of one's own.
    path
        Folder to make; one with these two files is replaced.

    Returns
    -------
    dict
        Names, units and start values, see `CasadiModel`.

    Raises
    ------
    DfsmError
        The folder holds something else or cannot be written, or a term is a function with
        something in it that has no counterpart.
    """
    check_folder(path, is_ours=_is_ours)
    told, content = description(model), programs(model)
    arrays: dict[str, Any] = {}
    steps = {name: _told(name, program, arrays) for name, program in content.items()}
    text = json.dumps(json_value({"description": told, "programs": steps}), ensure_ascii=True)
    arrays["description"] = np.frombuffer(text.encode(), dtype=np.uint8)
    numbers = BytesIO()
    np.savez_compressed(numbers, **arrays)
    script = resources.files("dfsm.exports").joinpath(SCRIPT).read_text(encoding="utf-8")
    with write_folder(path, is_ours=_is_ours) as folder:
        (folder / SCRIPT).write_text(script, encoding="utf-8")
        (folder / NUMBERS).write_bytes(numbers.getvalue())
    return told


def _is_ours(path: Path) -> bool:
    return visible(path) - {"__pycache__"} == {SCRIPT, NUMBERS}


def _told(name: str, program: Program, arrays: dict[str, Any]) -> Mapping[str, Any]:
    """The steps as JSON; arrays go to `arrays`, under names that begin with the program's."""
    arrays |= {f"{name}.c{k}": values for k, values in enumerate(program.constants)}
    steps = list[Any]()
    for k, step in enumerate(program.steps):
        if step.places is not None:
            arrays[f"{name}.p{k}"] = step.places
        steps.append([step.kind, list(step.of), step.name, list(step.shape)])
    return {
        "inputs": len(program.inputs),
        "constants": len(program.constants),
        "result": program.result,
        "steps": steps,
    }

"""The folder of a tuning: what was computed on the way, and what came of it.

``evaluations.jsonl`` grows by a line with every evaluation, so that a tuning that was ended goes on
where it stood; the rest is written when it is done, all files in one step.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dfsm.controllers.discon import discon_bytes
from dfsm.controllers.gains import numbers_of
from dfsm.core.files import (
    check_together,
    json_value,
    visible,
    write_file,
    write_json,
    write_together,
)
from dfsm.core.version import __version__
from dfsm.errors import DfsmError
from dfsm.loops.trust_region import ConfirmedTuning
from dfsm.loops.tuning import TuningTask
from dfsm.loops.tuning_result import TuningResult

JOURNAL, FIGURES, PAGE = "evaluations.jsonl", "tuning.json", "tuning.html"
DECK, GAINS = "DISCON.IN", "gains.json"
OURS = {JOURNAL, FIGURES, PAGE, DECK, GAINS}


def check_tuning_target(folder: Path) -> None:
    """Fail early where `save_tuning` would fail.

    Raises
    ------
    DfsmError
        The folder holds what is not of a tuning, or cannot be written.
    """
    check_together(folder)
    if folder.exists() and (others := visible(folder) - OURS - {"truth"}):
        raise DfsmError(
            f"{folder} holds {sorted(others)[0]}, which no tuning wrote: choose another name"
        )


def open_journal(task: TuningTask, folder: Path) -> bool:
    """Go on with what a folder holds of the same loops; whether there was anything.

    What belongs to another model, controller, runs, parameters or measures is replaced.
    """
    folder.mkdir(parents=True, exist_ok=True)
    journal, mark = folder / JOURNAL, fingerprint(task)
    known = journal.exists() and _mark(journal) == mark
    if not known:
        with write_file(journal) as temporary:
            temporary.write_text(json.dumps({"format": 1, "fingerprint": mark}) + "\n")
    task.evaluator.keep(journal)
    return known


def save_tuning(
    task: TuningTask,
    result: TuningResult,
    folder: Path,
    write_page: Callable[[TuningResult, Path], None],
    confirmed: ConfirmedTuning | None = None,
) -> None:
    """Write figures, page and the tuned controller.

    Parameters
    ----------
    task, result
        What was asked, and what came of it.
    folder
        Made if need be.
    write_page
        Writes the page to a path.
    confirmed
        What the truth said, if it was asked.

    Raises
    ------
    DfsmError
        A file cannot be written.
    """
    with write_together(folder) as made:
        write_page(result, made / PAGE)
        if task.discon is not None:
            theta = np.array(list(result.values.values()))
            # Its paths count from where it will stand.
            (made / DECK).write_bytes(discon_bytes(task.deck(theta), folder / DECK))
        else:
            numbers = numbers_of(result.controller)
            write_json(made / GAINS, {n: np.asarray(v).tolist() for n, v in numbers.items()})
        write_json(made / FIGURES, tuning_values(result, confirmed))


def tuning_values(result: TuningResult, confirmed: ConfirmedTuning | None) -> dict[str, Any]:
    """JSON values of a tuning, and of the flights that confirm it."""
    values = result.to_dict()
    if confirmed is not None:
        values |= {
            "confirmed": confirmed.status.name.lower(),
            "flights": json_value([vars(f) for f in confirmed.flights]),
            "best_flight": confirmed.best + 1,
        }
    return values


def fingerprint(task: TuningTask) -> str:
    """Of all that figures at given values of the parameters depend on."""
    settings, h = task.settings, hashlib.sha256()
    assert settings is not None
    said: dict[str, Any] = {
        "dfsm": __version__,
        "runs": [run.digest for run in task.runs],
        "interval": float(task.controller.interval),
        "parameters": list(task.tuned.names),
        "measures": [
            [m.measure, m.channel, m.exponent, m.reference] for m in task.problem.measures
        ],
        "window": [settings.start, settings.stop, settings.loop.start_up, settings.loop.step],
    }
    h.update(json.dumps(json_value(said), sort_keys=True).encode())
    for leaf in (*jax.tree.leaves((task.model, task.controller)), *task.evaluator.computed()):
        if hasattr(leaf, "dtype") or isinstance(leaf, int | float):
            h.update(np.asarray(leaf).tobytes())
        elif isinstance(leaf, str):
            h.update(leaf.encode())
    if task.discon is not None:
        h.update("".join(task.discon.lines).encode("utf-8", errors="surrogateescape"))
    return h.hexdigest()


def _mark(journal: Path) -> str | None:
    try:
        with journal.open(encoding="utf-8") as stream:
            return json.loads(stream.readline()).get("fingerprint")
    except (OSError, ValueError, AttributeError):
        return None

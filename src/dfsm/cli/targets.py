"""Where commands may write: names that end as what is written, never a run that taught the model.

A mistyped ``-o`` costs a configuration or a recorded run, which nothing brings back; a result of
the same command is there to be replaced.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from dfsm.core.files import check_file
from dfsm.errors import DfsmError, hushed

if TYPE_CHECKING:
    from dfsm.data.trajectory import Trajectory
    from dfsm.models.dfsm import DFSM

# Durations in s that differ by less are one: a step that was told is not stored.
_SAME = 1e-9


def check_page(path: Path) -> None:
    """Refuse a file that cannot hold a page, before any work.

    Raises
    ------
    DfsmError
        Its name does not end in .html or .htm, or it cannot be written there.
    """
    _check_ending(path, "a page", (".html", ".htm"))


def check_json(path: Path, what: str) -> None:
    """Refuse a file that cannot hold figures or intervals, before any work.

    Raises
    ------
    DfsmError
        Its name does not end in .json, or it cannot be written there.
    """
    _check_ending(path, what, (".json",))


def _check_ending(path: Path, what: str, endings: tuple[str, ...]) -> None:
    check_file(path)
    if path.suffix.lower() not in endings:
        raise DfsmError(f"{path}: {what} ends in {' or '.join(endings)}: choose a name that does")


def check_spared(
    targets: Iterable[Path | None],
    folder: Path,
    model: DFSM,
    sources: Iterable[str | Path | None] = (),
    step: float | None = None,
) -> None:
    """Refuse targets that the command reads, or that taught the model.

    Parameters
    ----------
    targets
        Files to write; None for those that were not asked for.
    folder, model
        The model, and where it lies: its files are read too.
    sources
        Other files that the command reads; what is no file, as a pattern, is passed over.
    step
        Interval between samples in s that was told for files without times.

    Raises
    ------
    DfsmError
        Which it is.
    """
    read = [path for path in (*folder.iterdir(), *sources) if path and Path(path).exists()]
    for target in targets:
        if target is None:
            continue
        check_file(target, read)
        if target.exists() and _taught(target, model, step):
            raise DfsmError(
                f"{target} is a run that taught the model {folder}: choose another name to write to"
            )


def _taught(path: Path, model: DFSM, step: float | None) -> bool:
    """Whether a file is one of the runs that a model's record lists."""
    from dfsm.cli.terminal import as_in_fit
    from dfsm.data.readers import read
    from dfsm.validation.validate import of_the_fit

    with hushed():
        told = False
        try:
            run = read(path)
        except DfsmError:
            listed = [d for d in _listed(model, path.stem) if d["samples"] > 1]
            own = listed[0]["seconds"] / (listed[0]["samples"] - 1) if listed else None
            told = True
            try:
                run = read(path, step or own)
            except DfsmError:
                return False  # it holds no run
        with suppress(DfsmError):  # what the fit was told of slower channels is of others
            (run,) = as_in_fit(model, [run])
        if of_the_fit(model, [run]):
            return True
    # Parameters stand beside the files, and a step that was told comes back but for rounding.
    return bool(told or model.signals.names("parameters")) and _alike(run, model)


def _listed(model: DFSM, name: str) -> list[dict[str, float]]:
    """What the record says of the training runs of a name."""
    return [d for d in model.provenance.record.get("data", []) if d["name"] == name]


def _alike(run: Trajectory, model: DFSM) -> bool:
    """Whether name, length and channels are those of a training run, and nothing was simulated."""
    record = model.provenance.record
    names = set(record.get("channels", [])) - set(model.signals.names("parameters"))
    return (
        names <= set(run.names)
        and all(c.role is None for c in run.channels)
        and any(
            d["samples"] == len(run) and abs(d["seconds"] - run.duration) <= _SAME * d["seconds"]
            for d in _listed(model, run.name)
        )
    )

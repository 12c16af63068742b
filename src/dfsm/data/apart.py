"""Runs that become files, or are found as files: each needs a name of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError


def require_apart(
    runs: Sequence[Trajectory],
    targets: Sequence[Path],
    fate: str = "be written to",
    cure: str = "rename one of them, or write them to different folders",
) -> None:
    """Refuse runs of which two have one file: call it before long work, not after.

    Parameters
    ----------
    runs
        Any number.
    targets
        The file of each.
    fate, cure
        What would become of two, and what helps, for the sentence.

    Raises
    ------
    DfsmError
        Names both runs and their file.
    """
    taken: dict[str, Trajectory] = {}
    for run, target in zip(runs, targets, strict=True):
        # Systems differ in whether upper and lower case are different names.
        other = taken.setdefault(str(target).casefold(), run)
        if other is not run:
            stems = {Path(one.where).stem.casefold() for one in (other, run)}
            if len(stems) > 1:  # another name for a file does not change what stands in it
                cure = f"both hold the name '{run.name}', write one of them again with another"
            raise DfsmError(f"{other.where} and {run.where} would both {fate} {target}: {cure}")

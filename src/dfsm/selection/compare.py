"""Structure choice: fit a handful of candidates, rank them on rollouts over validation runs.

Every candidate sees the same training runs and is judged on the same validation runs, by the
states that all of them have. Each is written as soon as it is finished, model folder first, then
its result with a fingerprint of all that went into it, so that a comparison that was ended goes on
where it stood.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from dfsm.core.bundle import MANIFEST, is_as_written, signed
from dfsm.core.drawing import Drawn
from dfsm.core.exchange import recover
from dfsm.core.fallback import write_or_keep
from dfsm.core.files import check_file, json_value, write_json
from dfsm.core.lock import locked
from dfsm.core.progress import track
from dfsm.core.settings import require
from dfsm.core.workers import default_jobs, work_through
from dfsm.data.dataset import Dataset
from dfsm.data.derivatives import state_names
from dfsm.data.hold_out import HoldOut, checked, divisions, in_time
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.models.dfsm import DFSM
from dfsm.models.model_folder import check_target, load, save
from dfsm.selection.trial import Candidate, Course, Outcome, try_out

HOLD_OUT = 0.2
# Those of format 1 may lack the checksum.
_FORMAT = 2
# Keys of results that version 0.1 wrote.
_UNSIGNED = (
    *("format", "outcome", "model", "fingerprint", "changes", "settings", "refine"),
    *("training", "validation"),
)
# Names become those of folders, on any system.
_NAME = re.compile(r"\w[\w+-]*")
_Task = tuple[str, Candidate]


@dataclass(frozen=True)
class RankedCandidate:
    """A candidate's place in a comparison.

    Attributes
    ----------
    name, changes
        Those of the candidate.
    outcome
        Errors, times, number of parameters; the reason where it could not be fitted.
    score
        Root mean square of the NRMSE over the states that all candidates have; None where a
        rollout ended early or nothing could be fitted.
    folder
        Its model folder; None where it could not be fitted.
    kept
        Whether the outcome is that of an earlier comparison.
    """

    name: str
    changes: str
    outcome: Outcome
    score: float | None
    folder: Path | None
    kept: bool

    @property
    def status(self) -> str:
        """``"completed"``, ``"diverged"`` (a rollout ended early) or ``"failed"``."""
        if self.outcome.message:
            return "failed"
        return "diverged" if self.outcome.diverged else "completed"


@dataclass(frozen=True)
class Ranking(Drawn):
    """Candidates, best first: completed ones by score, then by the number of rollouts lost.

    Attributes
    ----------
    candidates
        Best first; those that could not be fitted last.
    states
        Names of the states that all candidates have, by which they were ranked.
    training, validation
        Names of the runs that they were fitted to and chosen on. Test the chosen one on others.
    """

    candidates: tuple[RankedCandidate, ...]
    states: tuple[str, ...]
    training: tuple[str, ...]
    validation: tuple[str, ...]

    def __repr__(self) -> str:
        shown = ", ".join(
            f"{c.name} {c.status if c.score is None else format(c.score, '.3g')}"
            for c in self.candidates
        )
        return f"<Ranking on {len(self.validation)} runs: {shown}>"

    @property
    def best(self) -> RankedCandidate | None:
        """The first of the candidates; None if none could be fitted."""
        first = self.candidates[0]
        return None if first.folder is None else first

    def failures(self) -> list[str]:
        """One sentence per candidate that could not be fitted."""
        failed = [c for c in self.candidates if c.status == "failed"]
        return [f"candidate {c.name} could not be fitted: {c.outcome.message}" for c in failed]

    def discarded(self) -> list[str]:
        """One sentence per candidate that is not what was asked for: its refinement failed."""
        return [
            f"candidate {c.name} is not refined: {c.outcome.discarded}"
            for c in self.candidates
            if c.outcome.discarded
        ]

    def to_dict(self) -> dict[str, Any]:
        """JSON values of all figures."""
        entries = [
            {
                "name": c.name,
                "changes": c.changes,
                "status": c.status,
                "score": c.score,
                **asdict(c.outcome),
                "folder": None if c.folder is None else str(c.folder),
                "kept": c.kept,
            }
            for c in self.candidates
        ]
        values = {
            "format": _FORMAT,
            "best": None if self.best is None else self.best.name,
            "candidates": entries,
            "states": self.states,
            "training": self.training,
            "validation": self.validation,
        }
        return dict(json_value(values))


def compare(
    candidates: Mapping[str, Candidate],
    runs: Iterable[Trajectory],
    output: str | Path,
    *,
    validation: Iterable[Trajectory] | None = None,
    hold_out: float | HoldOut = HOLD_OUT,
    jobs: int | None = None,
) -> Ranking:
    """Fit candidate structures and rank them on rollouts over validation runs.

    Candidates whose results already lie in `output`, made of the same settings and runs by the
    same version, are kept. In a script, call it below ``if __name__ == "__main__":``, because
    its workers import the script.

    Parameters
    ----------
    candidates
        By name. The first one's way to take rates from the record is that of the reference, and
        its seed decides which runs are held out.
    runs
        Runs to train with.
    output
        Folder for the models (one folder per candidate) and results (one JSON file each).
    validation
        Runs to rank by; those that are among `runs` are not trained with. None holds out some
        of `runs`.
    hold_out
        Share of the runs that is held out where there is no `validation`, at least one; or a
        `HoldOut` of one split, which leaves out whole operating points. Of one run it is the
        share that is last in time.
    jobs
        Number of processes; None takes half the processors. With one, all is done in this one.

    Returns
    -------
    Ranking

    Raises
    ------
    DfsmError
        Candidates that cannot be compared, too short a single run, or a folder that cannot be used.
        A candidate that cannot be fitted is listed with its reason instead.
    """
    states = check_candidates(candidates)
    output = Path(output)
    check_output(output, candidates)
    training, judged = _shares(runs, validation, hold_out, next(iter(candidates.values())))
    course = Course.of(training, judged, next(iter(candidates.values())).settings)
    with locked(output):
        output.mkdir(exist_ok=True)
        outcomes, kept = _outcomes(candidates, course, output, jobs)
    entries = [
        RankedCandidate(
            name=name,
            changes=candidate.changes,
            outcome=outcomes[name],
            score=_score(outcomes[name], states),
            folder=None if outcomes[name].message else output / name,
            kept=name in kept,
        )
        for name, candidate in candidates.items()
    ]
    return Ranking(
        candidates=tuple(sorted(entries, key=_place)),
        states=states,
        training=tuple(r.name for r in training),
        validation=tuple(r.name for r in judged),
    )


def check_candidates(candidates: Mapping[str, Candidate]) -> tuple[str, ...]:
    """Refuse what cannot be compared; return the names of the states that all have.

    Raises
    ------
    DfsmError
        Fewer than two candidates, a name that is no folder's, no common state, other windows.
    """
    if len(candidates) < 2:
        raise DfsmError(
            f"{len(candidates)} candidates were given to compare, at least 2 are needed"
        )
    for name in candidates:
        if not _NAME.fullmatch(name):
            raise DfsmError(
                f"candidate '{name}' cannot be the name of a folder: use letters, digits, '_', "
                "'+' and '-'"
            )
    if len({n.casefold() for n in candidates}) < len(candidates):
        raise DfsmError("two candidates differ only in upper and lower case: rename one")
    if len({(c.settings.start, c.settings.stop) for c in candidates.values()}) > 1:
        raise DfsmError("candidates have different start or stop: give all the same window")
    first, *others = (state_names(c.settings.states) for c in candidates.values())
    common = tuple(n for n in first if all(n in names for names in others))
    if not common:
        raise DfsmError("the candidates have no state in common, so nothing ranks them: keep one")
    return common


def check_output(output: Path, candidates: Iterable[str]) -> None:
    """Fail before long work where the results could not be written.

    Raises
    ------
    DfsmError
        Something stands there that is no comparison's, or it cannot be written.
    """
    if not output.exists():
        check_file(output)
        return
    if not output.is_dir():
        raise DfsmError(f"{output} is a file, a folder was expected: choose another name")
    for name in candidates:
        check_target(output / name)
        result = _result_file(output, name)
        check_file(result)
        if result.exists() and _read(result) is None:
            raise DfsmError(
                f"{result} is no result of a comparison: choose another folder or remove it"
            )


# -- what is done ---------------------------------------------------------------------------------


def _outcomes(
    candidates: Mapping[str, Candidate], course: Course, output: Path, jobs: int | None
) -> tuple[dict[str, Outcome], set[str]]:
    """Outcome of every candidate, written as soon as it is known, and the names of those kept."""
    marks = {name: c.fingerprint(course) for name, c in candidates.items()}
    outcomes = {n: kept for n, mark in marks.items() if (kept := _kept(output, n, mark))}
    kept = set(outcomes)
    tasks: list[_Task] = [(n, c) for n, c in candidates.items() if n not in kept]
    jobs = default_jobs() if jobs is None else jobs
    work = work_through(_try_task, course, tasks, jobs)
    for (name, candidate), (outcome, model) in track(work, "candidates", len(tasks)):
        record = {"fingerprint": marks[name], **_account(candidate, course)}
        _write(output, name, outcome, model, record)
        outcomes[name] = outcome
    return outcomes, kept


def _try_task(course: Course, task: _Task) -> tuple[Outcome, DFSM | None]:
    return try_out(course, task[1])


def _shares(
    runs: Iterable[Trajectory],
    validation: Iterable[Trajectory] | None,
    hold_out: float | HoldOut,
    first: Candidate,
) -> tuple[Dataset, Dataset]:
    if validation is None:
        data, settings = Dataset(runs), first.settings
        # One that has to be computed first is left out; the others tell runs apart, too.
        together = [n for n in settings.disturbances if n in data.names]
        how = checked(hold_out, "hold_out")
        require(how.splits == 1, "hold_out.splits", how.splits, "1: candidates are ranked on one")
        if len(data) == 1 and how.by is None:
            return in_time(data[0], how.share, settings.start, settings.stop)
        return divisions(data, how, settings.seed, together, settings.start, settings.stop)[0]
    judged = Dataset(validation)
    digests = {run.digest for run in judged}
    training = [run for run in runs if run.digest not in digests]
    if not training:
        raise DfsmError(
            "all training runs are validation runs too, so none is left to train with: choose "
            "fewer in compare.validation"
        )
    return Dataset(training), judged


def _score(outcome: Outcome, states: Iterable[str]) -> float | None:
    errors = [outcome.nrmse.get(n) for n in states]
    values = [v for v in errors if v is not None]
    if len(values) < len(errors):
        return None
    return float(np.sqrt(np.mean(np.square(values))))


def _place(entry: RankedCandidate) -> tuple[bool, int, float]:
    score = float("inf") if entry.score is None else entry.score
    return entry.status == "failed", entry.outcome.diverged, score


# -- what is written ------------------------------------------------------------------------------


def _result_file(output: Path, name: str) -> Path:
    return output / f"{name}.json"


def _account(candidate: Candidate, course: Course) -> dict[str, Any]:
    """What a reader of a result wants to know besides the outcome."""
    return {
        "changes": candidate.changes,
        "settings": asdict(candidate.settings),
        "refine": None if candidate.refine is None else asdict(candidate.refine),
        "training": [{"name": r.name, "sha256": r.digest} for r in course.training],
        "validation": [{"name": r.name, "sha256": r.digest} for r in course.validation],
    }


def _write(
    output: Path, name: str, outcome: Outcome, model: DFSM | None, record: dict[str, Any]
) -> None:
    """Model first: a result that stands belongs to the model beside it."""
    if model is not None:
        write_or_keep(lambda path: save(model, path), output / name)
    content = {"format": _FORMAT, "outcome": asdict(outcome), "model": _digest(output / name)}
    write_json(_result_file(output, name), signed(content | record))


def _kept(output: Path, name: str, fingerprint: str) -> Outcome | None:
    """The outcome of an earlier comparison if it still holds; removes what a killed one left."""
    recover(output / name)
    for left in output.glob(f".{name}.*"):
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)
    content = _read(_result_file(output, name))
    if content is None or content.get("fingerprint") != fingerprint:
        return None
    outcome: Outcome = content["outcome"]
    # One that failed is cheap to try again, and the reason may be gone.
    if outcome.message or content.get("model") != _digest(output / name):
        return None
    try:
        load(output / name)
    except DfsmError:
        return None
    return outcome


def _read(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] not in (1, _FORMAT) or not is_as_written(content, _UNSIGNED):
            return None
        return content | {"outcome": TypeAdapter(Outcome).validate_python(content["outcome"])}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _digest(folder: Path) -> str | None:
    try:
        return hashlib.sha256((folder / MANIFEST).read_bytes()).hexdigest()
    except OSError:
        return None

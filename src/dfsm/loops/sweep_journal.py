"""What a sweep keeps of its loops, each as soon as it is closed: one that was ended goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from dfsm.core.files import write_file
from dfsm.core.types import Array
from dfsm.errors import DfsmError
from dfsm.loops.extremes import channel_maxima
from dfsm.loops.load_cases import Figures, case_figures
from dfsm.simulation.closed_loop import ClosedLoopRun, LoopStatus

_HEAD = {"format": 1, "holds": "closed loops of a sweep"}


@dataclass(frozen=True)
class SweptLoop:
    """What a sweep keeps of one closed loop.

    Attributes
    ----------
    span
        First and last time in s.
    ending
        One sentence, if it ended early.
    figures
        By channel; None if it ended early.
    maxima
        Of blocks, by channel, of those that are extrapolated.
    """

    span: tuple[float, float]
    ending: str | None
    figures: Mapping[str, Figures] | None
    maxima: Mapping[str, Array]

    @classmethod
    def of(
        cls, loop: ClosedLoopRun, names: Sequence[str], extremes: Sequence[str], block: float
    ) -> SweptLoop:
        """All that is asked of it: figures of channels, and maxima of blocks of so many s."""
        run = loop.trajectory
        span = (float(run.time[0]), float(run.time[-1]))
        if loop.status is not LoopStatus.COMPLETED:
            return cls(span, f"{run.name}: {loop.message}", None, {})
        maxima = channel_maxima(run, extremes, block)
        return cls(span, None, case_figures(run.select(names)), maxima)

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> SweptLoop:
        """The loop that a line of a journal holds."""
        figures = values["figures"]
        return cls(
            (float(values["span"][0]), float(values["span"][1])),
            values["ending"],
            None if figures is None else {n: Figures(**f) for n, f in figures.items()},
            {name: np.array(part, dtype=float) for name, part in values["maxima"].items()},
        )

    def line(self, key: str) -> str:
        """The loop as a line of a journal; its numbers come back to the last digit."""
        figures = None if self.figures is None else {n: asdict(f) for n, f in self.figures.items()}
        maxima = {name: part.tolist() for name, part in self.maxima.items()}
        values = {"key": key, "span": self.span, "ending": self.ending}
        return json.dumps(values | {"figures": figures, "maxima": maxima}) + "\n"


class SweepJournal:
    """A file of closed loops, one a line, by the digest of all that each depends on.

    Parameters
    ----------
    path
        Made if need be. Loops that are not `wanted` are taken out of it, as is a line in whose
        middle a process was ended.
    wanted
        Digests of the loops that are asked for.

    Raises
    ------
    DfsmError
        The file is something else, or cannot be written.
    """

    def __init__(self, path: str | Path, wanted: set[str]) -> None:
        self.path, self._lock = Path(path), Lock()
        self.known: dict[str, SweptLoop] = {}
        if self.path.exists():
            self._read(wanted)
        with write_file(self.path) as temporary, temporary.open("w", encoding="utf-8") as stream:
            stream.write(json.dumps(_HEAD) + "\n")
            stream.writelines(loop.line(key) for key, loop in self.known.items())

    def _read(self, wanted: set[str]) -> None:
        try:
            head, *lines = self.path.read_text(encoding="utf-8", errors="replace").splitlines()
            ours = json.loads(head) == _HEAD
        except OSError as error:
            raise DfsmError(f"{self.path} cannot be read ({error.strerror})") from error
        except ValueError:
            ours, lines = self.path.stat().st_size == 0, []
        if not ours:
            raise DfsmError(
                f"{self.path} holds no loops of a sweep: choose another name for its journal"
            )
        for line in lines:
            try:
                values = json.loads(line)
                if values["key"] in wanted:
                    self.known[values["key"]] = SweptLoop.read(values)
            except (ValueError, KeyError, TypeError, IndexError, AttributeError):
                continue

    def add(self, key: str, loop: SweptLoop) -> None:
        """Keep a loop; from any thread.

        Raises
        ------
        DfsmError
            The file cannot be written.
        """
        try:
            with self._lock, self.path.open("a", encoding="utf-8") as stream:
                stream.write(loop.line(key))
        except OSError as error:
            raise DfsmError(f"{self.path} cannot be written ({error.strerror})") from error

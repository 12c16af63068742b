"""The loops of a sweep: which of them are known from before, and the others closed."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from dfsm.controllers.controller import Controller
from dfsm.core.files import json_value
from dfsm.core.settings import require_kind
from dfsm.data.trajectory import Trajectory
from dfsm.loops.fingerprint import ControllerDigests, digest, model_digest, run_digest
from dfsm.loops.sweep_journal import SweepJournal, SweptLoop
from dfsm.models.dfsm import DFSM
from dfsm.simulation.closed_loop import ClosedLoopRun, reduced_loops

if TYPE_CHECKING:
    from dfsm.loops.sweep import SweepSettings


@dataclass(frozen=True)
class SweepLoops:
    """The loops of a sweep: every controller over every run."""

    model: DFSM
    runs: Sequence[Trajectory]
    controllers: Sequence[Controller]
    measurements: Mapping[str, str] | None
    settings: SweepSettings

    def closed(self, path: str | PathLike[str] | None) -> list[list[SweptLoop]]:
        """What is kept of each, per controller in the order of the runs.

        Parameters
        ----------
        path
            Of the journal; None for none.

        Raises
        ------
        DfsmError
            As `closed_loop`, or the journal is something else.
        """
        if path is None:
            return self._each({}, lambda *_: None)
        require_kind("journal", path, str | PathLike, "the path of a file, or None")
        keys = self._keys()
        journal = SweepJournal(Path(path), set(keys.values()))
        known = {at: journal.known[key] for at, key in keys.items() if key in journal.known}

        def keep(at: tuple[int, int], loop: SweptLoop) -> None:
            if at in keys:
                journal.add(keys[at], loop)

        return self._each(known, keep)

    def _each(
        self,
        known: Mapping[tuple[int, int], SweptLoop],
        keep: Callable[[tuple[int, int], SweptLoop], None],
    ) -> list[list[SweptLoop]]:
        s, signals = self.settings, self.model.signals
        # Latent states have no unit to be told in.
        names = [c.name for c in (*signals.observed, *signals.controls, *signals.outputs)]

        def reduced(loop: ClosedLoopRun, at: tuple[int, int]) -> SweptLoop:
            found = SweptLoop.of(loop, names, s.extremes, s.block)
            keep(at, found)
            return found

        return reduced_loops(
            self.model,
            self.runs,
            self.controllers,
            reduced,
            window=(s.start, s.stop),
            measurements=self.measurements,
            settings=s.loop,
            known=known,
        )

    def _keys(self) -> dict[tuple[int, int], str]:
        """Digest of all that each loop depends on, by run and controller; of those that tell it."""
        s = self.settings
        asked = [s.start, s.stop, s.block, s.loop.start_up, s.loop.step, list(s.extremes)]
        of_all = digest(model_digest(self.model), json.dumps(json_value(asked)))
        digests = ControllerDigests()
        laws = [digests.of(c, self.measurements) for c in self.controllers]
        runs = [run_digest(run) for run in self.runs]
        return {
            (i, k): digest(of_all, run, law)
            for i, run in enumerate(runs)
            for k, law in enumerate(laws)
            if law is not None
        }

"""Figures of closed loops over all runs and their exact slopes, for values of the parameters."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dfsm.controllers.gains import with_numbers
from dfsm.controllers.traced import as_arrays, is_compiled
from dfsm.controllers.tunable import Tunable
from dfsm.core.types import Array
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.loops.fingerprint import recorded_code
from dfsm.loops.measures import Measure
from dfsm.models.dfsm import DFSM
from dfsm.models.staged import staged
from dfsm.simulation.closed_loop import (
    ClosedLoopRun,
    LoopStatus,
    result_of,
)
from dfsm.simulation.loop import Drive, outside_along, roll, roll_compiled
from dfsm.simulation.loop import Path as LoopPath
from dfsm.simulation.loop_cases import (
    ClosedLoopSettings,
    LoopCase,
    checked_loops,
    enough_calls,
    padded,
    prepared_cases,
)
from dfsm.simulation.loop_slopes import roll_with_slopes
from dfsm.simulation.wires import connect


@dataclass(frozen=True, eq=False)
class Figured:
    """Figures of the loops at one point.

    Attributes
    ----------
    theta
        Values of the parameters, shape ``(parameter,)``.
    figures
        Shape ``(measure, run)``; not a number where a loop ended early.
    slopes
        Shape ``(measure, run, parameter)``; None where they were not asked for.
    endings
        One sentence per loop that ended early.
    """

    theta: Array
    figures: Array
    slopes: Array | None
    endings: tuple[str, ...]

    @property
    def stable(self) -> bool:
        """Whether every loop came to its end."""
        return not self.endings


class Evaluator:
    """Closed loops of a tunable controller on a model over some runs.

    What was computed once is not computed again, in a later call with the same journal neither: an
    optimization that was interrupted goes on where it stood.

    Parameters
    ----------
    model
        The surrogate.
    runs
        What drives it.
    tuned
        The controller with its free parameters.
    measures
        What is asked of each loop.
    window
        Start and stop of what is scored in s.
    loop
        How loops are closed.
    measurements
        As for `closed_loop`.

    Raises
    ------
    DfsmError
        As `closed_loop`; or a controller that JAX cannot follow.
    """

    def __init__(
        self,
        model: DFSM,
        runs: Sequence[Trajectory],
        tuned: Tunable,
        measures: Sequence[Measure],
        *,
        window: tuple[float | None, float | None] = (None, None),
        loop: ClosedLoopSettings | None = None,
        measurements: Mapping[str, str] | None = None,
    ) -> None:
        runs = checked_loops(model, runs, [tuned.controller], measurements, loop)
        if not is_compiled(tuned.controller):
            raise DfsmError(
                f"{type(tuned.controller).__name__} is no equinox module, so JAX cannot "
                "differentiate it: write it as one, or tune ROSCO in JAX instead of a library"
            )
        self.model, self.tuned, self.measures = model, tuned, tuple(measures)
        self.wires = connect(model, tuned.controller, measurements)
        settings = loop or ClosedLoopSettings()
        interval = float(tuned.controller.interval)
        self.cases = prepared_cases(model, runs, interval, window, settings)
        self.runs = [case.record for case in self.cases]
        self._ready = staged(model)
        calls = enough_calls(*self.cases)
        self._drives = [padded(case, calls) for case in self.cases]
        self._controller = as_arrays(tuned.controller)
        self._known: dict[tuple[float, ...], Figured] = {}
        self._journal: Path | None = None
        # Whether a point that is known is not computed again.
        self.remember = True
        self.evaluations = self.gradients = 0

    def keep(self, journal: Path) -> None:
        """Take over what a journal holds, one evaluation a line, and add to it from now on."""
        if journal.exists():
            text = journal.read_text(encoding="utf-8", errors="replace")
            for line in text.splitlines()[1:]:
                if (found := _from_line(line)) is not None:
                    self._know(found)
            if text and not text.endswith("\n"):
                # The line in whose middle a process was ended; the next begins one of its own.
                with journal.open("a", encoding="utf-8") as stream:
                    stream.write("\n")
        self._journal = journal

    def __call__(self, theta: Array, slopes: bool = False) -> Figured:
        """Figures at a point, and their slopes if asked for."""
        key = tuple(float(t) for t in theta)
        known = self._known.get(key) if self.remember else None
        if known is not None and (known.slopes is not None or not slopes or not known.stable):
            return known
        self.evaluations += 1
        self.gradients += slopes
        numbers = self.tuned.numbers(list(jnp.asarray(theta)))
        ways = self.tuned.directions(np.asarray(theta)) if slopes else None
        indices = range(len(self.cases))
        # XLA keeps a loop on one core.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            done = list(pool.map(lambda i: self._run(i, numbers, ways), indices))
        found = Figured(
            np.array(key),
            np.array([d[0] for d in done]).T.reshape(len(self.measures), -1),
            np.stack([d[1] for d in done], axis=1) if slopes else None,
            tuple(d[2] for d in done if d[2]),
        )
        self._know(found)
        found = self._known[key]
        if self._journal is not None:
            with self._journal.open("a", encoding="utf-8") as stream:
                stream.write(_line(found))
        return found

    def _know(self, found: Figured) -> None:
        """Remember figures; the first of a point stay, to which slopes come later.

        With slopes the loop is another program, whose last digit may differ: a search that goes on
        must see what it saw before.
        """
        key = tuple(found.theta.tolist())
        before = self._known.get(key)
        if before is not None and before.stable and found.stable:
            found = replace(found, figures=before.figures)
        self._known[key] = found

    def computed(self) -> tuple[Any, ...]:
        """What is computed in a loop, see `recorded_code`."""
        return recorded_code(roll, self.model, self.wires, self._controller, self._drives[0])

    def held(self, channel: str) -> float:
        """Seconds for which the controller holds a command; 0 for what it does not set."""
        commanded = channel in self.tuned.controller.commands
        return float(self.tuned.controller.interval) if commanded else 0.0

    def loops(self, theta: Array) -> list[ClosedLoopRun]:
        """The closed loops themselves at a point."""
        controller = self.tuned.at(theta)
        numbers = as_arrays(controller)

        def rolled(drive: Drive) -> LoopPath:
            path = roll_compiled(self._ready, self.wires, numbers, drive)
            return path._replace(outside=outside_along(self.model, drive, path))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            paths = list(pool.map(rolled, self._drives))
        return [
            result_of(self.model, self.wires, controller, case, path)
            for case, path in zip(self.cases, paths, strict=True)
        ]

    def _run(
        self, i: int, numbers: dict[str, jax.Array], ways: list[dict[str, jax.Array]] | None
    ) -> tuple[list[float], Array, str]:
        """Figures of one run, their slopes, and how it ended if it did so early."""
        case, drive = self.cases[i], self._drives[i]
        controller, moved = self._controller, None
        if ways is None:
            with_these = with_numbers(controller, numbers)
            path = roll_compiled(self._ready, self.wires, with_these, drive)
        else:
            path, moved = roll_with_slopes(
                self._ready, self.wires, controller, numbers, ways, drive
            )
        ended = result_of(self.model, self.wires, controller, case, path)
        nothing = np.full((len(self.measures), len(self.tuned.names)), np.nan)
        if ended.status is not LoopStatus.COMPLETED:
            told = f"{ended.trajectory.name}: {ended.message}"
            return [np.nan] * len(self.measures), nothing, told
        return *self._figures(case, ended.trajectory, moved), ""

    def _figures(
        self, case: LoopCase, run: Trajectory, moved: jax.Array | None
    ) -> tuple[list[float], Array]:
        s = self.model.signals
        shown = [c.name for c in (*s.observed, *s.controls, *s.outputs)]
        figures, slopes = [], np.zeros((len(self.measures), len(self.tuned.names)))
        ways = None
        if moved is not None:
            steps = np.asarray(moved)[:, : case.rows]
            ways = [case.sampled(way)[case.scored :] for way in steps]
        for m, measure in enumerate(self.measures):
            held = self.held(measure.channel)
            figure, along = measure.along(run.time, run[measure.channel], held)
            figures.append(figure)
            if ways is not None:
                column = shown.index(measure.channel)
                slopes[m] = [along @ way[:, column] for way in ways]
        return figures, slopes


def _line(found: Figured) -> str:
    values: dict[str, Any] = {
        "theta": found.theta.tolist(),
        "figures": None if found.endings else found.figures.tolist(),
        "slopes": None if found.slopes is None or found.endings else found.slopes.tolist(),
        "endings": list(found.endings),
        "shape": list(found.figures.shape),
    }
    return json.dumps(values) + "\n"


def _from_line(line: str) -> Figured | None:
    """What a line holds; None for the one in whose middle a process was ended."""
    try:
        values = json.loads(line)
        shape = tuple(values["shape"])
        figures = np.full(shape, np.nan) if values["figures"] is None else values["figures"]
        slopes = None if values["slopes"] is None else np.array(values["slopes"], dtype=float)
        return Figured(
            np.array(values["theta"], dtype=float),
            np.array(figures, dtype=float),
            slopes,
            tuple(values["endings"]),
        )
    except (ValueError, KeyError, TypeError):
        return None

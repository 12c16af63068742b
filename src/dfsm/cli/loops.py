"""What commands that close loops from a file share: everything that the file names, loaded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from dfsm.cli.closed_loop import controller_of

if TYPE_CHECKING:
    from dfsm.config.loops import LoopsConfig
    from dfsm.controllers.discon import Discon
    from dfsm.data.trajectory import Trajectory
    from dfsm.models.dfsm import DFSM


class Loaded(NamedTuple):
    """A model, runs, a controller, and the DISCON.IN behind it if there is one."""

    model: DFSM
    runs: list[Trajectory]
    controller: Any
    discon: Discon | None


def loaded(config: LoopsConfig, folder: Path) -> Loaded:
    """Load what a file names; its paths count from a folder.

    Raises
    ------
    DfsmError
        Something is missing, or is not what it should be.
    """
    from dfsm.controllers.discon import read_discon
    from dfsm.controllers.rosco import ROSCO
    from dfsm.core.settings import require
    from dfsm.data.readers import read_all
    from dfsm.models.model_folder import load

    model = load(folder / config.model)
    named = [config.runs] if isinstance(config.runs, str) else config.runs
    require(bool(named), "runs", "empty", "at least one result file or pattern")
    runs = read_all(named, folder)
    path = str(folder / config.controller)
    controller = controller_of(path, None, config.interval, runs[0].time_step, "interval")
    python = config.controller.rpartition(":")[0].endswith(".py")
    own = isinstance(controller, ROSCO) and not python
    deck = read_discon(folder / config.controller) if own else None
    return Loaded(model, runs, controller, deck)

"""The command that closes the loop on a model; `cli` puts it beside the others."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dfsm.cli.targets import check_page, check_spared
from dfsm.cli.terminal import AsJson, Files, Quiet, fit_start, print_json, say, working
from dfsm.errors import DfsmError, hushed, near_matches

if TYPE_CHECKING:
    from dfsm.controllers.controller import Controller
    from dfsm.data.trajectory import Trajectory
    from dfsm.validation.closed_loop import ClosedLoopValidation

_FIGURES = "closed_loop.json"
_HOLDS = "--controller names a DISCON.IN, or a Python file and what it holds as in control.py:mine"


def closed_loop(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    files: Files,
    controller: Annotated[
        str, typer.Option(help="ROSCO's DISCON.IN, or file.py:name of a controller of your own.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for one Parquet file per run.")
    ],
    library: Annotated[
        Path | None,
        typer.Option(help="Bladed-style library that reads the DISCON.IN; default ROSCO in JAX."),
    ] = None,
    interval: Annotated[
        float | None,
        typer.Option(
            help="Seconds between two calls of ROSCO or a library; default the runs' samples."
        ),
    ] = None,
    measure: Annotated[
        list[str] | None,
        typer.Option(
            help="Signal of the model that stands for a measurement: "
            "NcIMURAys=PtfmPitch_dot_dot. Several times if need be."
        ),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
    start: Annotated[
        float | None, typer.Option(help="Start of the scored time in s; default as in the fit.")
    ] = None,
    stop: Annotated[float | None, typer.Option(help="End of the scored time in s.")] = None,
    start_up: Annotated[
        float, typer.Option(help="Seconds that the loop runs before what is scored.")
    ] = 60.0,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Close the loop between a model and a controller, and compare with what was recorded."""
    from dfsm.cli.tables import print_article
    from dfsm.core.bundle import check_no_bundle
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import check_together
    from dfsm.data.apart import require_apart
    from dfsm.data.readers import read_all
    from dfsm.models.model_folder import load
    from dfsm.report.article_page import write_article
    from dfsm.report.closed_loop_article import closed_loop_article
    from dfsm.simulation.loop_cases import ClosedLoopSettings
    from dfsm.validation.closed_loop import validate_closed_loop

    if report is not None:
        check_page(report)
    settings = ClosedLoopSettings(start_up=start_up)
    stand_ins = pairs(measure or [])
    surrogate = load(model)
    start = fit_start(surrogate) if start is None else start
    with working(quiet), hushed():  # the outcome is printed below
        check_no_bundle(output)
        runs = read_all(files)
        targets = [_file(run) for run in runs]
        require_apart(runs, [output / target for target in targets])
        check_together(output, [*targets, _FIGURES])
        kept = [output / target for target in targets if (output / target).exists()]
        check_spared([*kept, report], model, surrogate, [run.source for run in runs])
        law = controller_of(controller, library, interval, runs[0].time_step)
        validation = validate_closed_loop(
            surrogate,
            runs,
            law,
            start=start,
            stop=stop,
            measurements=stand_ins,
            settings=settings,
        )
    write_or_keep(lambda path: _save(validation, path), output)
    article = closed_loop_article(validation, model.name or str(model), controller)
    if report is not None:
        write_or_keep(lambda path: write_article(article, path), report)
    if as_json:
        print_json(validation.to_dict())
    elif not quiet:
        # The page tells each run.
        print_article(replace(article, sections=article.sections[:2]))
        if kept := [n for n in surrogate.signals.names("controls") if n not in law.commands]:
            say(f"the controller does not set {', '.join(kept)}: as recorded", quiet)
        say(f"wrote {output} ({len(runs)} runs) and {output / _FIGURES}", quiet)
        if report is not None:
            say(f"wrote {report}", quiet)
    for text in validation.endings():
        if not quiet:
            print(text, file=sys.stderr)
    if validation.completed < len(validation.runs):
        raise typer.Exit(1)


def _file(run: Trajectory) -> str:
    return f"{run.name}.parquet"


def _save(validation: ClosedLoopValidation, path: Path) -> None:
    """Write the runs' signals and the figures in one step."""
    from dfsm.core.files import write_json, write_together
    from dfsm.data.readers.tables import write_table

    with write_together(path) as folder:
        for compared in validation.runs:
            write_table(compared.loop.trajectory, folder / _file(compared.recorded))
        write_json(folder / _FIGURES, validation.to_dict())


def pairs(texts: list[str]) -> dict[str, str]:
    """Signal of the model by measurement, from ``NcIMURAys=PtfmPitch_dot_dot`` and the like."""
    found = dict[str, str]()
    for text in texts:
        name, sign, signal = text.partition("=")
        if not (name and sign and signal):
            raise DfsmError(
                f"--measure is '{text}', expected a measurement and a signal of the model as in "
                "NcIMURAys=PtfmPitch_dot_dot"
            )
        found[name] = signal
    return found


def controller_of(
    text: str,
    library: Path | None,
    interval: float | None,
    sampled: float | None,
    told: str = "--interval",
) -> Controller:
    """ROSCO, a library, or an object of a Python file.

    Parameters
    ----------
    text
        A DISCON.IN, or a Python file and what it holds.
    library
        Reads the DISCON.IN; None for ROSCO in JAX.
    interval
        Seconds between two calls; None takes the runs' sampling interval `sampled`, if they have
        one.
    told
        What the interval is called where it is set.

    Raises
    ------
    DfsmError
        There is no such controller, or a library or an interval for one in Python.
    """
    path, sign, name = text.rpartition(":")
    if sign and path.endswith(".py"):
        if library is not None:
            raise DfsmError("--library goes with a DISCON.IN, not with a controller in Python")
        if interval is not None:
            raise DfsmError(
                f"{told} goes with a DISCON.IN, not with a controller in Python, which has an "
                f"interval of its own: set it in {path}, and leave {told} out"
            )
        return _own(Path(path), name)
    if text.endswith(".py"):
        raise DfsmError(f"--controller is '{text}' without a name: {_HOLDS}")
    interval = sampled if interval is None else interval
    if interval is None:
        raise DfsmError(f"the runs have no common sampling interval: set the controller's {told}")
    if library is not None:
        from dfsm.controllers.bladed import BladedLibrary

        return BladedLibrary(library, Path(text), interval=interval)
    from dfsm.controllers.rosco import read_rosco

    return read_rosco(text, interval=interval)


def _own(path: Path, name: str) -> Controller:
    from dfsm.controllers.controller import require_controller
    from dfsm.core.files import existing_file

    path = existing_file(path)
    # A name of its own: a file control.py must not stand for the package of that name.
    own = f"dfsm_controller_{path.stem}"
    spec = importlib.util.spec_from_file_location(own, path)
    if spec is None or spec.loader is None:
        raise DfsmError(f"{path} is no Python file: {_HOLDS}")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[own] = module
    try:
        spec.loader.exec_module(module)
    except DfsmError:
        raise
    except Exception as error:
        raise DfsmError(f"{path} fails with {type(error).__name__}: {error}") from None
    if not hasattr(module, name):
        known = [n for n in vars(module) if not n.startswith("_")]
        raise DfsmError(f"{path} holds no '{name}'; {near_matches(name, known)}")
    found = getattr(module, name)
    if isinstance(found, type):
        try:
            found = found()
        except DfsmError:
            raise
        except Exception as error:
            raise DfsmError(
                f"'{name}' of {path} is a class that fails with {type(error).__name__}: {error}; "
                f"name an object of it, as in mine = {name}(…)"
            ) from None
    require_controller(found, f"'{name}' of {path}")
    return found

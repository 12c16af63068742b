"""The command `dfsm tune`: gains of a controller, made better on a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dfsm.cli.closed_loop import controller_of
from dfsm.cli.terminal import AsJson, Quiet, fit_start, lines, print_json, say, working
from dfsm.errors import hushed

if TYPE_CHECKING:
    from dfsm.loops.tuning import TuningTask


def tune(
    config: Annotated[
        Path, typer.Argument(help="YAML file: model, controller, runs, parameters, objective.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Tune a controller's gains on a model; goes on where it was ended."""
    from dfsm.core.lock import locked
    from dfsm.loops.tuning_folder import check_tuning_target, open_journal, save_tuning
    from dfsm.loops.tuning_result import TuneStatus
    from dfsm.report.tuning_article import tuning_article, write_tuning_page

    check_tuning_target(output)
    with locked(output), working(quiet), hushed():
        task = tuning_task(config)
        known = open_journal(task, output)
        if known:
            say(f"going on with what {output} holds", quiet or as_json)
        result = task.tune()
        save_tuning(task, result, output, write_tuning_page)
    if as_json:
        print_json(result.to_dict())
    elif not quiet:
        from dfsm.cli.tables import print_article

        say(lines(result.message), quiet)
        article = tuning_article(result)
        from dataclasses import replace

        print_article(replace(article, sections=article.sections[:2]))
        say(f"wrote {output}", quiet)
    if result.status in (TuneStatus.UNSTABLE, TuneStatus.INFEASIBLE, TuneStatus.INTERRUPTED):
        raise typer.Exit(1)


def tuning_task(path: Path) -> TuningTask:
    """What a file asks for, prepared.

    Raises
    ------
    DfsmError
        What is wrong with the file, or with what it names.
    """
    from dfsm.config.tune import load_tuning
    from dfsm.controllers.discon import read_discon
    from dfsm.controllers.rosco import ROSCO
    from dfsm.data.readers import read_all
    from dfsm.loops.tuning import TuningTask
    from dfsm.models.model_folder import load

    config, folder = load_tuning(path), path.parent
    model = load(folder / config.model)
    named = [config.runs] if isinstance(config.runs, str) else config.runs
    runs = read_all(named, folder)
    controller = controller_of(
        str(folder / config.controller), None, config.interval or runs[0].time_step
    )
    deck = None
    if isinstance(controller, ROSCO) and not config.controller.partition(":")[0].endswith(".py"):
        deck = read_discon(folder / config.controller)
    return TuningTask(
        model,
        runs,
        controller,
        config.problem(runs),
        deck,
        config.measure,
        config.settings(fit_start(model)),
    )

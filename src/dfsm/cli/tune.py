"""The command `dfsm tune`: gains of a controller, made better on a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dfsm.cli.loops import loaded
from dfsm.cli.terminal import AsJson, Quiet, fit_start, lines, print_json, say, working
from dfsm.errors import hushed

if TYPE_CHECKING:
    from dfsm.loops.trust_region import ConfirmedTuning
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
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.lock import locked
    from dfsm.loops.tuning_folder import (
        check_tuning_target,
        open_journal,
        save_tuning,
        tuning_values,
    )
    from dfsm.loops.tuning_result import TuneStatus
    from dfsm.report.tuning_article import tuning_article, write_tuning_page

    check_tuning_target(output)
    with locked(output), working(quiet), hushed():
        task = tuning_task(config)
        known = open_journal(task, output)
        confirmed = _confirmed(config, task)
        result = task.tune() if confirmed is None else task.given(confirmed.values)
        write_or_keep(
            lambda path: save_tuning(task, result, path, write_tuning_page, confirmed), output
        )
    if as_json:
        print_json(tuning_values(result, confirmed))
    elif not quiet:
        from dfsm.cli.tables import print_article

        say(lines(result.message if confirmed is None else confirmed.summary()), quiet)
        article = tuning_article(result)
        from dataclasses import replace

        print_article(replace(article, sections=article.sections[:3]))
        say(f"wrote {output}{', going on with what it held' if known else ''}", quiet)
    if result.status in (TuneStatus.UNSTABLE, TuneStatus.INFEASIBLE, TuneStatus.INTERRUPTED):
        raise typer.Exit(1)


def _confirmed(path: Path, task: TuningTask) -> ConfirmedTuning | None:
    """Tune with the runs that were flown, where the file names a folder of them."""
    from dfsm.config.tune import load_tuning
    from dfsm.loops.trust_region import tune_with_truth
    from dfsm.loops.truth import FlownRuns

    truth = load_tuning(path).truth
    if truth is None:
        return None
    return tune_with_truth(task, FlownRuns(path.parent / truth.folder), truth.settings())


def tuning_task(path: Path) -> TuningTask:
    """What a file asks for, prepared.

    Raises
    ------
    DfsmError
        What is wrong with the file, or with what it names.
    """
    from dfsm.config.tune import load_tuning
    from dfsm.loops.tuning import TuningTask

    config = load_tuning(path)
    found = loaded(config, path.parent)
    return TuningTask(
        found.model,
        found.runs,
        found.controller,
        config.problem(found.runs),
        found.discon,
        config.measure,
        config.settings(fit_start(found.model)),
    )

"""The command `dfsm calibrate`: prediction intervals of a saved model, as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.terminal import (
    Files,
    ParameterFile,
    Quiet,
    as_in_fit,
    fit_start,
    parametrized,
    say,
    tell_notes,
    working,
)


def calibrate(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    files: Files,
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")],
    level: Annotated[
        float, typer.Option(help="Share of the time that a new run is to lie inside.")
    ] = 0.9,
    start: Annotated[float | None, typer.Option(help="Start in s; default as in the fit.")] = None,
    stop: Annotated[float | None, typer.Option(help="End in s.")] = None,
    parameters: ParameterFile = None,
    quiet: Quiet = False,
) -> None:
    """Find how far off rollouts are, on runs that had no part in the fit; at least three."""
    from dfsm.cli.tables import print_intervals
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import check_file
    from dfsm.data.readers import read_all
    from dfsm.models.model_folder import load
    from dfsm.validation.calibrate import calibrate as run_calibrate

    check_file(output)
    surrogate = load(model)
    start = fit_start(surrogate) if start is None else start
    with working(quiet):
        runs = as_in_fit(surrogate, parametrized(read_all(files), parameters))
        tell_notes(runs, quiet)
        check_file(output, [*model.iterdir(), parameters, *(run.source for run in runs)])
        intervals = run_calibrate(surrogate, runs, level=level, start=start, stop=stop)
    write_or_keep(intervals.save, output)
    if not quiet:
        print_intervals(intervals)
    say(f"wrote {output}: give it to dfsm simulate or validate as --intervals {output}", quiet)

"""The command `dfsm calibrate`: prediction intervals of a saved model, as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.targets import check_json, check_spared
from dfsm.cli.terminal import (
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
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")],
    files: Annotated[
        list[str] | None,
        typer.Argument(help="Result files or patterns of runs that the fit never saw."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Instead of files: config.yaml of the fit. Models are fitted without some of its "
            "runs each, which takes as long as about six fits."
        ),
    ] = None,
    level: Annotated[
        float, typer.Option(help="Share of the time that a new run is to lie inside.")
    ] = 0.9,
    start: Annotated[float | None, typer.Option(help="Start in s; default as in the fit.")] = None,
    stop: Annotated[float | None, typer.Option(help="End in s.")] = None,
    parameters: ParameterFile = None,
    quiet: Quiet = False,
) -> None:
    """Find how far off rollouts are, on runs that had no part in the fit: new ones, at least three.

    With --config on training runs, each with a model that was fitted without it.
    """
    from dfsm.cli.tables import print_intervals
    from dfsm.config.fit import load_config
    from dfsm.core.fallback import write_or_keep
    from dfsm.data.readers import read_all
    from dfsm.errors import DfsmError
    from dfsm.models.model_folder import load
    from dfsm.selection.left_out import check_is_of, cross_calibrate
    from dfsm.validation.calibrate import calibrate as run_calibrate

    check_json(output, "a file of intervals")
    surrogate = load(model)
    start = fit_start(surrogate) if start is None else start
    if (config is None) == (not files):
        raise DfsmError(
            "intervals are calibrated on runs that the fit never saw, or with --config on its "
            "training runs: give either files or --config"
        )
    with working(quiet):
        if config is None:
            runs = as_in_fit(surrogate, parametrized(read_all(files or []), parameters))
            tell_notes(runs, quiet)
            sources = [parameters, *(run.source for run in runs)]
            check_spared([output], model, surrogate, sources)
            intervals = run_calibrate(surrogate, runs, level=level, start=start, stop=stop)
        else:
            known, runs = load_config(config)
            tell_notes(runs, quiet)
            sources = [config, *(run.source for run in runs)]
            check_spared([output], model, surrogate, sources, known.data.step)
            check_is_of(surrogate, runs, config)
            intervals = cross_calibrate(
                surrogate, runs, known.fit_settings(), known.refine, level=level
            )
    write_or_keep(intervals.save, output)
    if not quiet:
        print_intervals(intervals)
    say(f"wrote {output}: give it to dfsm simulate or validate as --intervals {output}", quiet)

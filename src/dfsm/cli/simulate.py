"""The command `dfsm simulate`: one run through a model, with its own inputs or others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.targets import check_spared
from dfsm.cli.terminal import (
    AsJson,
    Interpolation,
    IntervalFile,
    Method,
    ParameterFile,
    Quiet,
    SampleStepAlone,
    Step,
    as_in_fit,
    exit_if_ended,
    fit_start,
    marching,
    parametrized,
    print_json,
    say,
    tell_notes,
    working,
)
from dfsm.errors import hushed


def simulate(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    run: Annotated[str, typer.Argument(help="File with the inputs and the initial state.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parquet or CSV file to write.")],
    start: Annotated[float | None, typer.Option(help="Start in s; default as in the fit.")] = None,
    stop: Annotated[float | None, typer.Option(help="End in s.")] = None,
    method: Method = "rk4",
    step: Step = None,
    sample_step: SampleStepAlone = None,
    interpolation: Interpolation = None,
    intervals: IntervalFile = None,
    parameters: ParameterFile = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", help='Change a channel: "NAME = 2", or +=, -=, *=; run\'s units.'),
    ] = None,
    inputs: Annotated[
        str | None, typer.Option(help="Table whose columns replace inputs of the run.")
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Simulate the model with the inputs of one run, or others, and write states and outputs."""
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import check_file
    from dfsm.data.readers import read
    from dfsm.data.readers.tables import table_suffix, write_table
    from dfsm.models.completion import completed
    from dfsm.models.model_folder import load
    from dfsm.models.what_if import with_changes, with_inputs
    from dfsm.simulation.simulate import simulate as run_simulate
    from dfsm.validation.intervals import load_intervals

    settings = marching(method, step, interpolation)
    every = step if sample_step is None else sample_step
    table_suffix(output)
    check_file(output)
    surrogate = load(model)
    check_spared([output], model, surrogate, [run, inputs, intervals, parameters], every)
    start = fit_start(surrogate) if start is None else start
    calibrated = None if intervals is None else load_intervals(intervals)
    if calibrated is not None:
        calibrated.check(surrogate)
    with working(quiet):
        (recorded,) = as_in_fit(surrogate, parametrized([read(run, every)], parameters))
        tell_notes([recorded], quiet)
        if inputs is not None:
            recorded = with_inputs(recorded, read(inputs), surrogate.signals, start, stop)
        recorded = with_changes(recorded, changes or (), surrogate.signals)
        recorded = completed(recorded, surrogate.signals)
    with working(quiet), hushed():  # the outcome is printed below
        result = run_simulate(
            surrogate,
            recorded,
            start=start,
            stop=stop,
            settings=settings,
        )
    table = result.trajectory if calibrated is None else calibrated.beside(result, recorded)
    write_or_keep(lambda path: write_table(table, path), output)
    if as_json:
        print_json(
            {
                "status": result.status.name.lower(),
                "message": result.message,
                "ended_s": result.ended,
                "outside": result.outside,
                "wall_time_s": result.wall_time,
                "output": str(output),
            }
        )
    else:
        say(f"wrote {output} ({len(result.trajectory)} samples): {result.message}", quiet)
    exit_if_ended([result], quiet or as_json)

"""`dfsm export KIND`: models in the files of other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.targets import check_spared
from dfsm.cli.terminal import Quiet, SampleStepAlone, as_in_fit, lines, say, tell_notes, working

exports = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="A model in the files of other programs."
)
Model = Annotated[Path, typer.Argument(help="Model folder.")]
File = Annotated[Path, typer.Option("--output", "-o", help="File to write.")]
Folder = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")]
Name = Annotated[str | None, typer.Option(help="Prefix of all names; default the folder's.")]


@exports.command("state-space")
def state_space(
    model: Model,
    output: File,
    at: Annotated[
        str | None,
        typer.Option(
            help="Schedule values, 8,10,12; default the operating points of the training data."
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Linearizations at steady states: .mat for MATLAB and Simulink, or .json."""
    from dfsm.exports.functions import computed_inputs
    from dfsm.exports.state_space import check_suffix, to_state_space
    from dfsm.models.model_folder import load

    check_suffix(output)
    loaded = load(model)
    check_spared([output], model, loaded)
    made = to_state_space(loaded, None if at is None else at.split(","))
    made.save(output)
    for point in () if quiet else made:
        where = "" if made.schedule is None else f"{made.schedule.name} = {point.schedule:.4g}: "
        say(lines(f"{where}{point.message}"), quiet)
    _tell(f"{output}: {len(made)} linearizations", list(computed_inputs(loaded).values()), quiet)


@exports.command()
def casadi(model: Model, output: File, quiet: Quiet = False) -> None:
    """Functions f and g of CasADi in one file, with exact derivatives."""
    from dfsm.core.files import check_file
    from dfsm.exports.casadi_model import to_casadi
    from dfsm.models.model_folder import load

    check_file(output)
    loaded = load(model)
    check_spared([output], model, loaded)
    functions = to_casadi(loaded)
    functions.save(output)
    _tell(output, functions.description["notes"], quiet)


def _tell(output: Path | str, notes: Sequence[str], quiet: bool) -> None:
    say(lines(f"wrote {output}"), quiet)
    for sentence in notes:
        say(lines(f"note: {sentence}"), quiet)


@exports.command()
def c(model: Model, output: Folder, name: Name = None, quiet: Quiet = False) -> None:
    """One C99 file and its header: f, g, a Runge-Kutta step, names and units."""
    from dfsm.exports.c_code import write_c
    from dfsm.models.model_folder import load

    made = write_c(load(model), output, name)
    _tell(output, made.description["notes"], quiet)


@exports.command()
def python(model: Model, output: Folder, quiet: Quiet = False) -> None:
    """A file of Python that needs NumPy alone, and the model's numbers beside it."""
    from dfsm.exports.python_model import write_python
    from dfsm.models.model_folder import load

    _tell(output, write_python(load(model), output)["notes"], quiet)


@exports.command()
def fmu(
    model: Model,
    output: File,
    fmi: Annotated[int, typer.Option(help="Version of the standard: 2 or 3.")] = 3,
    kind: Annotated[
        str | None, typer.Option(help="model-exchange or co-simulation; default both.")
    ] = None,
    step: Annotated[
        float | None, typer.Option(help="Longest Runge-Kutta step of a co-simulation in s.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """An FMU with sources, and a binary where a C compiler is present."""
    from dfsm.exports.fmu import write_fmu
    from dfsm.models.model_folder import load

    loaded = load(model)
    check_spared([output], model, loaded)
    made = write_fmu(loaded, output, fmi=fmi, kind=kind, step=step)  # pyright: ignore[reportArgumentType]
    what = (
        "sources alone: no C compiler here"
        if made.binary is None
        else f"a binary for {made.binary}"
    )
    _tell(f"{output} ({what})", made.notes, quiet)


@exports.command()
def inputs(
    model: Model,
    run: Annotated[str, typer.Argument(help="File of the run.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parquet or CSV file to write.")],
    start: Annotated[float | None, typer.Option(help="Start in s; default the run's.")] = None,
    stop: Annotated[float | None, typer.Option(help="End in s; default the run's.")] = None,
    sample_step: SampleStepAlone = None,
    quiet: Quiet = False,
) -> None:
    """What a model takes of a run, computed inputs among it: a table to drive an export with."""
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import check_file
    from dfsm.data.readers import read
    from dfsm.data.readers.tables import table_suffix, write_table
    from dfsm.models.model_folder import load
    from dfsm.models.taken import model_inputs

    table_suffix(output)
    check_file(output)
    loaded = load(model)
    check_spared([output], model, loaded, [run], sample_step)
    with working(quiet):
        (recorded,) = as_in_fit(loaded, [read(run, sample_step)])
        tell_notes([recorded], quiet)
        table = model_inputs(loaded, recorded, start=start, stop=stop)
    write_or_keep(lambda path: write_table(table, path), output)
    say(lines(f"wrote {output}: {len(table)} samples of {', '.join(table.names)}"), quiet)

"""`dfsm export KIND`: models in the files of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.terminal import Quiet, lines, say

exports = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="A model in the files of other programs."
)
Model = Annotated[Path, typer.Argument(help="Model folder.")]
File = Annotated[Path, typer.Option("--output", "-o", help="File to write.")]


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
    from dfsm.exports.state_space import check_suffix, to_state_space
    from dfsm.models.model_folder import load

    check_suffix(output)
    made = to_state_space(load(model), None if at is None else at.split(","))
    made.save(output)
    for point in () if quiet else made:
        where = "" if made.schedule is None else f"{made.schedule.name} = {point.schedule:.4g}: "
        say(lines(f"{where}{point.message}"), quiet)
    say(lines(f"wrote {output}: {len(made)} linearizations"), quiet)


@exports.command()
def casadi(model: Model, output: File, quiet: Quiet = False) -> None:
    """Functions f and g of CasADi in one file, with exact derivatives."""
    from dfsm.core.files import check_file
    from dfsm.exports.casadi_model import to_casadi
    from dfsm.models.model_folder import load

    check_file(output)
    functions = to_casadi(load(model))
    functions.save(output)
    _tell(output, functions.description["computed_inputs"], quiet)


def _tell(output: Path, computed: list[str], quiet: bool) -> None:
    say(lines(f"wrote {output}"), quiet)
    for sentence in computed:
        say(lines(f"note: {sentence}"), quiet)

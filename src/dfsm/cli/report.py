"""The command `dfsm report`: a model card."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.targets import check_page, check_spared
from dfsm.cli.terminal import Quiet, lines, say


def report(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="HTML page to write.")],
    quiet: Quiet = False,
) -> None:
    """Write a model card: what taught a model, where it holds, what it is good for."""
    from dfsm.core.fallback import write_or_keep
    from dfsm.models.model_folder import load
    from dfsm.report.model_card import write_model_card

    check_page(output)
    loaded = load(model)
    check_spared([output], model, loaded)
    name = model.resolve().name
    write_or_keep(lambda path: write_model_card(loaded, path, name=name), output)
    say(lines(f"wrote {output}"), quiet)

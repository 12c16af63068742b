"""The command `dfsm sweep`: many gains over many runs, and what each would do over a life."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dfsm.cli.loops import loaded
from dfsm.cli.targets import check_spared
from dfsm.cli.terminal import AsJson, Quiet, fit_start, print_json, say, working
from dfsm.errors import hushed, printable

if TYPE_CHECKING:
    from dfsm.loops.sweep import Sweep
    from dfsm.report.article import Article

_FIGURES, _TABLE, _PAGE = "sweep.json", "sweep.csv", "sweep.html"
# Grows by a line with every loop.
_JOURNAL = "loops.jsonl"


def sweep(
    config: Annotated[Path, typer.Argument(help="YAML file: model, controller, runs, gains.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for sweep.json, sweep.csv, sweep.html.")
    ],
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Close the loop with many gains over many runs: energy, loads; goes on where it was ended."""
    from dfsm.cli.tables import print_article
    from dfsm.config.sweep import load_sweep
    from dfsm.core.bundle import check_no_bundle
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.files import check_together
    from dfsm.core.lock import locked
    from dfsm.loops.sweep import gain_grid
    from dfsm.loops.sweep import sweep as run_sweep
    from dfsm.report.sweep_article import sweep_article

    asked = load_sweep(config)
    check_no_bundle(output)
    check_together(output, [_FIGURES, _TABLE, _PAGE, _JOURNAL])
    with locked(output), working(quiet), hushed():
        found = loaded(asked, config.parent)
        sources = [config, *(run.source for run in found.runs)]
        kept = [output / _TABLE] if (output / _TABLE).exists() else []
        check_spared(kept, config.parent / asked.model, found.model, sources)
        output.mkdir(parents=True, exist_ok=True)
        controllers = gain_grid(found.controller, asked.gains, found.discon)
        swept = run_sweep(
            found.model,
            found.runs,
            controllers,
            weights=asked.shares(found.runs),
            conditions=asked.alike(found.runs),
            measurements=asked.measure,
            settings=asked.settings(fit_start(found.model)),
            journal=output / _JOURNAL,
        )
    article = sweep_article(swept, asked.exponent)
    write_or_keep(lambda path: _save(swept, article, asked.exponent, path), output)
    if as_json:
        print_json(swept.to_dict())
    elif not quiet:
        print_article(article)
        say(f"wrote {output}: {len(controllers)} controllers over {len(found.runs)} runs", quiet)
    ended = [(c.name, text) for c in swept.controllers for text in c.endings]
    for name, text in () if quiet else ended:
        print(printable(f"{name}: {text}"), file=sys.stderr)
    if ended:
        raise typer.Exit(1)


def _save(swept: Sweep, article: Article, exponent: float, path: Path) -> None:
    from dfsm.core.files import write_json, write_together
    from dfsm.report.article_page import write_article

    with write_together(path) as folder:
        write_json(folder / _FIGURES, swept.to_dict())
        swept.table(exponent).to_csv(folder / _TABLE, index_label="controller")
        write_article(article, folder / _PAGE)

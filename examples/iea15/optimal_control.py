"""Optimal control of the floating turbine on surrogates of the bundled runs (Sec. 4 of the paper).

Takes the models that `demo.py` saved and maximises the power over 600 s of wind that the fits never
saw, with the paper's bounds and with those of this turbine, for three limits of the platform pitch.
Writes a page, its tables as JSON, and figures.

    python examples/iea15/optimal_control.py [--models out/] [--output out/]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import demo  # its neighbour
import dfsm
from dfsm.cli.tables import print_article
from dfsm.core.workers import processors
from dfsm.errors import hushed
from dfsm.report.publish import publish
from turbine_article import control_article
from turbine_control import ControlStudy, study
from turbine_problem import Region
from turbine_runs import START, runs, with_rings

# Winds (m/s, as in the file names) and the seeds to optimize for: two in the transition region,
# one below and one above it. What takes longest is first, so that no processor waits for it.
SERIES = {"18": range(9, 10), "12": range(9, 11), "06": range(9, 10)}


def regions(models: Path) -> list[Region]:
    """Models and runs of each region; one model serves all."""
    listed = []
    for wind, seeds in SERIES.items():
        name = f"{float(wind):g} m/s"
        own, best = (dfsm.load(demo.folder(models, label)) for label in (name, demo.REFINED))
        training, tests = (with_rings(runs([wind], of)) for of in (range(1, 9), seeds))
        listed.append(Region(name, float(wind), own, best, training, tests, START))
    return listed


def main(arguments: Sequence[str] | None = None) -> ControlStudy:
    """Optimize, print the tables, write the page and the figures."""
    parser = argparse.ArgumentParser(description="Optimal control on bundled OpenFAST runs.")
    parser.add_argument("--models", type=Path, default=Path("out"), help="folder of demo.py")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the results")
    options = parser.parse_args(arguments)
    missing = [n for n in demo.WINDS if not demo.folder(options.models, n).is_dir()]
    if missing:
        parser.error(
            f"{options.models} holds no model '{missing[0]}': run examples/iea15/demo.py first"
        )
    with dfsm.show_progress(), hushed():  # what they say stands in the tables
        results = study(regions(options.models), jobs=processors())
    article = control_article(results)
    written = publish(article, options.output)
    print_article(article)
    print(f"{results.seconds:.0f} s to solve all; page: {written[0].resolve()}")
    return results


if __name__ == "__main__":
    main(sys.argv[1:])

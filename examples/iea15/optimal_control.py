"""Optimal control of the floating turbine on surrogates of the bundled runs (Sec. 4 of the paper).

Fits the models of the three wind regions as `demo.py` does, and maximises the power over 600 s of
wind that the fits never saw, with the paper's bounds and with those of this turbine, for three
limits of the platform pitch. Writes a page, its tables as JSON, and figures.

    python examples/iea15/optimal_control.py [--output out/] [--quick]
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import dfsm
from dfsm.console import print_article
from dfsm.report.publish import publish
from dfsm.report.turbine_control import control_article
from dfsm.studies.turbine_control import ControlStudy, ControlStudySize, Region, study

# Winds (m/s, as in the file names) and the seeds to optimise for: two in the transition region,
# one below and one above it.
SERIES = {"12": range(9, 11), "06": range(9, 10), "18": range(9, 10)}
QUICK = ControlStudySize(points=300, pitch_limits=(5.0, 7.0))


def demo() -> ModuleType:
    """The other example, which knows the runs and the settings of the fits."""
    spec = importlib.util.spec_from_file_location("demo", Path(__file__).parent / "demo.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by name.
    sys.modules.setdefault("demo", module)
    spec.loader.exec_module(module)
    return module


def regions(series: dict[str, range]) -> list[Region]:
    """Fit one model for each region, without the start-up transients."""
    data, found = demo(), []
    for wind, seeds in series.items():
        training = data.runs([wind], range(1, 9))
        model = dfsm.fit(training, data.settings(5)).model
        tests = data.runs([wind], seeds)
        runs = [[r.window(data.START) for r in group] for group in (training, tests)]
        found.append(Region(f"{int(wind)} m/s", model, *runs))
    return found


def main(arguments: Sequence[str] | None = None) -> ControlStudy:
    """Fit, optimise, print the tables, write the page and the figures."""
    parser = argparse.ArgumentParser(description="Optimal control on bundled OpenFAST runs.")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="transition region, coarse mesh")
    options = parser.parse_args(arguments)
    with dfsm.show_progress(), warnings.catch_warnings():
        warnings.simplefilter("ignore", dfsm.DfsmWarning)  # the fits' warnings are the demo's
        chosen = {"12": range(9, 10)} if options.quick else SERIES
        found = study(regions(chosen), QUICK if options.quick else None)
    article = control_article(found)
    written = publish(article, options.output)
    print_article(article)
    print(f"{found.seconds:.0f} s to solve all; page: {written[0].resolve()}")
    return found


if __name__ == "__main__":
    main()

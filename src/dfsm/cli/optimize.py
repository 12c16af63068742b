"""The command `dfsm optimize`: an optimal control problem from a file, solved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dfsm.cli.terminal import AsJson, Quiet, lines, print_json, say, working


def optimize(
    config: Annotated[Path, typer.Argument(help="YAML file: model, disturbances, cost, bounds.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Find the controls that minimise a cost, for a known course of the disturbances."""
    from dfsm.config.control import load_problem
    from dfsm.control.solution_folder import PAGE, check_solution_target, save_solution
    from dfsm.control.solve import optimum
    from dfsm.core.fallback import write_or_keep
    from dfsm.core.lock import locked
    from dfsm.report.solution_page import solution_article, write_solution_report

    check_solution_target(output)
    with locked(output):
        with working(quiet):
            problem, method, guess = load_problem(config)
            solution = optimum(problem, method, guess)  # the summary tells where it is outside
        write_or_keep(lambda path: save_solution(solution, path, write_solution_report), output)
    article = solution_article(solution)
    if as_json:
        from dfsm.core.files import json_value

        told: dict[str, object] = {
            "ending": solution.ending.name.lower(),
            "message": solution.message,
        }
        told |= {"objective": solution.objective, "outside": solution.outside}
        told |= {"departures": list(solution.departures)}
        print_json(json_value(told | article.to_dict()))
    elif not quiet:
        from dfsm.cli.tables import print_article

        say(lines(solution.summary()), quiet)
        print_article(article)
        say(f"wrote {output}, with the page {PAGE}", quiet)
    if not solution.solved:
        raise typer.Exit(1)

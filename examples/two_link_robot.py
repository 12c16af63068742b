"""The paper's two-link robot study from Python; `dfsm demo two-link-robot` does the same.

Simulates two robot arms whose equations are known, fits models to the simulations, and compares
them with the equations and with each other. Writes a page, its tables as JSON, and figures.

    python examples/two_link_robot.py [--output out/] [--quick]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import dfsm
from dfsm.cli.tables import print_article
from dfsm.demos.two_link_robot import study as two_link_robot
from dfsm.demos.two_link_robot.article import robot_article
from dfsm.report.publish import publish


def main(arguments: Sequence[str] | None = None) -> two_link_robot.RobotStudy:
    """Run the study, print its tables, write its page and figures."""
    parser = argparse.ArgumentParser(description="Two-link robots: the paper's study, and beyond.")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="less of everything")
    options = parser.parse_args(arguments)
    with dfsm.show_progress():
        study = two_link_robot.study(two_link_robot.QUICK if options.quick else None)
    article = robot_article(study)
    written = publish(article, options.output)
    print_article(article)
    print(f"{study.seconds:.0f} s in all; page: {written[0].resolve()}")
    return study


if __name__ == "__main__":
    main()

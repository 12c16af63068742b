"""Write the tables of docs/results/two-link-robot.md, and the last of accuracy.md beside it.

python -m benchmarks.robot     # takes as long as dfsm demo two-link-robot
"""

from __future__ import annotations

from benchmarks.readme import ROOT, fill
from dfsm.demos.two_link_robot.article import robot_article
from dfsm.demos.two_link_robot.study import study

RESULTS = ROOT / "docs" / "results"
PAGES = (RESULTS / "two-link-robot.md", RESULTS / "accuracy.md")


def main() -> None:
    """Run the study and write its tables."""
    tables = {t.key: t.markdown() for t in robot_article(study()).tables()}
    for path in PAGES:
        fill(path, tables)


if __name__ == "__main__":
    main()

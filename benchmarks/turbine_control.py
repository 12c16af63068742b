"""Write the tables of docs/results/floating-turbine-control.md from the optimal control example.

python -m benchmarks.turbine_control out/turbine_control.json     # what the example wrote
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from benchmarks.readme import ROOT, fill
from dfsm.report.article import Table

PAGE = ROOT / "docs" / "results" / "floating-turbine-control.md"


def main() -> None:
    """Turn the example's tables into Markdown."""
    written = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    tables = {}
    for key, rows in written.items():
        columns = tuple(rows[0])
        cells = tuple(tuple(row[c] for c in columns) for row in rows)
        tables[key] = Table(
            key, "", columns, cells, digits=3 + (key != "control_trends")
        ).markdown()
    fill(PAGE, tables)


if __name__ == "__main__":
    main()

"""Write the tables of the pages in docs/, and figures, from measurements.

python -m benchmarks > figures.json && python -m benchmarks.readme figures.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import control_tables, field, fit_tables, startup, turbine_tables, unseen

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
RESULTS = ("accuracy.md", "optimal-control.md", "floating-turbine.md")
FILES = (
    *(DOCS / name for name in ("method.md", "what-a-fit-says.md")),
    *(DOCS / "results" / name for name in RESULTS),
)

TABLES = {
    "accuracy": fit_tables.accuracy_table,
    "speed": fit_tables.speed_table,
    "derivatives": fit_tables.derivatives_table,
    "parameters": fit_tables.parameters_table,
    "scaling": fit_tables.scaling_table,
    "unseen": unseen.unseen_table,
    "startup": startup.startup_table,
}
ROLLOUT_TABLES = {
    "rollouts": turbine_tables.rollouts_table,
    "loads": turbine_tables.loads_table,
    "sweep": turbine_tables.sweep_table,
    "leak": turbine_tables.leak_table,
}
LIMITS_TABLES = {
    "limits": turbine_tables.limits_table,
    "field": turbine_tables.field_table,
    "braking": turbine_tables.braking_table,
}
MATCHED_TABLES = {
    "matched": turbine_tables.matched_table,
    "slopes": turbine_tables.slopes_table,
    "below_rated": turbine_tables.below_rated_table,
}
CODESIGN_TABLES = {
    "codesign": control_tables.codesign_table,
    "adaptive": control_tables.adaptive_table,
}
# By the part of the figures that each shows.
CONTROL_TABLES = {
    "known": ("known", control_tables.known_table),
    "estimates": ("known", control_tables.estimates_table),
    "orders": ("orders", control_tables.orders_table),
    "control_speed": ("turbine", control_tables.control_speed_table),
    "expressions": ("expressions", control_tables.expressions_table),
}


def fill(path: Path, tables: Mapping[str, list[str]]) -> None:
    """Put a table between ``<!-- name -->`` and ``<!-- end -->``, wherever that stands."""
    text = path.read_text(encoding="utf-8")
    for name, lines in tables.items():
        mark = f"<!-- {name} -->"
        if mark in text:
            head, rest = text.split(mark, 1)
            tail = rest.split("<!-- end -->", 1)[1]
            text = "\n".join([head + mark, *lines, "<!-- end -->" + tail])
    path.write_text(text, encoding="utf-8")


def main() -> None:
    """Write the tables that the figures hold."""
    figures = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    tables = {name: table(figures[name]) for name, table in TABLES.items() if name in figures}
    for part, group in (
        ("rollouts", ROLLOUT_TABLES),
        ("limits", LIMITS_TABLES),
        ("matched", MATCHED_TABLES),
        ("codesign", CODESIGN_TABLES),
    ):
        if part in figures:
            tables |= {name: table(figures[part]) for name, table in group.items()}
    if "field" in figures:
        tables["records"] = field.field_table(figures["field"])
    if "peer" in figures:
        tables["peer"] = turbine_tables.rollouts_table(figures["peer"])
    if "control" in figures:
        for name, (part, table) in CONTROL_TABLES.items():
            tables[name] = table(figures["control"][part])
    for path in FILES:
        fill(path, tables)
    draw(figures)


def draw(figures: Mapping[str, Any]) -> None:
    """Draw what the figures hold; only this needs Matplotlib."""
    if "scaling" in figures:
        from benchmarks.figures import draw_scaling

        draw_scaling(figures["scaling"], DOCS / "figures" / "scaling.svg")
    if "control" in figures:
        from benchmarks.figures import draw_orders

        draw_orders(figures["control"]["orders"], DOCS / "figures" / "orders.svg")


if __name__ == "__main__":
    main()

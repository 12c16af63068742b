"""Tables of figures that the documentation states."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]


def table(name: str, page: str = "docs/results/accuracy.md") -> list[list[str]]:
    """Cells of a table of the documentation, below its head."""
    text = (ROOT / page).read_text(encoding="utf-8")
    block = text.split(f"<!-- {name} -->")[1].split("<!-- end -->")[0]
    rows = [line.strip("| ").split(" | ") for line in block.strip().splitlines()]
    return [[cell.strip(" |") for cell in row] for row in rows if not set(row[0]) <= set("-|:")]

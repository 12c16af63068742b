"""docs/architecture.md against the code: contracts as they are checked, every package told."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
PACKAGE = ROOT / "src" / "dfsm"
MOST_LINES, MOST_MEDIAN = 450, 180


def contracts() -> list[dict]:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return settings["tool"]["importlinter"]["contracts"]


def quoted() -> str:
    """The contracts as the page shows them."""
    lines = []
    for contract in contracts():
        lines.append(f"    {contract['name']}")
        if contract["type"] == "layers":
            lines += [f"        {layer}" for layer in contract["layers"]]
        else:
            lines.append(f"        {', '.join(contract['source_modules'])}")
            lines.append(f"        never import {', '.join(contract['forbidden_modules'])}")
        lines += [f"        but for {arrow}" for arrow in contract.get("ignore_imports", ())]
    return "\n".join(lines)


def test_the_page_quotes_the_contracts_that_are_checked():
    part = re.search(r"<!-- contracts -->\n(.*?)\n<!-- end -->", PAGE, re.DOTALL)
    assert part is not None
    assert part[1] == quoted()


def test_the_page_tells_every_package_and_no_other():
    table = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", PAGE, re.MULTILINE)
    told = {name for row in table for name in re.findall(r"`(\w+)`", row)}
    packages = {p.name for p in PACKAGE.iterdir() if (p / "__init__.py").exists()}
    assert told == packages | {"errors"}


def test_the_page_fits_on_two_screens():
    assert len(PAGE.splitlines()) <= 100


@pytest.mark.parametrize("folder", ["src", "tests", "benchmarks", "examples"])
def test_files_are_short(folder):
    code = [p for p in (ROOT / folder).rglob("*") if p.suffix in (".py", ".js", ".css")]
    sizes = {p: len(p.read_text(encoding="utf-8").splitlines()) for p in code}
    assert {p.name: n for p, n in sizes.items() if n > MOST_LINES} == {}


def test_the_typical_file_of_the_package_is_read_at_a_glance():
    sizes = sorted(len(p.read_text(encoding="utf-8").splitlines()) for p in PACKAGE.rglob("*.py"))
    assert sizes[len(sizes) // 2] <= MOST_MEDIAN

"""What an installation takes: megabytes by package, and which packages each command loads.

Sizes are those of the files that wheels brought, without compiled modules; `python -m benchmarks
install` looks at the environment that it runs in. Every command runs once, in a process of its own.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from benchmarks.startup import COMMANDS, CONFIG, PROBLEM

# Runs a command in this process and tells what was imported, after what the command printed.
_LOADED = """
import json, sys
from dfsm.cli import main
sys.argv = ["dfsm", *sys.argv[1:]]
try:
    main()
except SystemExit:
    pass
print()
print(json.dumps(sorted({name.split(".")[0] for name in sys.modules})))
"""


def run() -> dict[str, Any]:
    """Megabytes in all, by extra and by package, and by what a command loads."""
    sizes = {name: megabytes(name) for name in needed("dfsm", tuple(extras()))}
    core = needed("dfsm")
    in_core = {name: sizes[name] for name in core}
    figures: dict[str, Any] = {
        "core_MB": sum(in_core.values()),
        "packages_MB": dict(sorted(in_core.items(), key=lambda item: -item[1])),
        "extras_MB": {
            extra: sum(sizes[name] for name in needed("dfsm", (extra,)) if name not in core)
            for extra in extras()
        },
    }
    figures["commands"] = {name: sorted(part) for name, part in loaded(set(sizes)).items()}
    return figures


def extras() -> list[str]:
    """The optional parts of dfsm."""
    return metadata.metadata("dfsm").get_all("Provides-Extra") or []


def needed(name: str, chosen: Sequence[str] = ()) -> set[str]:
    """Distributions that one needs here, with some of its extras, itself among them."""
    found: dict[str, set[str]] = {}
    waiting = [(name, frozenset(chosen))]
    while waiting:
        name, wanted = waiting.pop()
        key = re.sub(r"[-_.]+", "-", name).lower()
        if key in found and wanted <= found[key]:
            continue
        found.setdefault(key, set()).update(wanted)
        with suppress(metadata.PackageNotFoundError):
            for line in metadata.requires(name) or []:
                one = Requirement(line)
                told = ({"extra": extra} for extra in ("", *wanted))
                if one.marker is None or any(one.marker.evaluate(some) for some in told):
                    waiting.append((one.name, frozenset(one.extras)))
    return set(found)


def megabytes(name: str) -> float:
    """Size of the files of a distribution; 0 where it is not installed."""
    try:
        files = metadata.files(name) or []
    except metadata.PackageNotFoundError:
        return 0.0
    total = 0
    for file in files:
        with suppress(OSError):
            total += 0 if file.suffix == ".pyc" else Path(str(file.locate())).stat().st_size
    return total / 1e6


def loaded(among: set[str]) -> dict[str, set[str]]:
    """Distributions, of some, that every command imports."""
    owners = metadata.packages_distributions()
    found: dict[str, set[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "config.yaml").write_text(CONFIG, encoding="utf-8")
        (place / "problem.yaml").write_text(PROBLEM, encoding="utf-8")
        _modules(place, ["fit", "config.yaml", "-o", "model"])
        for name, command in COMMANDS.items():
            names = (owner for m in _modules(place, command) for owner in owners.get(m, ()))
            found[name] = {re.sub(r"[-_.]+", "-", owner).lower() for owner in names} & among
    return found


def _modules(place: Path, command: Sequence[str]) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", _LOADED, *command],
        cwd=place,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def install_table(figures: dict[str, Any]) -> list[str]:
    """What is worth a row, and what each command loads."""
    rows = [
        "| package | MB |",
        "|---|---|",
        f"| **all that dfsm needs** | {figures['core_MB']:.0f} |",
    ]
    rows += [f"| {n} | {mb:.0f} |" for n, mb in figures["packages_MB"].items() if mb >= 10]
    rows += [f"| with `dfsm[{n}]` | + {mb:.0f} |" for n, mb in figures["extras_MB"].items()]
    heavy = [name for name, mb in figures["packages_MB"].items() if mb >= 10]
    rows += ["", "| command | loads, of these |", "|---|---|"]
    for name, names in figures["commands"].items():
        rows.append(f"| `{name}` | {', '.join(n for n in heavy if n in names) or '–'} |")
    return rows

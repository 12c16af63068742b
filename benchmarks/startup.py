"""Processor time of commands from a cold process, beside that of an earlier build.

python -m benchmarks startup [--before COMMIT]

Every command runs in a process of its own, with a cache folder of its own: once with nothing
compiled before, as on the first day, then as on all others, of which the fastest counts. Processor
time, user and system, does not depend on who else uses the machine as much as the clock does. The
earlier build runs in turn with this one, from a checkout of its commit and with the packages that
are installed here; it keeps nothing compiled.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.process import usage

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "examples" / "iea15"
TEST = [RUNS / "iea15_2dof_12mps_s09.outb", RUNS / "iea15_2dof_12mps_s10.parquet"]
REPEATS = 3
CONFIG = f"""
data:
  train: ["{RUNS}/iea15_2dof_12mps_s0[1-4].parquet"]
  start: 100.0
signals:
  states: [{{name: PtfmPitch, order: 2, rate: PtfmRVyt}}, {{name: GenSpeed, order: 1}}]
  controls: [GenTq, BldPitch1]
  disturbances: [RotWind, RotShearV, RotShearH, Wave1Elev]
  features: [{{source: Wave1Elev, kind: rate}}]
  outputs: [TwrBsFxt, TwrBsMyt, GenPwr]
linear: {{kind: LPV, schedule: RotWind, points: 5, margin: 0.03}}
corrective: {{kind: none}}
"""
# The paper's cost, on as many nodes as its problem has.
PROBLEM = f"""
model: model
disturbances: {TEST[1]}
horizon: [100.0, 700.0]
cost:
  - {{weight: -0.99, product: [GenTq, GenSpeed]}}
  - {{weight: 1.0e-5, square: GenTq}}
  - {{weight: 0.5, square: BldPitch1}}
units: {{GenTq: 1000.0}}
bounds:
  GenTq: [1670.0, 19900.0]
  BldPitch1: [0.0, 22.6]
  PtfmPitch: [-6.0, 6.0]
  GenSpeed: [5.0, 7.56]
nodes: 1000
scheme: trapezoidal
"""
COMMANDS: dict[str, list[str]] = {
    "dfsm --help": ["--help"],
    "dfsm info, one run": ["info", str(TEST[0])],
    "dfsm fit, four runs": ["fit", "config.yaml", "-o", "again"],
    "dfsm simulate, one run": ["simulate", "model", str(TEST[0]), "-o", "out.parquet"],
    "dfsm validate, two runs": ["validate", "model", *map(str, TEST), "-o", "report.html"],
    "dfsm optimize, 1000 nodes": ["optimize", "problem.yaml", "-o", "optimum"],
}
# What the environment of whoever measures must not decide: without bytecode that is kept, every
# process compiles all modules that it imports.
_SETTINGS = ("JAX_", "XLA_", "PYTHONDONTWRITEBYTECODE")
# An optimum that rests on a bound that a rollout just oversteps ends with 1.
_FINE = (0, 1)


def run(before: str | None = None) -> dict[str, Any]:
    """Seconds by command: the first time, from then on, and of the earlier build.

    Parameters
    ----------
    before
        Commit of the earlier build; None measures this one alone.
    """
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, checkout(before) as earlier:
        place = Path(folder)
        (place / "config.yaml").write_text(CONFIG, encoding="utf-8")
        (place / "problem.yaml").write_text(PROBLEM, encoding="utf-8")
        seconds(place, ROOT, ["fit", "config.yaml", "-o", "model"], "off")
        for name, command in COMMANDS.items():
            cache = str(place / "cache" / name.replace(" ", "_"))
            times: dict[str, list[float]] = {"now": [], "before": []}
            first = seconds(place, ROOT, command, cache)
            for _ in range(REPEATS):
                times["now"].append(seconds(place, ROOT, command, cache))
                if earlier is not None:
                    times["before"].append(seconds(place, earlier, command, "off"))
            results[name] = {"first_s": first} | {
                f"{which}_s": min(some) for which, some in times.items() if some
            }
    return results


def seconds(place: Path, build: Path, command: Sequence[str], cache: str) -> float:
    """Processor time, user and system, of one command in a process of its own."""
    own = {k: v for k, v in os.environ.items() if not k.startswith(_SETTINGS)}
    environment = own | {"PYTHONPATH": str(build / "src"), "DFSM_CACHE": cache}
    used = usage(place, command, environment, _FINE)
    return used.ru_utime + used.ru_stime


@contextmanager
def checkout(commit: str | None) -> Iterator[Path | None]:
    """A folder with an earlier state of the repository; None for none."""
    if commit is None:
        yield None
        return
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        place = str(Path(folder) / "before")
        subprocess.run([*git, "add", "--detach", place, commit], check=True, capture_output=True)
        try:
            yield Path(place)
        finally:
            subprocess.run([*git, "remove", "--force", place], check=True, capture_output=True)


def startup_table(figures: Mapping[str, Any]) -> list[str]:
    """One row per command."""
    rows = [
        "| command | first time | from then on | before | times less |",
        "|---|---|---|---|---|",
    ]
    for name, told in figures.items():
        before = told.get("before_s")
        more = (
            ("–", "–") if before is None else (f"{before:.1f} s", f"{before / told['now_s']:.1f}")
        )
        rows.append(
            f"| `{name}` | {told['first_s']:.1f} s | {told['now_s']:.1f} s | {' | '.join(more)} |"
        )
    return rows

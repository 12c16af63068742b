"""Memory of `fit` by the number of runs, and of `info` on one long run.

python -m benchmarks memory

A run is an `.outb` of 1.7 MB, as OpenFAST writes 600 s at 20 Hz with 70 channels: a floating body
of two equations under wind and a control, and channels that nobody reads. `fit` takes 50, 200 and
500 of them, `info` one run of 1e7 samples with eight channels. Each
command runs in a process of its own, whose highest resident memory the system tells.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from benchmarks.outb import outb_header, write_outb
from benchmarks.process import usage
from benchmarks.startup import ROOT
from dfsm.core.types import Array

RUNS = (50, 200, 500)
CHANNELS, LONG = 70, 10_000_000
SAMPLES, STEP = 12_001, 0.05  # s
NAMES = ["Pitch", "Force", "Wind", "Load", *(f"Other{k}" for k in range(CHANNELS - 4))]
UNITS = ["deg", "kN", "m/s", "kN-m", *["m"] * (CHANNELS - 4)]
CONFIG = """
data: {train: ["run[0-9]*.outb"]}
signals:
  states: [{name: Pitch, order: 2}]
  controls: [Force]
  disturbances: [Wind]
  outputs: [Load]
corrective: {kind: none}
nonlinear_only: false
"""


def run() -> dict[str, Any]:
    """Highest resident memory in MB by command."""
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "config.yaml").write_text(CONFIG, encoding="utf-8")
        for number in range(max(RUNS)):
            if number in RUNS:
                figures[f"fit, {number} runs"] = peak(place, ["fit", "config.yaml", "-o", "model"])
            time = STEP * np.arange(SAMPLES)
            channels = _channels(number, time)
            write_outb(place / f"run{number:03d}.outb", time, channels, NAMES, UNITS)
        figures[f"fit, {max(RUNS)} runs"] = peak(place, ["fit", "config.yaml", "-o", "model"])
        long_run(place / "long.outb")
        figures["info, 1e7 samples"] = peak(place, ["info", "long.outb"])
    return figures


def peak(place: Path, command: Sequence[str]) -> float:
    """Highest resident memory in MB of one command in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    used = usage(place, command, environment)
    # Linux tells KiB, macOS bytes.
    return used.ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)


def memory_table(figures: Mapping[str, float]) -> list[str]:
    """One row per command."""
    rows = ["| command | highest memory |", "|---|---|"]
    return rows + [f"| `dfsm {name}` | {told:.0f} MB |" for name, told in figures.items()]


def _channels(number: int, time: Array) -> Array:
    """Samples of one run, ``(time, channel)``: the four that are read, then the others."""
    rng = np.random.default_rng(number)
    knots = np.arange(0.0, time[-1] + 5.0, 5.0)
    force, wind = (
        scipy.interpolate.CubicSpline(knots, rng.normal(size=len(knots)))(time) for _ in range(2)
    )
    A = np.array([[0.0, 1.0], [-0.25, -0.2]])
    B = np.array([[0.0, 0.0], [0.5, 0.2]])
    system = scipy.signal.StateSpace(A, B, np.eye(2), np.zeros((2, 2)))
    _, states, _ = scipy.signal.lsim(system, np.column_stack([force, wind]), time)
    load = 3 * states[:, 0] + states[:, 1] + force
    others = np.sin(np.outer(time, rng.uniform(0.1, 3, CHANNELS - 4)))
    return np.column_stack([states[:, 0], force, wind, load, others])


def long_run(path: Path) -> None:
    """Write one run of 1e7 samples, part by part."""
    rng = np.random.default_rng(0)
    scale, offset = np.full(8, 3e4, np.float32), np.zeros(8, np.float32)
    with path.open("wb") as stream:
        stream.write(outb_header(NAMES[:8], UNITS[:8], LONG, (0.0, STEP), (scale, offset)))
        for _ in range(0, LONG, LONG // 10):
            stream.write(rng.integers(-30000, 30000, (LONG // 10, 8)).astype("<i2").tobytes())

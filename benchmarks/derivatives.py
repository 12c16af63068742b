"""Rate and acceleration from splines through 16-bit platform pitch, against OpenFAST's own.

OpenFAST recorded both derivatives (`PtfmRVyt`, `PtfmRAyt`); every method sees the pitch alone, with
one setting for all runs. Errors are the standard deviation of the difference over that of
the recorded derivative, from 100 s on, in per cent. Time is per channel of 14001 samples.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.interpolate import UnivariateSpline

from dfsm.core.types import Array
from dfsm.data.derivatives import cubic_spline, smoothing_spline
from dfsm.data.readers import read
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError

START = 100.0  # s, the start-up transient before it is left out
Derivatives = tuple[Array, Array]


def dfsm_default(run: Trajectory) -> Derivatives:
    """Differentiate pitch with this package's default, which knows the file's step."""
    result = smoothing_spline(run.time, run["PtfmPitch"], run.channel("PtfmPitch").step)
    return result.first, result.second


def dfsm_cross_validation(run: Trajectory) -> Derivatives:
    """Do the same as if the step were unknown."""
    result = smoothing_spline(run.time, run["PtfmPitch"])
    return result.first, result.second


def paper_cubic(run: Trajectory) -> Derivatives:
    """Differentiate the paper's interpolating cubic spline."""
    return cubic_spline(run.time, run["PtfmPitch"])[1:]


def scipy_quintic(run: Trajectory) -> Derivatives:
    """Differentiate FITPACK's quintic with s = N q²/12."""
    step = run.channel("PtfmPitch").step
    if step is None:
        raise DfsmError(f"{run.where}: PtfmPitch carries no quantisation step: use the 16-bit runs")
    spline = UnivariateSpline(run.time, run["PtfmPitch"], k=5, s=len(run) * step**2 / 12)
    return np.asarray(spline(run.time, 1)), np.asarray(spline(run.time, 2))


METHODS: dict[str, Callable[[Trajectory], Derivatives]] = {
    "dfsm_default": dfsm_default,
    "dfsm_cross_validation": dfsm_cross_validation,
    "paper_cubic": paper_cubic,
    "scipy_quintic": scipy_quintic,
}


def run(folder: str | Path = "examples/iea15", pattern: str = "iea15_2dof_*") -> dict[str, object]:
    """Measure every method on every run in a folder.

    Parameters
    ----------
    folder
        Folder with `.outb` or `.parquet` runs.
    pattern
        Which of them.

    Returns
    -------
    dict
        ``runs``, ``mean`` and ``worst`` error per method and derivative in per cent, ``seconds``
        per channel (median), and ``times_faster`` than SciPy's quintic, in this same process.

    Raises
    ------
    DfsmError
        No runs, or one without the channels.
    """
    paths = sorted(p for p in Path(folder).glob(pattern) if p.suffix in {".outb", ".parquet"})
    if not paths:
        raise DfsmError(f"no runs match '{pattern}' in {folder}: give the folder that holds them")
    runs: dict[str, dict[str, dict[str, float]]] = {}
    seconds: dict[str, list[float]] = {name: [] for name in METHODS}
    for path in paths:
        trajectory = read(path)
        errors: dict[str, dict[str, float]] = {}
        for name, method in METHODS.items():
            begin = time.perf_counter()
            first, second = method(trajectory)
            seconds[name].append(time.perf_counter() - begin)
            errors[name] = {
                "rate": _error(trajectory, first, "PtfmRVyt"),
                "acceleration": _error(trajectory, second, "PtfmRAyt"),
            }
        runs[path.stem] = errors
    median = {name: float(np.median(s)) for name, s in seconds.items()}
    return {
        "runs": runs,
        "mean": _over_runs(runs, np.mean),
        "worst": _over_runs(runs, np.max),
        "seconds": median,
        "times_faster": {name: median["scipy_quintic"] / s for name, s in median.items()},
    }


def _error(trajectory: Trajectory, derivative: Array, name: str) -> float:
    late = trajectory.time >= START
    reference = trajectory[name][late]
    return float(100 * np.std(derivative[late] - reference) / np.std(reference))


def _over_runs(
    runs: dict[str, dict[str, dict[str, float]]], reduce: Callable[[list[float]], float]
) -> dict[str, dict[str, float]]:
    return {
        name: {
            what: float(reduce([errors[name][what] for errors in runs.values()]))
            for what in ("rate", "acceleration")
        }
        for name in METHODS
    }


def main() -> int:
    """Print the measurements as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", default="examples/iea15")
    parser.add_argument("--pattern", default="iea15_2dof_*", help="which runs of the folder")
    arguments = parser.parse_args()
    try:
        result = run(arguments.folder, arguments.pattern)
    except DfsmError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    sys.stdout.write(json.dumps(result, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

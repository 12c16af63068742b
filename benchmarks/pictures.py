"""Draw the pictures of the README and of docs/gallery.md.

python -m benchmarks.pictures [first_result] [own_data] [closed_loop] [optimal_control]

The first one fits what `dfsm init` writes for eight bundled runs (some minutes); the others run the
notebook of their name and draw what it has found.
"""

from __future__ import annotations

import os
import runpy
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

import dfsm
from benchmarks.figures import GREY, STYLE, save, sheet
from dfsm.config.fit import load_config
from dfsm.config.template import write_config

ROOT = Path(__file__).parents[1]
DATA = ROOT / "examples" / "iea15"
FIGURES = ROOT / "docs" / "figures"
_BLUE, _RED, _GREEN = "#0072b2", "#d55e00", "#00916a"
_WORDS = {
    "PtfmPitch": "platform pitch (deg)",
    "GenSpeed": "rotor speed (rpm)",
    "BldPitch1": "blade pitch (deg)",
    "GenTq": "torque (kN m)",
    "TwrBsMyt": "tower-base moment (kN m)",
}
Curve = tuple[str, dfsm.Trajectory, Mapping[str, Any]]


def first_result() -> None:
    """A test run at 12 m/s and the model that the proposed configuration gives."""
    runs = [str(DATA / f"iea15_2dof_12mps_s{seed:02d}.parquet") for seed in range(1, 9)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.yaml"
        write_config(runs, path)
        config, training = load_config(path)
        model = dfsm.fit(training, config.fit_settings(), config.refine).model
    test = dfsm.read(DATA / "iea15_2dof_12mps_s09.outb")
    found = dfsm.simulate(model, test, start=config.data.start)
    curves = (
        ("recorded by OpenFAST, not used in the fit", test, {"color": GREY, "linewidth": 0.9}),
        ("simulated by the model", found.trajectory, {"color": _RED, "linewidth": 1.1}),
    )
    _draw("first_result", ("PtfmPitch", "GenSpeed"), curves, (100, 700))


def own_data() -> None:
    """The test run of the notebook of that name."""
    run = _notebook("own_data")["validation"].runs[0]
    simulated = run.models["multi-fidelity"].simulation.trajectory
    curves = (
        ("recorded", run.recorded, {"color": GREY, "linewidth": 0.9}),
        ("simulated", simulated, {"color": _RED, "linewidth": 1.1}),
    )
    _draw("own_data", ("PtfmPitch", "TwrBsMyt"), curves, (100, 400))


def closed_loop() -> None:
    """Three gains."""
    loops = _notebook("closed_loop")["loops"]
    looks = ({"color": _GREEN}, {"color": _BLUE}, {"color": _RED})
    curves = [
        (f"kp {gain:g}", loop.trajectory, {"linewidth": 1.0, **look})
        for (gain, loop), look in zip(loops.items(), looks, strict=True)
    ]
    _draw("closed_loop", ("GenSpeed", "BldPitch1", "PtfmPitch"), curves, (160, 310))


def optimal_control() -> None:
    """Two limits on the platform's pitch."""
    solutions = _notebook("optimal_control")["solutions"]
    looks = ({"color": _BLUE}, {"color": _RED})
    curves = [
        (f"platform pitch up to {limit:g} deg", s.trajectory, {"linewidth": 1.1, **look})
        for (limit, s), look in zip(solutions.items(), looks, strict=True)
    ]
    _draw("optimal_control", ("PtfmPitch", "BldPitch1", "GenTq"), curves, (300, 420))


PICTURES: dict[str, Callable[[], None]] = {
    "first_result": first_result,
    "own_data": own_data,
    "closed_loop": closed_loop,
    "optimal_control": optimal_control,
}


def _notebook(name: str) -> dict[str, Any]:
    """What a notebook has defined when it is through; its files go to a temporary folder."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "examples").symlink_to(ROOT / "examples")
        os.chdir(folder)
        try:
            return runpy.run_path(str(ROOT / "notebooks" / f"{name}.py"))
        finally:
            os.chdir(here)


def _draw(
    name: str, channels: Sequence[str], curves: Sequence[Curve], window: tuple[float, float]
) -> None:
    """Panels above each other, one for each channel; two samples a second are enough to see."""
    with mpl.rc_context(STYLE):
        page, axes = sheet(1.0 + 1.1 * len(channels), len(channels), stacked=True)
        for place, channel in zip(axes, channels, strict=True):
            for label, run, look in curves:
                part = run.window(*window)
                step = max(1, round(0.5 / float(np.median(np.diff(part.time)))))
                place.plot(part.time[::step], part[channel][::step], label=label, **look)
            place.set_title(_WORDS[channel])
            place.set_xlim(*window)
        axes[-1].set_xlabel("time (s)")
        save(page, axes[0], FIGURES / f"{name}.svg")


def main() -> None:
    """Draw the pictures that are named, or all."""
    for name in sys.argv[1:] or PICTURES:
        PICTURES[name]()


if __name__ == "__main__":
    main()

"""Rollouts of 600 s on an accelerator, 1 to 10,000 at once, beside the processor.

The model is that of `benchmarks.speed`: scheduled linear parts and 200 units in every fitted row,
with outputs and the check of the training region. Times are wall times of the public
`dfsm.simulate`, compiled code warm, initial states given.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import jax
import numpy as np

import dfsm
from benchmarks import speed

BATCHES = (1, 100, 1000, 4000, 10_000)
NONE = "skipped: JAX finds no GPU here, so there is nothing to time"


def run() -> str | dict[str, Any]:
    """Seconds per batch, and the largest difference of a run from the processor's own."""
    if jax.default_backend() == "cpu":
        return NONE
    return table(BATCHES)


def table(batches: tuple[int, ...]) -> dict[str, Any]:
    """The figures, on whatever JAX computes with."""
    runs = dfsm.read_all([str(speed.DATA / "iea15_2dof_12mps_s0[1-8].parquet")])
    model = speed.with_units(runs)
    test = dfsm.read(speed.DATA / "iea15_2dof_12mps_s09.outb").window(100.0)
    test = test.select((*model.signals.exogenous, *model.signals.measured))
    begin = np.asarray(dfsm.simulate(model, test).trajectory.values[0, :4])
    # Each run has a start of its own.
    shifts = np.random.default_rng(0).normal(size=(max(batches), 4))
    starts = begin + 0.01 * np.asarray(model.region.std)[model.signals.state_columns] * shifts
    figures: dict[str, Any] = {"device": jax.devices()[0].device_kind, "batches": []}
    last: list[dfsm.Simulation] = []
    for count in batches:
        many = [replace(test, name=str(i)) for i in range(count)]
        dfsm.simulate(model, many, initial=starts[:count])
        clock = time.perf_counter()
        last = dfsm.simulate(model, many, initial=starts[:count])
        seconds = time.perf_counter() - clock
        figures["batches"].append(
            {"runs": count, "s": seconds, "ms_per_run": 1e3 * seconds / count}
        )
    with jax.default_device(jax.devices("cpu")[0]):
        alone = dfsm.simulate(model, test, initial=starts[len(last) - 1])
    spread = np.ptp(alone.trajectory.values, axis=0)
    apart = np.abs(last[-1].trajectory.values - alone.trajectory.values).max(axis=0)
    figures["difference"] = float((apart / spread).max())
    return figures

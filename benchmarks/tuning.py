"""Few evaluations of the truth: pattern search on it, the surrogate alone, and the trust region.

The truth is a turbine on a platform in six equations: an actuator of the pitch with limits of its
rate, a tower, quadratic drag and a thrust that varies with the wind. The surrogate is linear, in
three states, from one run with pitch steps at another mean wind: it knows neither actuator nor
tower. PI gains are tuned for damage of the platform's pitch, deviations of speed, and pitch travel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import dfsm
from dfsm.core.types import Array
from dfsm.errors import hushed
from dfsm.loops.trust_region import ConfirmedTuning, TrustSettings, flown, tune_with_truth
from dfsm.loops.truth import SystemTruth
from dfsm.loops.tuning import TuningTask
from dfsm.loops.tuning_search import FEASIBLE, Search

STATES = ("PtfmPitch", "PtfmRate", "GenSpeed", "Tower", "TowerRate", "Blade")
UNITS = ("deg", "deg/s", "rpm", "m", "m/s", "deg")
# Within this share of the best objective known a method has arrived.
NEAR = 0.01


class Row(NamedTuple):
    """What a method reached in truth, with how many evaluations of it."""

    objective: float
    evaluations: int
    until_near: int | None


def turbine() -> dfsm.ODESystem:
    """The truth."""

    def f(x, u, w, _):
        theta, rate, speed, tower, swing, blade = x
        wind = w[0] - 1.5 * rate - 0.4 * swing
        off = wind - 12
        thrust = off - 0.55 * (blade - 6) - 0.03 * off * (blade - 6) - 0.02 * off**2
        power = 0.05 * off - 0.08 * (blade - 6) - 0.006 * (blade - 6) ** 2
        turn = 1.2 * jnp.tanh((u[0] - blade) / 1.2 * 1.5)
        return jnp.array([
            rate,
            -0.045 * (theta - 4) - 0.015 * rate - 0.05 * rate * jnp.abs(rate) + 0.012 * thrust,
            power - 0.02 * (speed - 7.5),
            swing,
            -4.0 * tower - 0.12 * swing + 0.35 * thrust,
            turn,
        ])  # fmt: skip

    channels = tuple(dfsm.Channel(n, u) for n, u in zip(STATES, UNITS, strict=True))
    return dfsm.ODESystem(
        f,
        states=channels,
        controls=(dfsm.Channel("BldPitch1", "deg"),),
        disturbances=(dfsm.Channel("RotWind", "m/s"),),
        name="turbine",
    )


def wind(time: Array, mean: float, seed: int) -> Array:
    """Gusts around a mean, of sines with random phases."""
    rng = np.random.default_rng(seed)
    frequency = np.geomspace(0.03, 1.0, 12)
    waves = np.sin(np.multiply.outer(time, frequency) + rng.uniform(0, 2 * np.pi, 12))
    return mean + waves @ (0.7 / np.sqrt(frequency / 0.03))


def task(duration: float = 300.0, seeds: Sequence[int] = (1, 2, 3)) -> TuningTask:
    """The surrogate, the runs, and what is asked."""
    time = np.arange(0, duration + 0.05, 0.1)
    system, start = turbine(), [4, 0, 7.5, 0, 0, 6]
    blade = 6 + 0.9 * np.sin(0.05 * time) + 0.5 * np.sign(np.sin(0.35 * time))
    first = system.simulate(time, start, blade[:, None], wind(time, 12.3, 9)[:, None], name="fit")
    settings = dfsm.FitSettings(
        states=(
            dfsm.StateSpec(name="PtfmPitch", order=2, rate="PtfmRate"),
            dfsm.StateSpec(name="GenSpeed"),
        ),
        controls=("BldPitch1",),
        disturbances=("RotWind",),
        corrective=dfsm.NoCorrection(),
        nonlinear_only=False,
    )
    with hushed():
        model = dfsm.fit([first], settings).model
    held = np.full((len(time), 1), 6.0)
    runs = [
        system.simulate(time, start, held, wind(time, mean, seed)[:, None], name=f"seed{seed}")
        for seed, mean in zip(seeds, cycle((11.6, 12.0, 12.5)), strict=False)
    ]
    law = dfsm.PID(
        kp=-1.0, ki=-0.05, setpoint=7.5, limits=(0.0, 25.0),
        measurements=["GenSpeed"], measurement_units=["rpm"],
        commands=["BldPitch1"], command_units=["deg"], interval=0.1,
    )  # fmt: skip
    asked = dfsm.TuningProblem(
        parameters={"kp": (-12.0, -0.3), "ki": (-2.5, -0.01)},
        objective=(
            dfsm.Goal(measure="damage", channel="PtfmPitch"),
            dfsm.Goal(measure="std", channel="GenSpeed"),
            dfsm.Goal(measure="travel", channel="BldPitch1", weight=0.1),
        ),
    )
    settings = dfsm.TuneSettings(loop=dfsm.ClosedLoopSettings(start_up=30.0), iterations=60)
    return TuningTask(model, runs, law, asked, None, None, settings)


class Counted:
    """The truth's objective, and how often it was asked for.

    Parameters
    ----------
    asked, truth
        What is tuned, and what flies it.
    """

    def __init__(self, asked: TuningTask, truth: SystemTruth) -> None:
        self.asked, self.truth = asked, truth
        self.course: list[float] = []
        before = flown(asked, truth, 0, asked.tuned.start)
        assert before is not None
        # The same scales for all methods: those of the surrogate, as in `tune_with_truth`.
        self.search: Search = asked.search(asked.evaluator(asked.tuned.start))

    def __call__(self, theta: Array) -> float:
        """Objective in truth at some values."""
        found = flown(self.asked, self.truth, len(self.course) + 1, theta)
        judged = None if found is None else self.search.judged(found)
        far = judged is None or judged.violation > FEASIBLE
        self.course.append(np.inf if judged is None or far else judged.objective)
        return self.course[-1]

    def until(self, near: float) -> int | None:
        """Evaluations until an objective was reached; None where it was not."""
        at = np.flatnonzero(np.minimum.accumulate(self.course) <= near)
        return int(at[0]) + 1 if len(at) else None


def pattern_search(cost: Counted, bounds: tuple[Array, Array], start: Array) -> Array:
    """Compass search in parameters scaled to their bounds, halving its step down to 1/256."""
    low, span = bounds[0], bounds[1] - bounds[0]
    x, step = (start - low) / span, 0.25
    best = cost(start)
    while step > 1 / 256:
        for way in (*np.eye(len(x)), *-np.eye(len(x))):
            tried = np.clip(x + step * way, 0, 1)
            if (tried == x).all():
                continue
            value = cost(low + span * tried)
            if value < best:
                x, best = tried, value
                break
        else:
            step /= 2
    return low + span * x


def compared(asked: TuningTask) -> tuple[dict[str, Row], ConfirmedTuning]:
    """Objectives in truth and evaluations of it, by method."""
    fine = replace(dfsm.ClosedLoopSettings(start_up=30.0), step=0.05)
    truth = SystemTruth(turbine(), settings=fine)
    searched = Counted(asked, truth)
    pattern_search(searched, asked.problem.bounds, asked.tuned.start)
    with hushed():
        confirmed = tune_with_truth(asked, truth, TrustSettings(flights=5))
        alone = asked.tune()
    own = Counted(asked, truth)
    surrogate = own(np.array(list(alone.values.values())))
    flights = [f.true for f in confirmed.flights if f.true is not None]
    best = min(*flights, *searched.course, surrogate)
    near = best * (1 + NEAR)
    begun = searched.course[0]
    steps = np.flatnonzero(np.minimum.accumulate(flights) <= near)
    rows = {
        "as it was": Row(begun, 0, None),
        "surrogate alone": Row(surrogate, 0, 0 if surrogate <= near else None),
        "pattern search": Row(min(searched.course), len(searched.course), searched.until(near)),
        "trust region": Row(
            min(flights), len(confirmed.flights), int(steps[0]) + 1 if len(steps) else None
        ),
    }
    return rows, confirmed


def run() -> object:
    """Print the table, and return its figures."""
    table, confirmed = compared(task())
    print(confirmed.summary())
    print("| method | objective in truth | evaluations | until within 1 % of the best |")
    print("|---|---|---|---|")
    for name, row in table.items():
        near = "–" if row.until_near is None else row.until_near
        print(f"| {name} | {row.objective:.4f} | {row.evaluations} | {near} |")
    return {name: row._asdict() for name, row in table.items()}

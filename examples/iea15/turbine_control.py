"""The paper's optimal control study of a floating 15 MW turbine (Sec. 4), on any models and runs.

Its problem (`turbine_problem`) is solved for several winds and several limits of the platform
pitch, with the paper's bounds and with those of the turbine that was simulated.
`examples/iea15/optimal_control.py` runs it on the bundled data.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dfsm.control import DirectTranscription, Solution
from dfsm.control.solve import optimum
from dfsm.core.progress import track
from dfsm.core.settings import require, settings_class
from dfsm.core.types import Array
from dfsm.core.workers import work_through
from dfsm.data.trajectory import Trajectory
from dfsm.models.dfsm import DFSM
from turbine_problem import (
    BLADE,
    MEGAWATT,
    PAPER,
    PITCH,
    SPEED,
    TORQUE,
    WIND,
    Case,
    Region,
    mean,
    mean_power,
    problem,
    turbine_case,
    wind_power,
)

# Intervals of the mesh for each of the coarser one that an optimum inside the data starts from.
_COARSER = 4
# Degrees by which a platform pitch stays clear of a limit that it does not come to.
_CLEAR = 0.01
# What counts as "at the peak" of the platform pitch: this share of the horizon.
_PEAK = 0.05


@settings_class
class ControlStudySettings:
    """How much to compute; the defaults are the paper's.

    Attributes
    ----------
    points
        Equidistant nodes.
    pitch_limits
        Upper bounds of the platform pitch in deg.
    duration
        Of the horizon in s.
    tolerance
        Of the nonlinear program.
    """

    points: int = 1000
    pitch_limits: tuple[float, ...] = (5.0, 6.0, 7.0)
    duration: float = 600.0
    tolerance: float = 1e-7

    def __post_init__(self) -> None:
        require(self.points >= 3, "points", self.points, "at least 3")
        require(len(self.pitch_limits) > 0, "pitch_limits", self.pitch_limits, "one or more")
        require(self.duration > 0, "duration", self.duration, "more than 0")


@dataclass(frozen=True, eq=False)
class Result:
    """One problem, solved or not.

    Attributes
    ----------
    region, series
        Names of the region and of the run whose wind it is.
    case, most_pitch
        What bounds held: which case, and Θ_p,max in deg.
    solution
        See `Solution`.
    recorded
        The run in closed loop, over the same horizon.
    available
        Mean aerodynamic power in MW of the disk's mean wind at the best power coefficient known.
    outside
        Share of the nodes outside the training range, by input that leaves it.
    """

    region: str
    series: str
    case: Case
    most_pitch: float
    solution: Solution
    recorded: Trajectory
    available: float
    outside: Mapping[str, float]

    @property
    def run(self) -> Trajectory:
        """Optimal states, controls, disturbances and outputs."""
        return self.solution.trajectory

    @property
    def power(self) -> float:
        """Mean electrical power in MW."""
        return self.case.efficiency * mean_power(self.run)

    @property
    def power_course(self) -> Array:
        """Electrical power in MW at the nodes."""
        return self.case.efficiency * self.run[TORQUE] * self.run[SPEED] * MEGAWATT

    @property
    def blade_activity(self) -> float:
        """RMS rate of the blade pitch in deg/s."""
        rate = np.diff(self.run[BLADE]) / np.diff(self.run.time)
        return float(np.sqrt(np.mean(rate**2)))

    @property
    def blade_mean(self) -> float:
        """Mean blade pitch in deg."""
        return mean(self.run, self.run[BLADE])

    @property
    def mean_speed(self) -> float:
        """In rpm."""
        return mean(self.run, self.run[SPEED])

    @property
    def peak_wind(self) -> float:
        """Mean wind in m/s while the platform pitch is among its highest 5 %."""
        pitch = self.run[PITCH]
        return float(self.run[WIND][pitch >= np.quantile(pitch, 1 - _PEAK)].mean())

    @property
    def replay(self) -> float:
        """Largest deviation of the platform pitch in deg when the controls are simulated."""
        replays = self.solution.replays
        return replays[0].deviation[PITCH] if replays else np.nan


@dataclass(frozen=True, eq=False)
class ControlStudy:
    """Results of the study.

    Attributes
    ----------
    results
        In the order solved.
    settings
        How much was computed.
    seconds
        Wall time.
    gains
        By model and wind, see `steady_gains`.
    """

    results: tuple[Result, ...]
    settings: ControlStudySettings
    seconds: float
    gains: Mapping[str, tuple[float, float]]

    def series(self) -> dict[tuple[str, str], dict[float, Result]]:
        """Results that differ in Θ_p,max only, by wind series and key of the case."""
        groups: dict[tuple[str, str], dict[float, Result]] = {}
        for r in self.results:
            groups.setdefault((r.series, r.case.key), {})[r.most_pitch] = r
        return groups


def optimize(
    region: Region,
    wind: Trajectory,
    case: Case,
    most_pitch: float,
    settings: ControlStudySettings,
) -> Result:
    """Solve the problem for one wind series and one limit of the platform pitch.

    Parameters
    ----------
    region
        Gives the models.
    wind
        One of the region's test runs.
    case, most_pitch
        Bounds.
    settings
        Nodes, horizon and tolerance. Where states and controls stay inside the training data, the
        optimum on fewer nodes comes first.
    """
    model = region.own if case is PAPER else region.model
    horizon = (region.start, region.start + settings.duration)
    asked = problem(model, wind, case, most_pitch, horizon)
    intervals = settings.points - 1
    method = DirectTranscription(
        scheme="trapezoidal",
        mesh=intervals,
        refine=None,
        tolerance=settings.tolerance,
        stay_inside=case.inside,
        most_iterations=1000,
    )
    guess = None
    if case.inside:
        # Its many steps cost a fraction on fewer nodes.
        coarse = replace(method, mesh=max(2, intervals // _COARSER))
        guess = optimum(asked, coarse, simulate=False)
    # Where it leaves the training data stands in the result.
    solution = optimum(asked, method, guess if guess and guess.solved else None)
    run, names = solution.trajectory, [c.name for c in model.signals.inputs]
    beyond = np.asarray(model.region.beyond(run.select(names).values)).mean(axis=0)
    outside = {n: float(v) for n, v in zip(names, beyond, strict=True) if v > 0}
    recorded = wind.window(run.time[0], run.time[-1])
    return Result(
        region=region.name,
        series=wind.name,
        case=case,
        most_pitch=most_pitch,
        solution=solution,
        recorded=recorded,
        available=region.best_coefficient * wind_power(recorded),
        outside=outside,
    )


def study(
    regions: Sequence[Region], settings: ControlStudySettings | None = None, jobs: int = 1
) -> ControlStudy:
    """Solve both cases for every wind series and every limit of the platform pitch.

    Parameters
    ----------
    regions
        Models and runs.
    settings
        How much to compute; None is what the paper does.
    jobs
        Wind series at a time, each in a process of its own.
    """
    settings = settings or ControlStudySettings()
    begin = clock.perf_counter()
    tasks = [(k, s) for k, region in enumerate(regions) for s in range(len(region.tests))]
    solved = dict(
        track(work_through(_series, (regions, settings), tasks, jobs), "series", len(tasks))
    )
    results = [result for task in tasks for result in solved[task]]
    gains = {}
    for region in regions:
        models = {"a": region.own, "b": region.model}
        for key, model in models.items():
            gains[f"{region.name}, case {key}"] = steady_gains(model, region.wind)
    return ControlStudy(tuple(results), settings, clock.perf_counter() - begin, gains)


def _series(
    shared: tuple[Sequence[Region], ControlStudySettings], task: tuple[int, int]
) -> list[Result]:
    """All problems of one wind series, named by the numbers of its region and of its run there."""
    regions, settings = shared
    region = regions[task[0]]
    wind, cases = region.tests[task[1]], (PAPER, turbine_case(region))
    return [r for case in cases for r in _limits(region, wind, case, settings)]


def _limits(
    region: Region,
    wind: Trajectory,
    case: Case,
    settings: ControlStudySettings,
) -> list[Result]:
    """Results for all limits of the platform pitch, as they stand in `settings`.

    Where an optimum keeps a tighter limit by itself, it is that limit's optimum, too. One that does
    not come to its limit is an optimum of wider limits, too, where the solver found none.
    """
    results: dict[float, Result] = {}
    last = None
    for limit in sorted(settings.pitch_limits, reverse=True):
        if last is not None and last.solution.solved and last.run[PITCH].max() < limit:
            low, high = last.solution.bounds[PITCH]
            last = _as_of(last, limit, np.stack([low, np.minimum(high, limit)]))
        else:
            last = optimize(region, wind, case, limit, settings)
        results[limit] = last
    for limit, result in results.items():
        for other in () if result.solution.solved else list(results.values()):
            room = min(other.most_pitch, limit) - _CLEAR
            if other.solution.solved and other.run[PITCH].max() < room:
                results[limit] = _as_of(other, limit, result.solution.bounds[PITCH])
    return [results[limit] for limit in settings.pitch_limits]


def _as_of(result: Result, limit: float, bounds: Array) -> Result:
    """The same result as that of another limit which it keeps."""
    solution = result.solution
    solution = replace(solution, bounds={**solution.bounds, PITCH: bounds})
    return replace(result, most_pitch=limit, solution=solution)


def steady_gains(model: DFSM, wind: float) -> tuple[float, float]:
    """How the rotor speed of a model settles when torque or blade pitch rise for good.

    Both gains are negative for a turbine: either brakes the rotor. Closed-loop data can teach a
    model the reverse, because the controller raises both when the rotor is fast.

    Parameters
    ----------
    model
        Linearized at its operating point.
    wind
        In m/s, where that is.

    Returns
    -------
    tuple of float
        In rpm per MN m and in rpm per deg.
    """
    s, (point,) = model.signals, model.region.usual(np.array([wind]))
    A, B, _, _ = model.jacobians(*model.split(point))
    gain = -np.linalg.solve(A, B)
    row = gain[[c.name for c in s.states].index(SPEED)]
    names = [c.name for c in s.controls]
    return float(row[names.index(TORQUE)] * 1e3), float(row[names.index(BLADE)])

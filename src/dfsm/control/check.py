"""A high-fidelity run under optimal controls, against what the solution had predicted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dfsm.control.flown import commands_told
from dfsm.control.solution import RATE, Solution
from dfsm.core.files import json_value
from dfsm.core.settings import require
from dfsm.core.types import Array
from dfsm.core.units import factor
from dfsm.data.conversion import in_units_of, tell_converted
from dfsm.data.trajectory import Role, Trajectory
from dfsm.errors import DfsmError, missing, printable
from dfsm.numerics.fatigue import damage_by_exponent
from dfsm.validation.results import ChannelError

# Limits count as kept within this part of their size.
_SLACK = 1e-6
# The channel of the electrical power, and the torques and speeds of one shaft, as OpenFAST names
# them: units do not tell a fast shaft from a slow one.
_GENERATOR = "GenPwr"
_SHAFTS = (
    ({"GenTq", "HSShftTq"}, {"GenSpeed", "HSShftV"}),
    ({"RotTorq", "LSShftTq", "RtAeroMxh"}, {"RotSpeed", "LSSTipVxa", "LSSTipV"}),
)
_RESPONSES = ("state", "output")


@dataclass(frozen=True)
class Figures:
    """One signal in figures, in its unit.

    Attributes
    ----------
    minimum, mean, maximum
        Over the time compared.
    damage
        1 Hz damage-equivalent load per Wöhler exponent, outputs only.
    """

    minimum: float
    mean: float
    maximum: float
    damage: Mapping[str, float]


@dataclass(frozen=True)
class ChannelCheck:
    """One channel, predicted and as it came.

    Attributes
    ----------
    unit, role
        As in the solution.
    rmse, largest
        Of the difference, in the channel's unit.
    nrmse
        RMSE over the standard deviation of the run's signal; infinite for a constant.
    predicted, actual
        Figures of both.
    """

    unit: str
    role: Role | None
    rmse: float
    largest: float
    nrmse: float
    predicted: Figures
    actual: Figures


@dataclass(frozen=True)
class LimitCheck:
    """How well one bound of the problem was kept.

    Attributes
    ----------
    predicted, actual
        Largest excess over a limit in the channel's unit, 0 where it is kept.
    at
        Time of the run's largest excess in s; None where it is kept.
    share
        Share of the run's samples beyond a limit.
    """

    predicted: float
    actual: float
    at: float | None
    share: float


@dataclass(frozen=True)
class RunCheck:
    """A high-fidelity run under optimal controls against the prediction.

    Attributes
    ----------
    name, run
        Of the solution and of the run.
    start, stop
        The time compared, in s: what both have.
    complete
        Whether that is the whole horizon.
    power
        Mean power in kW, ``predicted`` and ``actual``, either None where no channel tells it.
    power_source
        The channels that tell the power, of the prediction and of the run if these differ.
    limits
        By channel, ``"rate of …"`` for rates; bounds without a channel in the run are left out.
    channels
        By name, in the solution's order.
    missing
        Channels of the solution that the run lacks.
    power_advice
        What to do where the power is not predicted; else "".
    commands
        Of every control that was flown otherwise than commanded: by how much, and why, a sentence
        each. Where there is one, other differences say little about the model.
    """

    name: str
    run: str
    start: float
    stop: float
    complete: bool
    power: Mapping[str, float | None] | None
    power_source: str
    limits: Mapping[str, LimitCheck]
    channels: Mapping[str, ChannelCheck]
    missing: tuple[str, ...]
    power_advice: str = ""
    commands: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON values; None where not finite."""
        return dict(json_value({"format": 1, **asdict(self)}))


def check_run(
    solution: Solution, run: Trajectory, scenario: int = 1, ratio: float | None = None
) -> RunCheck:
    """Compare a run of the true system under the optimal controls with the prediction.

    Parameters
    ----------
    solution
        From `solve` or `load_solution`.
    run
        Of the same controls and disturbances, with channels named as in the solution. Channels
        that it lacks are left out and listed.
    scenario
        The one whose controls were used, counted from 1.
    ratio
        Speed of the torque's shaft over that of the speed's channel: with it the mean power is
        computed from the only torque and the only speed, whatever they are called.

    Returns
    -------
    RunCheck

    Raises
    ------
    DfsmError
        Run and horizon have no time in common, the run has none of the channels, one in a unit of
        something else, or samples that are not finite.

    Warns
    -----
    DfsmWarning
        Channels were converted to the solution's units.
    """
    count = len(solution.trajectories)
    require(1 <= scenario <= count, "scenario", scenario, f"1 to {count}")
    full = solution.trajectories[scenario - 1]
    kept = [c.name for c in full.channels if c.name in run and c.role != "parameter"]
    absent = tuple(c.name for c in full.channels if c.name not in run and c.role != "parameter")
    if not kept:
        raise DfsmError(f"{run.where}: {missing(absent, run.names)}")
    require(ratio is None or ratio > 0, "ratio", ratio, "a number above 0")
    common = in_units_of(_common(full, run), full.channels, "the solution")
    tell_converted([run], [common])
    actual = common.select(kept).require_finite()
    whole = _prediction(solution, scenario - 1, actual.time)
    predicted = whole.select(kept)
    slack = 1e-6 * full.duration
    power, source, advice = _power(whole, common, ratio)
    return RunCheck(
        name=solution.name,
        run=run.where,
        start=float(actual.time[0]),
        stop=float(actual.time[-1]),
        complete=bool(
            run.time[0] <= full.time[0] + slack and run.time[-1] >= full.time[-1] - slack
        ),
        power=power,
        power_source=source,
        limits=_limits(solution, full.time, predicted, actual),
        channels={name: _channel(predicted, actual, name) for name in kept},
        missing=absent,
        power_advice=advice,
        commands=commands_told(predicted, actual),
    )


def _common(full: Trajectory, run: Trajectory) -> Trajectory:
    """The part of the run that lies in the horizon."""
    start, stop = (max(full.time[0], run.time[0]), min(full.time[-1], run.time[-1]))
    if stop <= start:
        raise DfsmError(
            f"{run.where}: runs from {run.time[0]:g} s to {run.time[-1]:g} s, the horizon from "
            f"{full.time[0]:g} s to {full.time[-1]:g} s: they have no time in common"
        )
    return run.window(float(start), float(stop))


def _prediction(solution: Solution, scenario: int, time: Array) -> Trajectory:
    """All channels of the solution at times in s; states and controls by its own polynomials."""
    full = solution.trajectories[scenario]
    time = np.clip(time, full.time[0], full.time[-1])
    resampled = full.resample(time)
    values = np.array(resampled.values)
    parts = solution.at((time - full.time[0]) / full.duration, scenario)
    for role, part in zip(("state", "control"), parts, strict=True):
        values[:, [i for i, c in enumerate(full.channels) if c.role == role]] = part
    return Trajectory(time, values, full.channels, name=full.name)


def _channel(predicted: Trajectory, actual: Trajectory, name: str) -> ChannelCheck:
    channel, error = predicted.channel(name), ChannelError.of(predicted[name], actual[name])
    is_load = channel.role == "output"
    return ChannelCheck(
        unit=channel.unit,
        role=channel.role,
        rmse=error.rmse,
        largest=error.maximum,
        nrmse=error.nrmse,
        predicted=_figures(predicted, name, is_load),
        actual=_figures(actual, name, is_load),
    )


def _figures(run: Trajectory, name: str, is_load: bool) -> Figures:
    values = run[name]
    damage = damage_by_exponent(values, run.duration) if is_load else {}
    mean = float(np.trapezoid(values, run.time)) / run.duration
    return Figures(float(values.min()), mean, float(values.max()), damage)


def _limits(
    solution: Solution, nodes: Array, predicted: Trajectory, actual: Trajectory
) -> dict[str, LimitCheck]:
    checks = {}
    for name, pair in solution.bounds.items():
        channel = name.removeprefix(RATE)
        if channel not in actual:
            continue
        time, signals = actual.time, [predicted[channel], actual[channel]]
        # A recorded value may lie one rounding beyond its limit.
        rounding = actual.channel(channel).step or 0.0
        if name.startswith(RATE):
            signals = [np.diff(s) / np.diff(time) for s in signals]
            rounding /= float(np.diff(time).min())
            time = (time[1:] + time[:-1]) / 2
        low, high = (_between(time, nodes, limit) for limit in pair)
        excess = [np.maximum(np.maximum(low - s, s - high), 0.0) for s in signals]
        size = np.abs([*low, *high])
        slack = rounding + _SLACK * size[np.isfinite(size)].max(initial=0.0)
        excess = [np.where(e > slack, e, 0.0) for e in excess]
        worst = int(np.argmax(excess[1]))
        most = float(excess[1][worst])
        checks[name] = LimitCheck(
            predicted=float(excess[0].max()),
            actual=most,
            at=float(time[worst]) if most > 0 else None,
            share=float(np.mean(excess[1] > 0)),
        )
    return checks


def _between(time: Array, nodes: Array, limit: Array) -> Array:
    """A limit between the nodes; one that is infinite somewhere holds its next value."""
    if np.isfinite(limit).all():
        return np.interp(time, nodes, limit)
    return limit[np.clip(np.searchsorted(nodes, time), 0, len(nodes) - 1)]


def _power(
    predicted: Trajectory, actual: Trajectory, ratio: float | None
) -> tuple[dict[str, float | None] | None, str, str]:
    """Mean power in kW predicted and of the run, what tells it, and what to do where nothing does.

    `predicted` and `actual` hold all channels of the solution and of the run.
    """
    factors, advice = _factors(predicted, ratio)
    named = _power_channel(actual, next(iter(factors)) if len(factors) == 1 else "")
    came = named or (factors if all(name in actual for name in factors) else {})
    if not came:
        return None, "", advice

    def mean(run: Trajectory, factors: Mapping[str, float]) -> float | None:
        if not factors:
            return None
        run = run.select(factors).require_finite()
        power = np.prod([size * run[name] for name, size in factors.items()], axis=0)
        return float(np.trapezoid(power, run.time)) / run.duration

    told = (" × ".join(printable(name) for name in f) for f in (factors, came))
    source = " → ".join(dict.fromkeys(text for text in told if text))
    return {"predicted": mean(predicted, factors), "actual": mean(actual, came)}, source, advice


def _factors(run: Trajectory, ratio: float | None) -> tuple[dict[str, float], str]:
    """Channels whose product is the power, with their sizes in kW, kN m and rad/s, and advice."""
    if named := _power_channel(run):
        return named, ""
    torques = [c.name for c in run.channels if factor(c.unit, "kN m") and c.role == "control"]
    speeds = [c.name for c in run.channels if factor(c.unit, "rad/s") and c.role in _RESPONSES]
    sizes = {n: factor(run.channel(n).unit, "kN m") or 0.0 for n in torques} | {
        n: factor(run.channel(n).unit, "rad/s") or 0.0 for n in speeds
    }
    for shaft in _SHAFTS:
        pairs = [(t, s) for t in torques for s in speeds if t in shaft[0] and s in shaft[1]]
        if len(pairs) == 1:
            return {name: sizes[name] for name in pairs[0]}, ""
    if len(torques) != 1 or len(speeds) != 1:
        return {}, ""
    torque, speed = torques[0], speeds[0]
    if ratio is not None:
        return {torque: sizes[torque], speed: ratio * sizes[speed]}, ""
    return {}, (
        f"no power is predicted from {torque} and {speed}, which may belong to different shafts: "
        "give the gearbox ratio between them with --ratio, 1 for one shaft"
    )


def _power_channel(run: Trajectory, name: str = "") -> dict[str, float]:
    """The channel that holds the power: this one, the generator's, or the only one there is."""
    sizes = {c.name: factor(c.unit, "kW") for c in run.channels if c.role != "control"}
    known = {n: size for n, size in sizes.items() if size is not None}
    for wanted in (name, _GENERATOR):
        if wanted in known:
            return {wanted: known[wanted]}
    return known if len(known) == 1 else {}

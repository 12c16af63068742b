"""What `dfsm init` proposes for the channels of some runs: roles, each with a reason.

Channels of a wind turbine are known by name. Those of any other system are looked at: what is
constant within runs, what is the rate of another, whose rate follows from the others. All of it is
a proposal; a reason stands beside each so that a reader can confirm it or not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dfsm.core.types import Array
from dfsm.data.between import recognised
from dfsm.data.derivatives import per_second
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.fitting.causes import driven_by_past, lost_its_sign

# What wind engineers usually choose; only names that exist are proposed. The rate of a rotor's
# speed is none of its states: nothing that is recorded explains how it changes.
_SECOND_ORDER = ("PtfmSurge", "PtfmHeave", "PtfmPitch", "TTDspFA")
_SPEEDS = ("GenSpeed", "RotSpeed")
_CONTROLS = ("GenTq", "BldPitch1")
_OUTPUTS = ("TwrBsFxt", "TwrBsMyt", "GenPwr")
WINDS = ("RotWind", "RtVAvgxh", "Wind1VelX")
_WITH_WIND = ("RotShearV", "RotShearH", "Wave1Elev")
_TURBINE = {*_SECOND_ORDER, *_SPEEDS, *_CONTROLS, *_OUTPUTS, *WINDS}
# Correlation with a channel's derivative from which another is its rate, and how far off one its
# slope may be.
_IS_RATE, _SLOPE = 0.9, 0.1
# Share of a derivative's variance that others must explain in a state, and of its own in an output.
_STATE, _OUTPUT = 0.6, 0.95
# Explained by less, a state is not to be told by derivatives alone.
_CLEAR = 0.95
_MOST_SAMPLES, _MOST_CHANNELS = 4000, 60


@dataclass(frozen=True)
class Proposal:
    """Roles of the channels.

    Attributes
    ----------
    states
        As in ``signals.states``.
    controls, disturbances, parameters, outputs
        Names.
    features
        As in ``signals.features``.
    reasons
        Why, by channel.
    wind
        The turbine's wind, along which its linear fit varies.
    turbine
        Whether the channels are those of a wind turbine.
    held
        Controls and disturbances that stay and jump, and so are held between samples.
    hidden
        Whether what is measured has states beside it that nobody measures.
    unexplained
        Then, of the derivatives of the states, what recorded channels leave: RMS over the standard
        deviation, by state.
    """

    states: list[dict[str, Any]]
    controls: list[str]
    disturbances: list[str]
    parameters: list[str]
    outputs: list[str]
    features: list[dict[str, Any]] = field(default_factory=list)
    reasons: dict[str, str] = field(default_factory=dict)
    wind: str | None = None
    turbine: bool = False
    held: tuple[str, ...] = ()
    hidden: bool = False
    unexplained: dict[str, float] = field(default_factory=dict)


def propose(
    runs: Sequence[Trajectory], varying: Sequence[str], parameters: Sequence[str]
) -> Proposal:
    """Propose roles.

    Parameters
    ----------
    runs
        All training runs.
    varying, parameters
        Channels that all runs share and that vary, or are constant within but not over the runs.
    """
    reasons = dict.fromkeys(parameters, "constant within runs, not over them: parameter")
    rates = _rates(runs[0], varying)
    for name, base in rates.items():
        reasons[name] = f"rate of {base}"
    kinds = recognised(runs, varying)
    held = [n for n, kind in zip(varying, kinds, strict=True) if kind == "hold"]
    if _TURBINE & set(varying):
        proposed = _of_turbine(varying, list(parameters), rates, reasons)
    else:
        reasons |= dict.fromkeys(held, "control: it stays and jumps, as what is held does")
        proposed = _of_anything(runs[0], varying, list(parameters), rates, reasons)
        states = {s["name"] for s in proposed.states} if proposed.hidden else set()
        names = [n for n in varying if n in {*held, *proposed.controls} - states]
        proposed = replace(proposed, controls=names)
    driving = {*proposed.controls, *proposed.disturbances}
    return replace(proposed, held=tuple(n for n in held if n in driving))


def _of_turbine(
    varying: Sequence[str],
    parameters: list[str],
    rates: Mapping[str, str],
    reasons: dict[str, str],
) -> Proposal:
    states = [_second_order(n, rates) for n in _SECOND_ORDER if n in varying]
    speed = next((s for s in _SPEEDS if s in varying), None)
    if speed:
        states.append({"name": speed, "order": 1})
        reasons[speed] = "state of order 1: its rate is no state of the rotor"
    wind = next((w for w in WINDS if w in varying), None)
    disturbances = [wind] if wind else []
    disturbances += [d for d in _WITH_WIND if d in varying]
    features = []
    if "Wave1Elev" in disturbances and "Wave1Elev_dot" not in varying:
        features = [{"source": "Wave1Elev", "kind": "rate"}]
    roles = {
        "control": [c for c in _CONTROLS if c in varying],
        "disturbance": disturbances,
        "output": [o for o in _OUTPUTS if o in varying],
    }
    for role, names in roles.items():
        reasons |= {n: reasons.get(n, role) for n in names}
    for state in states[: len(states) - bool(speed)]:
        reasons[state["name"]] = "state of order 2: it swings"
    return Proposal(
        states, roles["control"], disturbances, parameters, roles["output"],
        features, reasons, wind, turbine=True,
    )  # fmt: skip


def _of_anything(
    run: Trajectory,
    varying: Sequence[str],
    parameters: list[str],
    rates: Mapping[str, str],
    reasons: dict[str, str],
) -> Proposal:
    states, outputs, controls, disturbances = [], [], [], []
    shares: list[float] = []
    left: dict[str, float] = {}
    names = [n for n in varying if n not in rates]
    if len(names) > _MOST_CHANNELS:
        return Proposal([], [], [], parameters, [], [], reasons)
    time, table = _thinned(run, names)
    first = np.gradient(table, time, axis=0)
    second = np.gradient(first, time, axis=0)
    for i, name in enumerate(names):
        if name in reasons:
            continue
        others = np.delete(table, i, axis=1)
        known = next((r for r, base in rates.items() if base == name), None)
        once = _explained(first[:, i], table)
        left[name] = float(np.sqrt(max(0.0, 1 - once)))
        twice = _explained(second[:, i], np.column_stack([table, first[:, i]]))
        if known or (twice >= _STATE and twice > once):
            states.append(_second_order(name, rates))
            shares.append(twice)
            reasons[name] = "state of order 2: its second derivative follows from it and the others"
        elif once >= _STATE:
            states.append({"name": name, "order": 1})
            shares.append(once)
            reasons[name] = "state: its rate follows from it and the others"
        elif others.shape[1] and _explained(table[:, i], others) >= _OUTPUT:
            outputs.append(name)
            reasons[name] = "output: it follows from the others at once"
        elif np.mean(np.diff(run[name]) == 0) > 1 / 2:
            controls.append(name)
            reasons[name] = "control: it stays and jumps, and nothing recorded explains it"
        else:
            disturbances.append(name)
            reasons[name] = "disturbance (or control): nothing recorded explains it"
    unclear = not shares or min(shares) < _CLEAR or not (controls or disturbances)
    if not rates and unclear and (driven := driven_by_past(run, names)):
        hidden = _with_hidden(run, names, driven, parameters, reasons)
        return replace(hidden, unexplained={n: left[n] for n in driven if n in left})
    return Proposal(states, controls, disturbances, parameters, outputs, [], reasons)


def _with_hidden(
    run: Trajectory,
    names: Sequence[str],
    driven: Sequence[str],
    parameters: list[str],
    reasons: dict[str, str],
) -> Proposal:
    """Roles where derivatives do not tell: what the past of others drives, and these others."""
    controls, disturbances = [], []
    for name in names:
        if name in driven:
            reasons[name] = "state, with hidden ones beside it: the past of the others drives it"
            if lost_its_sign(run, name, names):
                reasons[name] += "; it touches an end with kinks, as absolute values do"
        elif np.mean(np.diff(run[name]) == 0) > 1 / 2:
            controls.append(name)
            reasons[name] = "control: it stays and jumps, and no past of the others explains it"
        else:
            disturbances.append(name)
            reasons[name] = "disturbance (or control): no past of the others explains it"
    states = [{"name": name, "order": 1} for name in driven]
    return Proposal(states, controls, disturbances, parameters, [], [], reasons, hidden=True)


def _second_order(name: str, rates: Mapping[str, str]) -> dict[str, Any]:
    rate = next((r for r, base in rates.items() if base == name), None)
    return {"name": name, "order": 2} | ({"rate": rate} if rate else {})


def _rates(run: Trajectory, names: Sequence[str]) -> dict[str, str]:
    """Channels that are the rate of another, each with that one; names may share no unit."""
    if len(names) > 10 * _MOST_CHANNELS or len(run) < 10:
        return {}
    time, table = _thinned(run, names, every=False)
    slopes = np.gradient(table, time, axis=0)
    a, b = table - table.mean(axis=0), slopes - slopes.mean(axis=0)
    covariance = b.T @ a / len(a)
    size_a = np.maximum(a.std(axis=0), np.finfo(float).tiny)
    size_b = np.maximum(b.std(axis=0), np.finfo(float).tiny)
    likeness = covariance / np.outer(size_b, size_a)
    slope = covariance / size_b[:, None] ** 2
    found: dict[str, str] = {}
    for i, base in enumerate(names):
        for j, name in enumerate(names):
            alike = likeness[i, j] > _IS_RATE and abs(slope[i, j] - 1) < _SLOPE
            if i != j and alike and _fits(run.channel(base), run.channel(name)):
                found[name] = base
    return found


def _fits(base: Channel, rate: Channel) -> bool:
    return not base.unit or not rate.unit or per_second(base.unit) == rate.unit


def _thinned(run: Trajectory, names: Sequence[str], every: bool = True) -> tuple[Array, Array]:
    """Some thousand samples of the second half of a run; neighbours unless `every`."""
    values, time = run.select(names).values, run.time
    stride = max(1, len(time) // _MOST_SAMPLES) if every else 1
    half = len(time) // 2 if len(time) > _MOST_SAMPLES else 0
    keep = slice(half, None, stride) if every else slice(half, half + _MOST_SAMPLES)
    return time[keep], np.nan_to_num(values[keep])


def _explained(target: Array, inputs: Array) -> float:
    """Share of a variance that a linear fit explains, less what chance does."""
    X, y = inputs - inputs.mean(axis=0), target - target.mean()
    X = X / np.maximum(X.std(axis=0), np.finfo(float).tiny)
    total = float(y @ y)
    if not total > 0:
        return 0.0
    left = y - X @ np.linalg.lstsq(X.T @ X, X.T @ y, rcond=1e-12)[0]
    return 1 - float(left @ left) / total

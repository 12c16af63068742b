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
from threadpoolctl import threadpool_limits

from dfsm.config.roles import Judge
from dfsm.data.between import recognised
from dfsm.data.conversion import in_one_unit
from dfsm.data.rates import matched_rates
from dfsm.data.trajectory import Trajectory
from dfsm.errors import hushed
from dfsm.fitting.causes import driven_by_past, lost_its_sign
from dfsm.numerics.time_mesh import uneven

# What wind engineers usually choose; only names that exist are proposed. The rate of a rotor's
# speed is none of its states: nothing that is recorded explains how it changes.
_SECOND_ORDER = ("PtfmSurge", "PtfmHeave", "PtfmPitch")
# One deflection by two names of ElastoDyn; the second where the first is not recorded.
TOWER_TOPS = ("TTDspFA", "YawBrTDxp")
_FLOATING = {"PtfmSurge", "PtfmHeave", "PtfmPitch"}
_SPEEDS = ("GenSpeed", "RotSpeed")
_CONTROLS = ("GenTq", "BldPitch1")
_OUTPUTS = ("TwrBsFxt", "TwrBsMyt", "GenPwr")
WINDS = ("RotWind", "RtVAvgxh", "Wind1VelX")
_WITH_WIND = ("RotShearV", "RotShearH", "Wave1Elev")
# Waves reach a floating hull before they reach the point where their elevation is told.
_AHEAD = (2, 4, 6)
_TURBINE = {*_SECOND_ORDER, *TOWER_TOPS, *_SPEEDS, *_CONTROLS, *_OUTPUTS, *WINDS}
# RMS that is left of the rate of a state, and of a second derivative that nobody recorded, above
# which a state is not to be told by derivatives alone: the latter are less sure on coarse samples.
_CLEAR, _CLEAR_TWICE = 0.22, 0.1
# Most states of a system whose unmeasured rates are told as hidden states.
_MOST_RATES = 3
_MOST_CHANNELS = 60


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
    coarse
        Then, states whose second derivative is not to be had, with their samples per swing once
        noise is averaged out.
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
    coarse: dict[str, float] = field(default_factory=dict)


@threadpool_limits.wrap(limits=1)
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
    with hushed():  # told by what reads the configuration
        runs = in_one_unit(runs, varying)
    reasons = dict.fromkeys(parameters, "constant within runs, not over them: parameter")
    rates = matched_rates(runs, varying)
    for name, base in rates.items():
        reasons[name] = f"rate of {base}"
    kinds = recognised(runs, varying)
    held = [n for n, kind in zip(varying, kinds, strict=True) if kind == "hold"]
    if _TURBINE & set(varying):
        proposed = _of_turbine(varying, list(parameters), rates, reasons)
    else:
        reasons |= dict.fromkeys(held, "control: it stays and jumps, as what is held does")
        proposed = _of_anything(runs, varying, list(parameters), rates, held, reasons)
    driving = {*proposed.controls, *proposed.disturbances}
    return replace(proposed, held=tuple(n for n in held if n in driving))


def _of_turbine(
    varying: Sequence[str],
    parameters: list[str],
    rates: Mapping[str, str],
    reasons: dict[str, str],
) -> Proposal:
    tower = [n for n in TOWER_TOPS if n in varying][:1]
    swinging = [n for n in _SECOND_ORDER if n in varying] + tower
    states = [_second_order(n, rates) for n in swinging]
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
    if "Wave1Elev" in disturbances and _FLOATING & set(varying):
        features += [{"source": "Wave1Elev", "kind": "lead", "seconds": s} for s in _AHEAD]
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
    runs: Sequence[Trajectory],
    varying: Sequence[str],
    parameters: list[str],
    rates: Mapping[str, str],
    held: Sequence[str],
    reasons: dict[str, str],
) -> Proposal:
    # A rate of a rate tells nothing more, and would explain the rate by itself.
    names = [n for n in varying if rates.get(n) not in rates]
    if not names or len(names) > _MOST_CHANNELS:
        return Proposal([], [], [], parameters, [], [], reasons)
    rates = {n: base for n, base in rates.items() if n in names}
    found = Judge(runs, names, rates, held).roles()
    clear = bool(found.orders) and all(found.left[n] <= _CLEAR for n in found.orders)
    clear &= all(found.left[n] <= _CLEAR_TWICE for n, order in found.orders.items() if order == 2)
    even = uneven([r.time for r in runs])[1] is None
    coarse = found.coarse if even and len(found.orders) <= _MOST_RATES else {}
    if not rates and not (clear and found.inputs and not coarse):
        run, measured = max(runs, key=len), [n for n in names if n not in found.outputs]
        driven = driven_by_past(run, measured)
        # Where both ways tell a state, they must tell the same one.
        if driven and {*found.orders} <= {*driven}:
            hidden = _with_hidden(run, measured, driven, parameters, reasons, hidden=even)
            reasons |= {n: found.reasons[n] for n in found.outputs}
            if not even:
                return replace(hidden, outputs=found.outputs)
            left = {n: found.left[n] for n in driven if n in found.left and n not in coarse}
            return replace(hidden, unexplained=left, coarse=coarse, outputs=found.outputs)
    reasons |= {n: text for n, text in found.reasons.items() if n not in held or "set-p" in text}
    states = [
        _second_order(n, rates) | {"order": order} if order == 1 else _second_order(n, rates)
        for n, order in found.orders.items()
    ]
    controls, disturbances = [], []
    for name in found.inputs:
        if name in held or name in found.set_points.values():
            controls.append(name)
        elif np.mean(np.diff(runs[0][name]) == 0) > 1 / 2:
            controls.append(name)
            reasons[name] = "control: it stays and jumps, and nothing recorded explains it"
        else:
            disturbances.append(name)
            reasons[name] = "disturbance (or control): nothing recorded explains it"
    return Proposal(states, controls, disturbances, parameters, found.outputs, [], reasons)


def _with_hidden(
    run: Trajectory,
    names: Sequence[str],
    driven: Sequence[str],
    parameters: list[str],
    reasons: dict[str, str],
    hidden: bool,
) -> Proposal:
    """Roles where derivatives do not tell: what the past of others drives, and these others."""
    controls, disturbances = [], []
    for name in names:
        if name in driven:
            beside = ", with hidden ones beside it" if hidden else ""
            reasons[name] = f"state{beside}: the past of the others drives it"
            if lost_its_sign(run, name, names):
                reasons[name] += "; it touches an end with kinks, as absolute values do"
        elif np.mean(np.diff(run[name]) == 0) > 1 / 2:
            controls.append(name)
            reasons[name] = "control: it stays and jumps, and no past of the others explains it"
        else:
            disturbances.append(name)
            reasons[name] = "disturbance (or control): no past of the others explains it"
    states = [{"name": name, "order": 1} for name in driven]
    return Proposal(states, controls, disturbances, parameters, [], [], reasons, hidden=hidden)


def _second_order(name: str, rates: Mapping[str, str]) -> dict[str, Any]:
    rate = next((r for r, base in rates.items() if base == name), None)
    return {"name": name, "order": 2} | ({"rate": rate} if rate else {})

"""Linear-quadratic regulators of a model at an operating point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dfsm.controllers.controller import INTERVAL
from dfsm.controllers.state_space import StateFeedback, regulator_gain
from dfsm.core.host import from_host
from dfsm.core.settings import require, require_kind, require_number
from dfsm.errors import DfsmError, missing
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.steady import SteadyState


def linear_quadratic(
    model: DFSM,
    point: SteadyState,
    *,
    states: Mapping[str, float],
    controls: Mapping[str, float],
    interval: float,
    integral: Mapping[str, float] | None = None,
    limits: tuple[Any, Any] = (-np.inf, np.inf),
) -> StateFeedback:
    """State feedback that is optimal for the model linearized at a steady state.

    Minimizes Σ (Δx/s)² + (∫Δx dt/i)² + (Δu/r)², with s, i and r what one accepts of each.

    Parameters
    ----------
    model
        The surrogate.
    point
        Where, see `steady_state`.
    states
        Deviation s of each measured state that one accepts, in its unit; what is not named has no
        weight.
    controls
        The controls to use, and how much r of each one accepts.
    interval
        Time between two steps in s.
    integral
        Integrated deviation i of some states that one accepts, in their unit times s: these have no
        error in the end.
    limits
        Lowest and highest commands.

    Returns
    -------
    StateFeedback

    Raises
    ------
    DfsmError
        A state or control that the model does not have, a deviation or an interval that is not
        positive, or no such regulator.
    """
    require_model(model)
    require_kind("point", point, SteadyState, "a steady state, as dfsm.steady_state finds it")
    require_number("interval", interval, INTERVAL, above=0)
    for where, told in (("states", states), ("integral", integral or {}), ("controls", controls)):
        require_kind(where, told, Mapping, "the deviation that one accepts by name")
    s, integral = model.signals, dict(integral or {})
    names = [c.name for c in s.observed]
    for told, known, where in (
        (states, names, "states"),
        (integral, names, "integral"),
        (controls, s.names("controls"), "controls"),
    ):
        if lost := [n for n in told if n not in known]:
            raise DfsmError(f"{where}: the model has {missing(lost, known)}")
        for name, value in told.items():
            # A state of which any deviation is accepted has no weight.
            free = where == "states"
            expected = "a deviation above 0"
            require_number(f"{where}: {name}", value, expected, above=0, infinite=free)
    require(bool(controls), "controls", "empty", "at least one control")
    n, chosen = len(names), [s.names("controls").index(c) for c in controls]
    A, B, *_ = model.jacobians(point.states, point.controls, point.disturbances, point.parameters)
    # Latent states follow from the inputs, and nobody measures them.
    A, B = A[:n, :n], B[:n, chosen]
    m = len(integral)
    summed = np.array([[float(a == b) for b in names] for a in integral]).reshape(m, n)
    wide_A = np.block([[A, np.zeros((n, m))], [summed, np.zeros((m, m))]])
    wide_B = np.concatenate([B, np.zeros((m, B.shape[1]))])
    accepted = [*(states.get(name, np.inf) for name in names), *integral.values()]
    gain = regulator_gain(
        wide_A,
        wide_B,
        np.diag(np.array(accepted) ** -2.0),
        np.diag(np.array(list(controls.values())) ** -2.0),
        interval,
    )
    summing = from_host(gain[:, n:] @ summed) if m else None
    return StateFeedback(
        gain=gain[:, :n],
        integral_gain=summing,
        x0=point.states[:n],
        u0=point.controls[chosen],
        measurements=names,
        measurement_units=[c.unit for c in s.observed],
        commands=list(controls),
        command_units=[s.controls[i].unit for i in chosen],
        interval=interval,
        limits=limits,
    )

"""Records as people bring them, of systems whose equation is known: what a fit gives and says.

Every system is x' = A x + B u (the free decay x'' = -0.05 x - 0.03 x'). *Plain* is a spline through
the samples, its derivative, and least squares with all samples alike.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

import dfsm
from dfsm.core.types import Array

_SETTINGS = dfsm.FitSettings(
    states=(dfsm.StateSpec(name="x"),),
    controls=("u",),
    corrective=dfsm.NoCorrection(),
    nonlinear_only=False,
)
# Letters of a warning that are shown.
_SHOWN = 110


@dataclass(frozen=True)
class System:
    """A record and what is true of it.

    Attributes
    ----------
    true
        Coefficients of the last state's derivative, by input.
    run
        The record.
    settings
        Those of the fit.
    """

    true: Mapping[str, float]
    run: dfsm.Trajectory
    settings: dfsm.FitSettings = _SETTINGS


def _record(time: Array, **channels: Array) -> dfsm.Trajectory:
    named = tuple(dfsm.Channel(name, "m" if name == "x" else "N") for name in channels)
    return dfsm.Trajectory(time, np.stack(list(channels.values()), axis=1), named)


def _sines(time: Array) -> Array:
    return np.sin(0.9 * time) + np.sin(0.37 * time + 1) + np.sin(0.13 * time + 2)


def _answer(time: Array, u: Callable[[float], float], A: float, B: float) -> Array:
    """X at some times, integrated with steps that miss nothing of the input."""
    span = (float(time[0]), float(time[-1]))
    f = lambda t, x: A * x + B * u(t)  # noqa: E731
    y = solve_ivp(f, span, [0.5], t_eval=time, rtol=1e-9, atol=1e-11, max_step=0.1).y
    return y[0]


def _held() -> System:
    time = np.arange(0, 200, 0.5)
    u = np.repeat(np.random.default_rng(0).normal(size=100), 4)
    x, decay = np.zeros(len(time)), np.exp(-0.357 * 0.5)
    for k in range(len(time) - 1):
        x[k + 1] = decay * x[k] + (1 - decay) * u[k]
    return System({"A": -0.357, "B": 0.357}, _record(time, x=x, u=u))


def _bunched() -> System:
    even = np.linspace(0, 60, 601)
    time = np.unique(np.concatenate([even, np.linspace(0, 0.1, 90), np.linspace(30, 30.1, 90)]))
    noise = 2e-3 * np.random.default_rng(1).normal(size=len(time))
    x = _answer(time, lambda t: float(_sines(np.array(t))), -0.5, 1.0)
    return System({"A": -0.5, "B": 1.0}, _record(time, x=x + noise, u=_sines(time)))


def _late() -> System:
    time = np.arange(0, 3000, 4.0)
    slow = lambda t: float(_sines(np.array(t) / 25))  # noqa: E731
    x = _answer(time, lambda t: slow(t - 20), -1 / 150, 0.9 / 150)
    u = np.array([slow(t) for t in time])
    return System({"A": -1 / 150, "B": 0.9 / 150}, _record(time, x=x, u=u))


def _delay_told() -> System:
    system = _late()
    late = dfsm.Feature(source="u", kind="delay", seconds=20.0)
    settings = replace(system.settings, controls=(), disturbances=("u",), features=(late,))
    return replace(system, settings=settings)


def _closed_loop() -> System:
    rng, count = np.random.default_rng(2), 1200
    force = rng.normal(size=count)
    for lag in (30, 6):
        a = np.exp(-1 / lag)
        for k in range(1, count):
            force[k] = a * force[k - 1] + (1 - a) * force[k]
    force *= 0.1 / force.std()
    x, u, integral = np.zeros(count), np.zeros(count), 0.0
    for k in range(count - 1):
        u[k] = -(x[k] + 0.05 * integral)
        integral += x[k]
        x[k + 1] = x[k] - 0.05 * x[k] + 0.1 * u[k] + force[k]
    u[-1] = u[-2]
    return System({"A": -0.05, "B": 0.1}, _record(np.arange(count, dtype=float), x=x, u=u))


def _events() -> System:
    time = np.arange(0, 60, 0.1)
    jumps = np.arange(5.0, 60, 5.0)
    value = lambda t: float(np.sin(7.0 * np.floor(t / 5)))  # noqa: E731
    twins = np.sort(np.concatenate([time, jumps + 1e-10]))
    states = _answer(twins, value, -0.7, 1.0)
    # Just before a jump the input is still what it was.
    u = np.array([value(t - 1e-9 if np.isclose(t, jumps, atol=1e-12).any() else t) for t in twins])
    settings = replace(_SETTINGS, inputs="linear")
    return System({"A": -0.7, "B": 1.0}, _record(twins, x=states, u=u), settings)


def _blows() -> System:
    time = np.arange(0, 200, 0.2)
    u, rng = _sines(time), np.random.default_rng(5)
    for first in rng.choice(np.arange(20, 980, 20), 8, replace=False):
        u[first : first + 2] += 30.0
    # Steps of RK4 within lines from sample to sample miss nothing.
    x, fine = [0.5], 20
    for a, b in pairwise(u):
        now, h = x[-1], 0.2 / fine
        for k in range(fine):
            first, middle, last = (a + (b - a) * (k + part) / fine for part in (0, 0.5, 1))
            k1 = -0.4 * now + first
            k2 = -0.4 * (now + h / 2 * k1) + middle
            k3 = -0.4 * (now + h / 2 * k2) + middle
            now += h / 6 * (k1 + 2 * k2 + 2 * k3 - 0.4 * (now + h * k3) + last)
        x.append(now)
    return System({"A": -0.4, "B": 1.0}, _record(time, x=np.array(x), u=u))


def _decay() -> System:
    time = np.arange(0, 100, 0.1)
    slopes = np.array([[0.0, 1.0], [-0.05, -0.03]])
    x = np.array([expm(slopes * t)[0, 0] * 5.0 for t in time])
    settings = replace(_SETTINGS, states=(dfsm.StateSpec(name="x", order=2),), controls=())
    return System({"A": -0.05, "A of the rate": -0.03}, _record(time, x=x), settings)


def _integrator() -> System:
    time = np.arange(0, 100, 0.1)
    x = _answer(time, lambda t: float(_sines(np.array(t))), 0.0, 0.2)
    return System({"A": 0.0, "B": 0.2}, _record(time, x=x, u=_sines(time)))


def _noisy_input() -> System:
    time = np.arange(0, 400, 0.2)
    x = _answer(time, lambda t: float(_sines(np.array(t))), -0.4, 1.0)
    noise = np.random.default_rng(3).normal(size=len(time))
    return System({"A": -0.4, "B": 1.0}, _record(time, x=x, u=_sines(time) + 0.7 * noise))


def _short() -> System:
    time = np.linspace(0, 1.0, 12)
    x = _answer(time, lambda t: float(_sines(np.array(t))), -0.4, 1.0)
    noise = 1e-3 * np.random.default_rng(4).normal(size=len(time))
    return System({"A": -0.4, "B": 1.0}, _record(time, x=x + noise, u=_sines(time)))


SYSTEMS: dict[str, Callable[[], System]] = {
    "an input held between samples": _held,
    "a solver's mesh, dense in places": _bunched,
    "an input that acts 20 s late": _late,
    "the same with the delay as a feature": _delay_told,
    "a controller against an unknown force": _closed_loop,
    "two samples at every event": _events,
    "eight hammer blows on a smooth force": _blows,
    "free decay, no input": _decay,
    "an integrator": _integrator,
    "a noisy input": _noisy_input,
    "twelve samples": _short,
}


def run() -> dict[str, Any]:
    """Coefficients by system: true, plain, and what dfsm gives; and the first it tells."""
    figures = {}
    for name, make in SYSTEMS.items():
        system = make()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", dfsm.DfsmWarning)
            model = dfsm.fit([system.run], system.settings).model
        told = [str(w.message) for w in caught if issubclass(w.category, dfsm.DfsmWarning)]
        names = [c.name for c in model.signals.inputs]
        row = dict(zip(names, np.asarray(model.f.coefficients).mean(axis=0)[-1], strict=True))
        inputs = [n for n in names if n not in ("x", "x_dot")]
        fitted = {"A": float(row["x"])}
        if "x_dot" in row:
            fitted["A of the rate"] = float(row["x_dot"])
        if inputs:
            # With a delay as well as the input itself, the effect is that of both.
            fitted["B"] = float(sum(row[n] for n in inputs))
        figures[name] = {
            "true": dict(system.true),
            "plain": plain(system),
            "dfsm": fitted,
            "told": told[0] if told else "",
        }
    return figures


def plain(system: System) -> dict[str, float]:
    """What a spline and least squares give."""
    run = system.run
    spline = CubicSpline(run.time, run["x"])
    columns = {"A": run["x"]}
    target = spline.derivative()(run.time)
    if "A of the rate" in system.true:
        columns["A of the rate"] = target
        target = spline.derivative(2)(run.time)
    if "u" in run:
        columns["B"] = run["u"]
    X = np.stack([*columns.values(), np.ones(len(run))], axis=1)
    solved = np.linalg.lstsq(X, target, rcond=None)[0]
    return dict(zip(columns, solved.tolist(), strict=False))


def field_table(figures: Mapping[str, Any]) -> list[str]:
    """One line per system: coefficients A, B (of the decay A and that of the rate)."""
    lines = ["| record | true | plain | dfsm | dfsm says |", "|---|---|---|---|---|"]
    for name, result in figures.items():
        cells = [
            ", ".join(f"{round(result[who][key], 6) + 0.0:.3g}" for key in result["true"])
            for who in ("true", "plain", "dfsm")
        ]
        told = result["told"]
        said = told if len(told) <= _SHOWN else told[:_SHOWN].rsplit(" ", 1)[0] + " …"
        lines.append(f"| {name} | {' | '.join(cells)} | {said} |")
    return lines

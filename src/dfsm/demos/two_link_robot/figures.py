"""Figures of the two-link robot study; numbers 1 to 6 are the paper's."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dfsm.core.types import Array
from dfsm.demos.two_link_robot.assess import Assessed
from dfsm.demos.two_link_robot.defaults import PEER, Fitted
from dfsm.demos.two_link_robot.extraction import Extraction
from dfsm.demos.two_link_robot.multi_fidelity import (
    LINEAR,
    MULTI,
    NONLINEAR,
    OWN,
    Chaos,
    MultiFidelity,
    Series,
)
from dfsm.demos.two_link_robot.taylor import TaylorComparison
from dfsm.report.article import Curve, Figure, Panel

_COLOURS = {LINEAR: 3, MULTI: 1, NONLINEAR: 2, OWN: 4}
_BINS = 60
_GRAVITY = (("θ1", "rad"), ("θ̇1", "rad/s"), ("θ2", "rad"), ("θ̇2", "rad/s"))
_HORIZONTAL = (("ω1", "rad/s"), ("ω2", "rad/s"), ("θ2", "rad"), ("θ1", "rad"))
# Their derivatives.
_GRAVITY_RATES = (("θ̇1", "rad/s"), ("θ̈1", "rad/s²"), ("θ̇2", "rad/s"), ("θ̈2", "rad/s²"))
_TIME = "time (s)"


def extraction(e: Extraction) -> Figure:
    """Fig. 1, and the error against the sampling step."""
    time, true, extracted = e.example
    panels = [
        Panel(
            _GRAVITY_RATES[k][0],
            _TIME,
            _GRAVITY_RATES[k][1],
            (Curve("true f", time, true[:, k], 0), Curve("spline", time, extracted[:, k], 1)),
        )
        for k in (1, 3)
    ]
    error = np.maximum(np.abs(extracted - true), 1e-12)
    panels.append(
        Panel(
            "|spline − true|",
            _TIME,
            "rad/s²",
            tuple(Curve(_GRAVITY_RATES[k][0], time, error[:, k], c) for k, c in ((1, 2), (3, 3))),
            log="y",
        )
    )
    r = e.refinement
    at, between = r.orders
    panels.append(
        Panel(
            "mean error",
            "step h (s)",
            "rad/s, rad/s²",
            (
                Curve(f"between samples: order {between:.1f}", r.step, r.between, 4),
                Curve(f"at samples: order {at:.1f}", r.step, r.knots, 1),
                Curve("the same, tolerance 10⁻⁹", r.step, r.loose, 1, "dashed"),
            ),
            log="xy",
        )
    )
    return Figure(
        "fig1_derivatives",
        "Fig. 1. True derivatives and those of a cubic spline, for one simulation; their "
        "difference; and the mean error over all states of several simulations against the "
        "sampling step, with a tolerance of 10⁻¹³ in the simulator. With its usual tolerance its "
        "own error stops the fall.",
        tuple(panels),
    )


def linear_rows(t: TaylorComparison) -> Figure:
    """Fig. 2."""
    time, true, linear, taylor = t.example
    panels = [
        Panel(
            name,
            _TIME,
            unit,
            (
                Curve("true f", time, true[:, k], 0),
                Curve(LINEAR, time, linear[:, k], _COLOURS[LINEAR]),
                Curve("Taylor", time, taylor[:, k], 4, "dashed"),
            ),
        )
        for k, (name, unit) in enumerate(_GRAVITY_RATES)
    ]
    return Figure(
        "fig2_linear_rows",
        f"Fig. 2. State derivatives along a simulation that was not fitted, δ = "
        f"{t.fits[0].delta:g}. The rows of θ̇1 and θ̇2 are linear.",
        tuple(panels),
    )


def poles(t: TaylorComparison) -> Figure:
    """Fig. 3, and how the fit's poles converge."""
    lines = [
        ("Taylor, u = 0 (the paper's)", t.unforced, 2),
        ("Taylor, u holds the arm", t.stationary, 0),
        *[(f"linear-fit, δ = {f.delta:g}", f.poles, 1) for f in t.fits],
    ]
    names = {2: "Taylor, u = 0", 0: "Taylor, u holds the arm", 1: LINEAR}
    heights = np.arange(len(lines))[::-1]
    curves = tuple(
        Curve(names[colour], values, np.full(len(values), height), colour, "points")
        for (_, values, colour), height in zip(lines, heights, strict=True)
    )
    ticks = tuple((float(h), text) for h, (text, *_) in zip(heights, lines, strict=True))
    deltas = np.array([f.delta for f in t.fits])
    errors = Panel(
        "distance to the poles at rest",
        "δ",
        "1/s",
        (
            Curve(LINEAR, deltas, t.distance(t.stationary), 1, "points"),
            Curve(LINEAR, deltas, t.distance(t.stationary), 1),
            Curve("without offset (L·I)", deltas, t.distance(t.stationary, False), 4, "dashed"),
        ),
        log="xy",
    )
    strip = Panel(
        "poles, all real", "1/s", "", curves, ticks=ticks, y_range=(-0.6, len(lines) - 0.4)
    )
    return Figure(
        "fig3_poles",
        "Fig. 3. Poles of the Taylor expansions and of linear fits to ever smaller motions, and "
        "their largest distance.",
        (strip, errors),
    )


def corrected_rows(m: MultiFidelity) -> Figure:
    """Fig. 4."""
    s = m.series
    panels = [
        Panel(
            f"ω̇{k + 1}",
            _TIME,
            "rad/s²",
            (
                Curve("true f", s.time, s.derivatives[:, k], 0),
                *[Curve(n, s.time, s.predicted[n][:, k], _COLOURS[n]) for n in (LINEAR, MULTI)],
            ),
        )
        for k in (0, 1)
    ]
    panels.append(
        Panel(
            "corrective function e",
            _TIME,
            "rad/s²",
            tuple(Curve(f"e of ω̇{k + 1}", s.time, s.correction[:, k], 4 + k) for k in (0, 1)),
        )
    )
    panels.append(
        Panel(
            "torques u",
            _TIME,
            "1",
            tuple(Curve(f"u{k + 1}", s.time, s.controls[:, k], 4 + k) for k in (0, 1)),
        )
    )
    return Figure(
        "fig4_corrected_rows",
        "Fig. 4. Derivatives along a test run, what the corrective function adds, and the torques.",
        tuple(panels),
    )


def rollouts(m: MultiFidelity) -> Figure:
    """Fig. 5."""
    return Figure(
        "fig5_rollouts",
        "Fig. 5. One test run of 3 s, simulated by every model from the same state.",
        tuple(_state(m.series, k, *_HORIZONTAL[k]) for k in range(4)),
    )


def _state(s: Series, k: int, name: str, unit: str) -> Panel:
    true = s.states[:, k]
    reach = 0.6 * np.ptp(true)
    return Panel(
        name,
        _TIME,
        unit,
        (
            Curve("true", s.time, true, 0),
            *[Curve(n, s.time, v[:, k], _COLOURS[n]) for n, v in s.simulated.items()],
        ),
        y_range=(float(true.min() - reach), float(true.max() + reach)),
    )


def histograms(m: MultiFidelity) -> Figure:
    """Fig. 6."""
    panels = []
    for k, (name, unit) in enumerate(_HORIZONTAL):
        errors = {n: m.assessed[n].rollouts.errors[..., k].ravel() for n in (NONLINEAR, MULTI)}
        errors = {n: e[np.isfinite(e)] for n, e in errors.items()}
        pooled = np.abs(np.concatenate([*errors.values(), np.array([1e-12])]))
        limit = float(np.percentile(pooled, 99.0))
        edges = np.linspace(-limit, limit, _BINS + 1)
        curves = [
            Curve(n, *_shares(e, edges), _COLOURS[n], "steps") for n, e in errors.items() if len(e)
        ]
        panels.append(Panel(f"error in {name}", unit, "share of samples (%)", tuple(curves)))
    return Figure(
        "fig6_histograms",
        "Fig. 6. Pointwise errors of the states over all twenty test runs; the outermost bins hold "
        "what lies beyond.",
        tuple(panels),
    )


def _shares(errors: Array, edges: Array) -> tuple[Array, Array]:
    counts = np.histogram(np.clip(errors, edges[0], edges[-1]), edges)[0]
    return (edges[1:] + edges[:-1]) / 2, 100 * counts / counts.sum()


def sweep(m: MultiFidelity) -> Figure:
    """Accuracy and build time over the size of the subsample."""
    s = m.sweep
    counts = np.array(s.samples, dtype=np.float64)

    ticks = tuple((float(n), str(n)) for n in s.samples)

    def panel(title: str, unit: str, of: str) -> Panel:
        curves = []
        for n in (MULTI, NONLINEAR):
            values = np.array([_figure(a, of) for a in s.assessed[n]])
            curves += [
                Curve(n, counts, values, _COLOURS[n]),
                Curve(n, counts, values, _COLOURS[n], "points"),
            ]
        log = "xy" if of == "seconds" else "x"
        return Panel(title, "n_s", unit, tuple(curves), log=log, x_ticks=ticks)

    return Figure(
        "fig7_sweep",
        "Size of the subsample: RMSE of the derivatives of ω1 and ω2, RMSE of the rollouts (root "
        "mean square over the four states), and time to build.",
        (
            panel("derivatives", "rad/s²", "slopes"),
            panel("rollouts", "RMSE", "states"),
            panel("build time", "s", "seconds"),
        ),
    )


def _figure(a: Assessed, of: str) -> float:
    if of == "seconds":
        return a.seconds
    values = a.slopes[:2] if of == "slopes" else a.rollouts.rmse
    return float(np.sqrt(np.mean(values**2)))


def chaos(c: Chaos) -> Figure:
    """The arm with gravity over 5 s, and how errors grow."""
    panels = [_state(c.series, k, *_GRAVITY[k]) for k in (0, 2)]
    _, spread = c.spread
    time = next(iter(c.short.values())).time
    for k in (0, 2):
        curves = tuple(
            Curve(n, time[1:] - time[0], r.growth[1:, k] / spread[k], _COLOURS[n])
            for n, r in c.short.items()
        )
        panels.append(
            Panel(f"error in {_GRAVITY[k][0]} after t", "t (s)", "RMS / std", curves, log="y")
        )
    return Figure(
        "fig8_gravity",
        "The arm with gravity. Left: one test run of 5 s and the models' rollouts; a curve that "
        "ends has left the training range. Right: how the error of rollouts grows, from starts at "
        "every half second of the test runs.",
        tuple(panels),
    )


def growth(kinds: Mapping[str, Fitted]) -> Figure:
    """Errors of the defaults over 5 s."""
    panels = []
    for k, (name, unit) in enumerate(_HORIZONTAL):
        curves = [
            Curve(n, f.long.time[1:], f.long.growth[1:, k], c)
            for c, (n, f) in enumerate(kinds.items(), start=1)
        ]
        span = np.array([0.0, 3.0])
        peer = Curve("published program, RMSE over 3 s", span, np.full(2, PEER[k]), 0, "dashed")
        panels.append(Panel(f"error in {name}", _TIME, f"RMS, {unit}", (peer, *curves), log="y"))
    return Figure(
        "fig9_growth",
        "RMS error over twenty test runs of 5 s at each time, models trained on runs of 3 s.",
        tuple(panels),
    )
